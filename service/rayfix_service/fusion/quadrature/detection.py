"""How probably a station reports each of the paths to a place, when it reports all that it hears.

A path map tells of each voxel which fraction of it a path reaches, as met by rays. Where a path ends, at the edge of a
shadow or of a mirror, that fraction alone is a poor guide: a path that reaches nine tenths of a voxel is sure in its
middle, and a path that no ray brought to a voxel may reach a corner of it. A position is known to a fraction of a voxel
where many paths count, so that jumps from voxel to voxel would tell of it what is not so. Instead the fractions are
averaged over the voxels round each corner of a voxel, and interpolated between its corners. Against the image method
in the example hall, the probability that a path reaches a place is a logistic function of that, of two slopes, to some
hundredths; the paths of a voxel are those of all voxels round it. In the hall, 6 % of the five strongest paths to a
place are not in the list of its own voxel, and 1 % in none of these.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.quadrature.blocks import BlockPaths, BlockTree, StationPaths
from rayfix_service.fusion.quadrature.selection import audible_paths, heaviest_first
from rayfix_tables.paths import PathMap

_LEAST = 1e-3
"""Paths that are less probably reported are left out."""

_MOST_DETECTED = 0.95
"""No path is surer to be reported: scenes are not drawn to the last object, and neighbouring paths interfere."""

_FALL = 0.002
"""By which fraction a path is less probable to be reported for each decibel that others are stronger."""

_HALF, _BELOW, _ABOVE = 0.43, 7.0, 15.0
"""Interpolated fraction at which a path is as likely as not to reach a place, and slopes of the log odds beside it."""

NO_CORNERS = np.zeros((0, 8), np.uint8)

Array = NDArray[np.float64]


class Detection(NamedTuple):
    """How probably a station reports the paths to voxels.

    Attributes
    ----------
    audible : ndarray of float32, shape (n_paths,)
        Probability to be reported where the path reaches.
    corners : ndarray of uint8, shape (n_paths, 8)
        Fraction that it reaches of the voxels round each corner, the last axis fastest, in 255ths; none for larger
        blocks, whose paths have one probability each.
    origin : ndarray of shape (3,), m
        Low corner of the map.
    size : float, m
        Of a voxel.
    """

    audible: NDArray[np.float32]
    corners: NDArray[np.uint8]
    origin: Array
    size: float


class DetectedPaths(NamedTuple):
    """Paths of a station to blocks of all sizes, their weights being the probabilities to be reported.

    Attributes
    ----------
    paths : StationPaths
    of_voxels : Detection
        Of the smallest blocks, in more detail.
    """

    paths: StationPaths
    of_voxels: Detection

    def detail(self, level: int) -> Detection:
        """Return the detail of blocks of a size, 0 for the smallest; none for larger ones."""
        if level == 0:
            return self.of_voxels
        return self.of_voxels._replace(audible=self.of_voxels.audible[:0], corners=self.of_voxels.corners[:0])


def station_detection(paths: PathMap, tree: BlockTree, within_db: float) -> DetectedPaths:
    """Work out how probably a station reports the paths to blocks of all sizes.

    Parameters
    ----------
    paths : PathMap
        With gains.
    tree : BlockTree
    within_db : float
        A path is as likely as not to be reported that is so much weaker than all together.
    """
    of_voxels, detail = detected_paths(paths, within_db)
    return DetectedPaths(StationPaths(paths, tree, of_voxels), detail)


def detected_paths(paths: PathMap, within_db: float) -> tuple[BlockPaths, Detection]:
    """Work out how probably a station reports the paths to voxels, the most probable first."""
    offsets, source, corners = shares_at_corners(
        paths.offsets, paths.sequence, paths.lit.astype(np.float32), np.array(paths.shape), len(paths.images)
    )
    passes = len(paths.excess) > 0
    lit = corners.mean(axis=1)
    wide = paths.rearranged(offsets, source, lit)
    audible, below = audible_paths(wide, within_db)
    # Falls a little with the gain where it would be flat, so that the strongest paths come first.
    audible *= _MOST_DETECTED * np.exp(-_FALL * below)
    weight = audible / (1.0 + np.exp(-log_odds(lit)))
    new_offsets, order = heaviest_first(offsets, weight, _LEAST)
    of_voxels = BlockPaths(
        offsets=new_offsets,
        sequence=wide.sequence[order],
        weight=weight[order].astype(np.float32),
        excess=wide.excess[order] if passes else np.zeros(0, np.float32),
        num_walls=wide.num_walls[order] if passes else np.zeros(0, np.int8),
    )
    return of_voxels, Detection(
        audible=audible[order].astype(np.float32),
        corners=np.rint(255.0 * corners[order]).astype(np.uint8),
        origin=np.asarray(paths.origin, np.float64),
        size=float(paths.voxel_size),
    )


def log_odds(share: Array) -> Array:
    """Log odds that a path reaches a place, from the interpolated fraction."""
    above = share - _HALF
    return np.asarray(np.where(above > 0.0, _ABOVE, _BELOW) * above)


@numba.njit(cache=True, nogil=True, inline="always")
def detected_at(audible: Any, corners: Any, x: Any, y: Any, z: Any) -> Any:
    """Probability that a path is reported from a point of a voxel, whose coordinates there are from 0 to 1.

    Parameters
    ----------
    audible : float
    corners : ndarray of uint8, shape (8,)
    """
    low = (1.0 - y) * ((1.0 - z) * corners[0] + z * corners[1]) + y * ((1.0 - z) * corners[2] + z * corners[3])
    high = (1.0 - y) * ((1.0 - z) * corners[4] + z * corners[5]) + y * ((1.0 - z) * corners[6] + z * corners[7])
    share = ((1.0 - x) * low + x * high) / 255.0
    above = share - _HALF
    return audible / (1.0 + np.exp(-(_ABOVE if above > 0.0 else _BELOW) * above))


@numba.njit(cache=True, nogil=True)
def shares_at_corners(offsets: Any, sequence: Any, lit: Any, shape: Any, num_sequences: Any) -> Any:
    """Paths of each voxel and of those around it, with the fractions that they reach round the corners of the voxel.

    Voxels without any path are left out of the means: they are not free, or no ray was near.

    Returns
    -------
    new_offsets : ndarray of int64, shape (n_voxels + 1,)
    source : ndarray of int64
        A path that each is a copy of, the voxel's own where it has one.
    corners : ndarray of float32, shape (n, 8)
    """
    num_voxels = len(offsets) - 1
    new_offsets = np.zeros(num_voxels + 1, np.int64)
    size = 2 * len(sequence) + 64
    source, corners = np.empty(size, np.int64), np.empty((size, 8), np.float32)
    place = np.full(num_sequences, -1, np.int64)
    heard, total = np.empty(8), 0
    for voxel in range(num_voxels):
        begin = total
        heard[:] = 0.0
        x, y, z = voxel // (shape[1] * shape[2]), voxel // shape[2] % shape[1], voxel % shape[2]
        for i in range(max(x - 1, 0), min(x + 2, shape[0])):
            for j in range(max(y - 1, 0), min(y + 2, shape[1])):
                for k in range(max(z - 1, 0), min(z + 2, shape[2])):
                    other = (i * shape[1] + j) * shape[2] + k
                    if offsets[other] == offsets[other + 1]:
                        continue
                    for corner in range(8):
                        heard[corner] += _touches(corner, i - x, j - y, k - z)
                    for path in range(offsets[other], offsets[other + 1]):
                        at = place[sequence[path]]
                        if at < 0:
                            if total == size:
                                size *= 2
                                longer, wider = np.empty(size, np.int64), np.empty((size, 8), np.float32)
                                longer[:total], wider[:total] = source, corners
                                source, corners = longer, wider
                            at = place[sequence[path]] = total
                            corners[total] = 0.0
                            source[total] = path
                            total += 1
                        for corner in range(8):
                            if _touches(corner, i - x, j - y, k - z):
                                corners[at, corner] += lit[path]
                        if other == voxel:
                            source[at] = path
        for n in range(begin, total):
            place[sequence[source[n]]] = -1
            for corner in range(8):
                corners[n, corner] = min(corners[n, corner] / max(heard[corner], 1.0), 1.0)
        new_offsets[voxel + 1] = total
    return new_offsets, source[:total].copy(), corners[:total].copy()


@numba.njit(cache=True, nogil=True, inline="always")
def _touches(corner: Any, i: Any, j: Any, k: Any) -> Any:
    """Whether a voxel so many steps away touches a corner of this one."""
    return (
        (i == 0 or (i > 0) == (corner >= 4))
        and (j == 0 or (j > 0) == (corner // 2 % 2 == 1))
        and (k == 0 or (k > 0) == (corner % 2 == 1))
    )
