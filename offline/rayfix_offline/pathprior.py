"""The path-selection prior: which of the paths to a place a station reports.

At a place x that paths k reach with power gains g_k, path k is reported with probability
``pi_k(x) = g_k^beta / sum_j g_j^beta``. The sum is a voxel map, filled by all rays of an isotropic launch: a ray that
stands for the solid angle dOmega fills ``s^2 dOmega ds`` of space between the lengths s and s + ds.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.launch import RaySet, Segments
from rayfix_tables.freespace import FreeSpace

GOLDEN_RATIO = 0.5 * (1.0 + 5.0**0.5)
"""Rays are sampled at phases that are multiples of this.

Multiples of it spread evenly over the step. At one phase, the steps of neighbouring rays fall into the same voxels and
miss others alike: 10 % of noise in the map, however many rays there are.
"""


@dataclass(frozen=True, kw_only=True)
class PathPrior:
    """The sum of gain^beta over all paths to a voxel.

    Attributes
    ----------
    origin : ndarray of shape (3,), m
    voxel_size : float, m
    total : ndarray of shape (nx, ny, nz)
        Mean over the voxel's free part; 0 where no ray comes.
    coverage : tuple of float
        Share of the free voxels that are reached with at most 0, 1, 2, ... reflections.
    """

    origin: NDArray[np.float64]
    voxel_size: float
    total: NDArray[np.float64]
    coverage: tuple[float, ...]


def reflection_factors(segments: Segments, exponent: float) -> NDArray[np.float64]:
    """Factor that reflections put on gain^beta, shape (n_rays, max_reflections + 1)."""
    return np.asarray(10.0 ** (segments.log_gain * exponent))


def fill_path_prior(
    rays: RaySet, segments: Segments, free_space: FreeSpace, *, exponent: float, refinement: int
) -> PathPrior:
    """Fill the voxel map of one station.

    Parameters
    ----------
    exponent : float
        beta; 0 takes any path for as likely, a large one only the strongest.
    refinement : int
        A voxel of the map is this many voxels of the free space wide.
    """
    voxel_size = free_space.voxel_size * refinement
    shape = -(-np.array(free_space.free.shape) // refinement)
    padded = np.zeros(shape * refinement, bool)
    nx, ny, nz = free_space.free.shape
    padded[:nx, :ny, :nz] = free_space.free
    blocks = padded.reshape(shape[0], refinement, shape[1], refinement, shape[2], refinement)
    free_share = blocks.mean(axis=(1, 3, 5))
    depths = segments.sequence.shape[1]
    power = np.zeros(tuple(shape))
    first_reached = np.full(tuple(shape), depths, np.int8)
    _fill(
        segments.sequence,
        segments.start,
        segments.end,
        segments.sequences.images,
        segments.sequences.mirrors,
        rays.directions,
        rays.solid_angle,
        reflection_factors(segments, exponent),
        exponent,
        free_space.origin,
        voxel_size,
        power,
        first_reached,
    )
    # A voxel that a solid cuts is lit over its free part only; at least one free-space voxel's worth.
    total = power / voxel_size**3 / np.maximum(free_share, 1.0 / refinement**3)
    free = free_share > 0.5
    count = max(1, int(np.count_nonzero(free)))
    coverage = tuple(float(np.count_nonzero(free & (first_reached <= k)) / count) for k in range(depths))
    return PathPrior(origin=free_space.origin, voxel_size=voxel_size, total=total, coverage=coverage)


@numba.njit(cache=True, nogil=True)
def _fill(
    sequence: Any,
    start: Any,
    end: Any,
    images: Any,
    mirrors: Any,
    directions: Any,
    solid_angle: Any,
    factors: Any,
    exponent: Any,
    origin: Any,
    voxel: Any,
    power: Any,
    reached: Any,
) -> None:
    nx, ny, nz = power.shape
    heading = np.empty(3)
    for ray in range(sequence.shape[0]):
        phase = (ray * GOLDEN_RATIO) % 1.0
        for depth in range(sequence.shape[1]):
            seq = sequence[ray, depth]
            if seq < 0:
                break
            for i in range(3):
                heading[i] = (
                    mirrors[seq, i, 0] * directions[ray, 0]
                    + mirrors[seq, i, 1] * directions[ray, 1]
                    + mirrors[seq, i, 2] * directions[ray, 2]
                )
            span = end[ray, depth] - start[ray, depth]
            steps = int(np.ceil(span / (0.5 * voxel)))
            for step in range(steps):
                length = start[ray, depth] + (step + phase) * span / steps
                ix = int(np.floor((images[seq, 0] + length * heading[0] - origin[0]) / voxel))
                iy = int(np.floor((images[seq, 1] + length * heading[1] - origin[1]) / voxel))
                iz = int(np.floor((images[seq, 2] + length * heading[2] - origin[2]) / voxel))
                if 0 <= ix < nx and 0 <= iy < ny and 0 <= iz < nz:
                    volume = solid_angle[ray] * length * length * span / steps
                    # Bounded next to the station, where a voxel's mean gain has no limit.
                    reach = max(length, 0.5 * voxel)
                    power[ix, iy, iz] += volume * factors[ray, depth] * reach ** (-2.0 * exponent)
                    reached[ix, iy, iz] = min(reached[ix, iy, iz], depth)
