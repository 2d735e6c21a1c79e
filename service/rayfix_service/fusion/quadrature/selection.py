"""Selection-aware reweighting: the weights of a station's paths under any rule by which it selects what it reports.

The path map has the gain of each path and the share of a voxel that it reaches, so that a rule is a set of weights that
is worked out once per station. With gains g_k, shares lit_k and lengths L_k of the paths to a voxel:

    strongest   w_k = lit_k g_k^beta / sum_j lit_j g_j^beta
    audible     p_k = lit_k / (1 + exp(-(g_k / sum_j lit_j g_j in dB + within) / edge))
    first       w_k = p_k prod_{L_j < L_k} (1 - p_j)
    any, all    w_k = p_k / sum_j p_j

What is probable of sets of paths is in :mod:`rayfix_service.fusion.quadrature.detection`.
"""

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.quadrature.blocks import BlockPaths
from rayfix_tables.paths import PathMap
from rayfix_tables.site import Selection

_EDGE_DB = 1.7
"""Scale of the logistic edge, which is as wide as 3 dB of fading and of losses that are not known make it."""

_LEAST = 1e-4
"""Lighter paths are left out."""

_DB = 10.0 / math.log(10.0)

Array = NDArray[np.float64]


def audible_paths(paths: PathMap, within_db: float) -> tuple[Array, Array]:
    """Probabilities that paths are audible where they reach, and how much weaker than the strongest each is, dB.

    Parameters
    ----------
    paths : PathMap
        With gains.
    within_db : float
        A path is as likely as not to be audible that is so much weaker than all together.
    """
    voxel, gain, heard = _levels(paths, within_db)
    return heard, _DB * (_highest(paths, gain)[voxel] - gain)


def selected_paths(paths: PathMap, selection: Selection) -> BlockPaths:
    """Paths to the voxels with their probability to be the one that a station reports.

    Parameters
    ----------
    paths : PathMap
        With gains.
    selection : Selection
    """
    voxel, gain, audible = _audible(paths, selection.reach_db)
    if selection.rule == "strongest":
        highest = _highest(paths, gain)
        weight = paths.lit.astype(np.float64) * np.exp(selection.exponent * (gain - highest[voxel]))
    elif selection.rule == "first":
        length = _lengths(paths, voxel)
        if len(paths.excess):
            length += paths.excess
        weight = audible * none_before(paths.offsets, length, audible)
    else:
        weight = audible
    total = np.bincount(voxel, weight, len(paths.offsets) - 1)
    return _sorted(paths, weight / np.maximum(total, 1e-300)[voxel])


def _audible(paths: PathMap, within_db: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Voxel of each path, the natural logarithm of its gain, and its probability to be audible."""
    voxel, gain, heard = _levels(paths, within_db)
    return voxel, gain, paths.lit * heard


def _levels(paths: PathMap, within_db: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Voxel of each path, the natural logarithm of its gain, and its probability to be audible where it reaches."""
    voxel = np.repeat(np.arange(len(paths.offsets) - 1), np.diff(paths.offsets))
    gain = paths.log_gain.astype(np.float64) - 2.0 * np.log(_lengths(paths, voxel))
    highest = _highest(paths, gain)
    power = np.bincount(voxel, paths.lit * np.exp(gain - highest[voxel]), len(highest))
    level = highest + np.log(np.maximum(power, 1e-300))
    above = _DB * (gain - level[voxel]) + within_db
    return voxel, gain, 1.0 / (1.0 + np.exp(np.clip(-above / _EDGE_DB, -50.0, 50.0)))


def _lengths(paths: PathMap, voxel: NDArray[np.int64]) -> Array:
    """Lengths of the paths to the middles of their voxels, m."""
    middle = np.stack(np.unravel_index(voxel, paths.shape), axis=1) + 0.5
    apart = paths.origin + paths.voxel_size * middle - paths.images[paths.sequence]
    return np.asarray(np.maximum(np.linalg.norm(apart, axis=1), 0.5 * paths.voxel_size))


def _highest(paths: PathMap, value: Array) -> Array:
    """Highest value of the paths to each voxel, 0 where there is none."""
    found = np.zeros(len(paths.offsets) - 1)
    some = np.flatnonzero(np.diff(paths.offsets))
    if len(some):
        found[some] = np.maximum.reduceat(value, paths.offsets[some])
    return found


@numba.njit(cache=True, nogil=True)
def none_before(offsets: Any, length: Any, audible: Any) -> Any:
    """Probability that no shorter path to the voxel is audible; of equal ones, the first counts as shorter."""
    found = np.ones(len(length))
    for voxel in range(len(offsets) - 1):
        for path in range(offsets[voxel], offsets[voxel + 1]):
            for other in range(offsets[voxel], offsets[voxel + 1]):
                if length[other] < length[path] or (length[other] == length[path] and other < path):
                    found[path] *= 1.0 - audible[other]
    return found


@numba.njit(cache=True, nogil=True)
def heaviest_first(offsets: Any, weight: Any, least: Any) -> Any:
    """Sort the paths to each voxel by weight, the heaviest first, without those of no more than ``least``.

    Returns
    -------
    new_offsets : ndarray of int64, shape (n_voxels + 1,)
    order : ndarray of int64
        Of the paths that are left.
    """
    new_offsets = np.zeros(len(offsets), np.int64)
    order = np.empty(len(weight), np.int64)
    total = 0
    for voxel in range(len(offsets) - 1):
        begin = total
        for path in range(offsets[voxel], offsets[voxel + 1]):
            if weight[path] <= least:
                continue
            at = total
            while at > begin and weight[order[at - 1]] < weight[path]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = path
            total += 1
        new_offsets[voxel + 1] = total
    return new_offsets, order[:total].copy()


def _sorted(paths: PathMap, weight: Array) -> BlockPaths:
    """Paths of new weights, heaviest first."""
    offsets, order = heaviest_first(paths.offsets, weight, _LEAST)
    passes = len(paths.excess) > 0
    return BlockPaths(
        offsets=offsets,
        sequence=paths.sequence[order],
        weight=weight[order].astype(np.float32),
        excess=paths.excess[order] if passes else np.zeros(0, np.float32),
        num_walls=paths.num_walls[order] if passes else np.zeros(0, np.int8),
    )
