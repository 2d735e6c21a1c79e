"""The map of paths: for each voxel, the reflection sequences by which rays reach it, and how probable each is.

A reflection sequence has one image of the station and one mirror matrix, which give direction and length of its path to
any position exactly. Which sequences reach a voxel, and what share of its volume, is what the rays tell.
"""

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.hits import turned
from rayfix_offline.rays.pathprior import PathPrior, wall_factors
from rayfix_offline.rays.rays import RaySet
from rayfix_offline.rays.segments import SegmentArrays, Segments
from rayfix_offline.rays.settings import PathKind
from rayfix_offline.rays.voxelwalk import VoxelWalk, over_ray_ranges, power, walk
from rayfix_tables.paths import PathMap

_LN10 = math.log(10.0)
_DECIBELS = 10.0


class FieldOfView(NamedTuple):
    """A cone of directions about an axis, a unit vector of shape (3,); its half opening angle is in radians."""

    axis: NDArray[np.float64]
    half_angle: float


def least_share(floor_db: float, exponent: float) -> float:
    """Fraction of the sum of gain^beta that a path has which is so much weaker than all together."""
    return math.exp(-_LN10 / _DECIBELS * floor_db * exponent)


def fill_path_map(
    rays: RaySet,
    segments: Segments,
    prior: PathPrior,
    *,
    exponent: float,
    kind: PathKind,
    least_share: float,
    field_of_view: FieldOfView | None = None,
    jobs: int = 1,
) -> PathMap:
    """Fill the map of one station.

    Parameters
    ----------
    prior : PathPrior
        Filled by the same rays; the map has its voxels.
    exponent : float
        The prior's beta.
    kind : {"power", "uniform", "paper"}
        Weight of a path: its probability, 1, or the inverse square of its length.
    least_share : float
        Paths that carry less than this fraction of the sum of gain^beta in a voxel are left out.
    field_of_view : FieldOfView, optional
        Paths to the middle of a voxel from outside of it are left out; all are in it by default.
    jobs : int
        Threads; -1 for one per core. The map is the same with any number.
    """
    total = prior.total.reshape(-1)
    factors = wall_factors(segments, exponent)

    def fill(first: int, stop: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        keys, sums = _fill(
            SegmentArrays.of(segments, rays.directions, factors, first, stop),
            rays.solid_angle[first:stop],
            exponent,
            least_share,
            VoxelWalk.of(prior.origin, prior.voxel_size, prior.total.shape),
            total,
        )
        used = keys >= 0
        return keys[used], sums[used]

    found = over_ray_ranges(fill, len(rays), jobs)
    keys, place = np.unique(np.concatenate([each[0] for each in found]), return_inverse=True)
    sums = np.concatenate([each[1] for each in found])
    volume, strength, excess, walls, log_gain = (np.bincount(place, sums[:, n], len(keys)) for n in range(5))
    voxel, sequence = np.divmod(keys, len(segments.sequences.images))
    # Rays reach a little more or less of a voxel than there is of it: that is noise of their number.
    lit = np.minimum(volume / prior.free_volume.reshape(-1)[voxel], 1.0)
    weight = lit
    if kind == "power":
        weight = lit * strength / volume
        weight = weight / np.bincount(voxel, weight, total.size)[voxel]
    middle = np.stack(np.unravel_index(voxel, prior.total.shape), axis=1) + 0.5
    apart = prior.origin + prior.voxel_size * middle - segments.sequences.images[sequence]
    length = np.maximum(np.linalg.norm(apart, axis=1), 0.5 * prior.voxel_size)
    if kind == "paper":
        weight = lit / length**2
    order = np.lexsort((sequence, -weight, voxel))
    if field_of_view is not None:
        along = segments.sequences.mirrors[sequence] @ field_of_view.axis
        order = order[(np.einsum("ni,ni->n", along, apart) >= length * np.cos(field_of_view.half_angle))[order]]
    used, number = np.unique(sequence[order], return_inverse=True)
    passes = bool(walls[order].any())
    return PathMap(
        origin=prior.origin,
        voxel_size=prior.voxel_size,
        shape=prior.total.shape,
        offsets=np.concatenate([[0], np.cumsum(np.bincount(voxel[order], minlength=total.size))]),
        sequence=number.astype(np.int32),
        weight=weight[order].astype(np.float32),
        excess=(excess / strength)[order].astype(np.float32) if passes else np.zeros(0, np.float32),
        num_walls=np.rint(walls / strength)[order].astype(np.int8) if passes else np.zeros(0, np.int8),
        images=segments.sequences.images[used],
        mirrors=segments.sequences.mirrors[used],
        num_reflections=segments.sequences.num_reflections[used],
        log_gain=(_LN10 * log_gain / volume)[order].astype(np.float16),
        lit=lit[order].astype(np.float16),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill(rays: Any, solid_angle: Any, exponent: Any, least_share: Any, room: Any, total: Any) -> Any:
    """Sum what each sequence covers of each voxel.

    Returns
    -------
    keys : ndarray of int64, shape (n,)
        A hash table of ``voxel * n_sequences + sequence``; -1 where it is empty.
    sums : ndarray of shape (n, 5)
        Integrals over the parts of rays in the voxel of solid angle x length^2: as it is [m3], times gain^beta, that
        times the excess length [m] and times the number of walls; and times the logarithm to base 10 of the gain.
    """
    voxel, lengths, voxels = room.voxel_size, room.lengths, room.voxels
    num_sequences = len(rays.images)
    size = 1 << 16
    keys, sums = np.full(size, -1, np.int64), np.zeros((size, 5))
    count = 0
    for ray in range(len(solid_angle)):
        for segment in range(rays.offsets[ray], rays.offsets[ray + 1]):
            seq = rays.sequence[segment]
            heading = turned(rays.mirrors, seq, rays.directions, ray)
            begin, stop = rays.start[segment], rays.end[segment]
            num_parts = walk(rays.images[seq], heading, begin, stop, room.origin, voxel, room.shape, lengths, voxels)
            for part in range(num_parts):
                where = voxels[part]
                begin, end = lengths[part], lengths[part + 1]
                if where < 0 or end <= begin:
                    continue
                reach = max(0.5 * (begin + end), 0.5 * voxel)
                gain = rays.factors[segment] / power(reach * reach, exponent)
                if gain <= 0.0 or not gain >= least_share * total[where]:
                    continue
                if 2 * count >= size:
                    size *= 2
                    keys, sums = _grown(keys, sums, size)
                key = where * num_sequences + seq
                slot = _slot(keys, key)
                if keys[slot] < 0:
                    keys[slot] = key
                    count += 1
                covered = solid_angle[ray] * (end**3 - begin**3) / 3.0
                sums[slot, 0] += covered
                sums[slot, 1] += covered * gain
                sums[slot, 2] += covered * gain * rays.excess[segment]
                sums[slot, 3] += covered * gain * rays.num_walls[segment]
                sums[slot, 4] += covered * rays.log_gain[segment]
    return keys, sums


@numba.njit(cache=True, nogil=True)
def _slot(keys: Any, key: Any) -> Any:
    """Place of a key in a hash table, or the empty place where it belongs (Fibonacci hashing, linear probing)."""
    mask = len(keys) - 1
    slot = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)) & mask
    while keys[slot] >= 0 and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@numba.njit(cache=True, nogil=True)
def _grown(keys: Any, sums: Any, size: Any) -> Any:
    """Move a hash table to a larger one."""
    new_keys, new_sums = np.full(size, -1, np.int64), np.zeros((size, sums.shape[1]))
    for n in range(len(keys)):
        if keys[n] >= 0:
            slot = _slot(new_keys, keys[n])
            new_keys[slot] = keys[n]
            new_sums[slot] = sums[n]
    return new_keys, new_sums
