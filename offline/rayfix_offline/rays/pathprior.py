"""The path-selection prior: the probability that a station reports a certain path of several.

At a position x that paths k reach with power gains g_k, path k is reported with probability
``pi_k(x) = g_k^beta / sum_j g_j^beta``. The sum is stored as a voxel map, filled by all rays of an isotropic launch: a
ray of solid angle dOmega covers the volume ``s^2 dOmega ds`` between the lengths s and s + ds.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.hits import turned
from rayfix_offline.rays.rays import RaySet
from rayfix_offline.rays.segments import SegmentArrays, Segments
from rayfix_offline.rays.voxelwalk import GAUSS, VoxelWalk, over_ray_ranges, power, walk
from rayfix_tables.freespace import FreeSpace


@dataclass(frozen=True, kw_only=True)
class PathPrior:
    """The sum of gain^beta over all paths to a voxel.

    Attributes
    ----------
    origin : ndarray of shape (3,), m
    voxel_size : float, m
    total : ndarray of shape (nx, ny, nz)
        Mean over the voxel's free part; 0 if no ray reaches it, infinite behind walls where nothing is free.
    free_volume : ndarray of that shape, m3
        Volume of the voxel's free part; one voxel of the free space at least.
    coverage : tuple of float
        Fraction of the free voxels that are reached with at most 0, 1, 2, ... reflections.
    wall_coverage : tuple of float
        Fraction of the free voxels that straight paths through at most 0, 1, 2, ... walls reach; empty where no wall
        lets signals through.
    """

    origin: NDArray[np.float64]
    voxel_size: float
    total: NDArray[np.float64]
    free_volume: NDArray[np.float64]
    coverage: tuple[float, ...]
    wall_coverage: tuple[float, ...] = ()


def wall_factors(segments: Segments, exponent: float) -> NDArray[np.float64]:
    """Factor of gain^beta due to walls, shape (n_segments,)."""
    return np.asarray(10.0 ** (segments.log_gain * exponent))


def fill_path_prior(
    rays: RaySet,
    segments: Segments,
    free_space: FreeSpace,
    *,
    exponent: float,
    refinement: int,
    jobs: int = 1,
) -> PathPrior:
    """Fill the voxel map of one station.

    Parameters
    ----------
    exponent : float
        beta: with 0 all paths are equally probable, with a large one the strongest is reported.
    refinement : int
        A voxel of the map is this many voxels of the free space wide.
    jobs : int
        Threads; -1 for one per core. The map is the same with any number.
    """
    voxel_size = free_space.voxel_size * refinement
    shape = -(-np.array(free_space.free.shape) // refinement)
    padded = np.zeros(shape * refinement, bool)
    nx, ny, nz = free_space.free.shape
    padded[:nx, :ny, :nz] = free_space.free
    blocks = padded.reshape(shape[0], refinement, shape[1], refinement, shape[2], refinement)
    free_fraction = blocks.mean(axis=(1, 3, 5))
    depths = segments.max_reflections + 1
    factors = wall_factors(segments, exponent)

    most_walls = int(segments.num_walls.max(initial=0))

    def fill(first: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.int8], NDArray[np.int8]]:
        total = np.zeros(tuple(shape))
        first_reached = np.full(total.shape, depths, np.int8)
        first_walls = np.full(total.shape, most_walls + 1, np.int8)
        _fill(
            SegmentArrays.of(segments, rays.directions, factors, first, stop),
            rays.solid_angle[first:stop],
            exponent,
            VoxelWalk.of(free_space.origin, voxel_size, total.shape),
            total.reshape(-1),
            first_reached.reshape(-1),
            first_walls.reshape(-1),
        )
        return total, first_reached, first_walls

    filled = over_ray_ranges(fill, len(rays), jobs)
    gain = sum((total for total, _, _ in filled[1:]), start=filled[0][0])
    first_reached = np.min([reached for _, reached, _ in filled], axis=0)
    first_walls = np.min([walls for _, _, walls in filled], axis=0)
    # Rays reach only the free part of a voxel that a solid cuts; it counts as one free-space voxel at least.
    free_volume = voxel_size**3 * np.maximum(free_fraction, 1.0 / refinement**3)
    total = gain / free_volume
    if most_walls:
        # Rays through walls also run where no transmitter can be: their paths are never reported from there.
        total[free_fraction == 0.0] = np.inf
    free = free_fraction > 0.5
    count = max(1, int(np.count_nonzero(free)))

    def share(reached: NDArray[np.bool_]) -> float:
        return float(np.count_nonzero(free & reached) / count)

    return PathPrior(
        origin=free_space.origin,
        voxel_size=voxel_size,
        total=total,
        free_volume=free_volume,
        coverage=tuple(share(first_reached <= k) for k in range(depths)),
        wall_coverage=tuple(share(first_walls <= k) for k in range(most_walls + 1)) if most_walls else (),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill(rays: Any, solid_angle: Any, exponent: Any, room: Any, total: Any, reached: Any, walls: Any) -> None:
    """Add the integral of solid angle x length^2 x gain^beta to each voxel.

    Parameters
    ----------
    rays : SegmentArrays
    room : VoxelWalk
        Of the map.
    total, reached, walls : ndarray of shape (n_voxels,)
        Changed in place: the integrals, the smallest number of reflections by which a voxel is reached, and that of
        walls of straight paths.
    """
    voxel, lengths, voxels = room.voxel_size, room.lengths, room.voxels
    for ray in range(len(solid_angle)):
        for segment in range(rays.offsets[ray], rays.offsets[ray + 1]):
            seq = rays.sequence[segment]
            depth = rays.num_reflections[seq]
            heading = turned(rays.mirrors, seq, rays.directions, ray)
            scale = solid_angle[ray] * rays.factors[segment]
            begin, stop = rays.start[segment], rays.end[segment]
            num_parts = walk(rays.images[seq], heading, begin, stop, room.origin, voxel, room.shape, lengths, voxels)
            for part in range(num_parts):
                voxel_index, begin = voxels[part], lengths[part]
                size = lengths[part + 1] - begin
                if voxel_index < 0 or size <= 0.0:
                    continue
                for node, weight in GAUSS:
                    length = begin + node * size
                    # Bounded next to the station, where the mean gain of a voxel diverges.
                    reach = max(length, 0.5 * voxel)
                    total[voxel_index] += scale * weight * size * length * length / power(reach * reach, exponent)
                reached[voxel_index] = min(reached[voxel_index], depth)
                if depth == 0:
                    walls[voxel_index] = min(walls[voxel_index], rays.num_walls[segment])
