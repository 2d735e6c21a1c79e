"""Normalise a level's components: at each position, the probabilities of its paths should add up to 1.

For a UE at x, a station reports one of the paths to x. The level's density at x, integrated over all directions and
lengths, is the *total probability* of x and should be 1 wherever the station is audible. Gaussians are smooth where
beams end, at walls and shadow boundaries: the total is too small there and too large beside them. For one station this
matters little. A fusion multiplies the densities of several stations: the error is raised to their number, and the
posterior is biased towards the middle of the room.

The weight of a component is multiplied by the mean of 1 / total over the free positions that it covers. As this changes
the totals, it is repeated (the iteration of W. H. Richardson, "Bayesian-based iterative method of image restoration",
J. Opt. Soc. Am. 62 (1), 1972, for a uniform image). A round changes no component by more than a factor of two: where
the total is much smaller than 1, the station is not audible, and the density has leaked from elsewhere.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.fit.settings import BalanceSettings
from rayfix_tables.compact.expanding import expanded_tubes
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.conditioning import Conditioned, MeasuredCells, condition_on_angle
from rayfix_tables.gaussians.constants import LOG_2PI
from rayfix_tables.gaussians.definite import cholesky_factors
from rayfix_tables.gaussians.normal_points import normal_points
from rayfix_tables.level import Level

_CHUNK = 2**16
"""Number of components that are conditioned at a time."""

Array = NDArray[np.float64]


def balancing_steps(level: Level, settings: BalanceSettings | None = None) -> int:
    """Count the steps of :func:`balanced`: each component is conditioned once and reweighted in each round."""
    return len(level.mixture) * (1 + (settings or BalanceSettings()).rounds)


def balanced(
    level: Level,
    free_space: FreeSpace,
    settings: BalanceSettings | None = None,
    *,
    advance: Callable[[int], None] = lambda steps: None,
) -> Level:
    """Compute the ``log_balance`` of a level.

    Parameters
    ----------
    level : Level
    free_space : FreeSpace
        Of the scene that the level was made for.
    settings : BalanceSettings, optional
    advance : callable, optional
        Called with the number of steps that were taken since the last call.
    """
    settings = settings or BalanceSettings()
    if not len(level.mixture):
        return replace(level, log_balance=level.log_balance[:0])
    positions = _positions(level, settings, advance)
    points = np.array(normal_points(settings.num_points))
    blocks = _blocks(free_space, settings.block_size)
    most = settings.max_factor
    weight = positions.weight.copy()
    log_balance = np.zeros(len(weight))
    for _ in range(settings.rounds):
        total = _total_probability(weight, positions, points, blocks)
        ratio = np.where(total > 0.0, 1.0 / np.clip(total, 1.0 / most, most), 1.0)
        gain = np.empty(len(weight))
        _gather(positions.mean, positions.root, points, *blocks.voxels, ratio, gain)
        weight *= gain
        log_balance += np.log(gain)
        advance(len(weight))
    return replace(level, log_balance=log_balance.astype(np.float16 if level.is_compact else np.float32))


class _Positions(NamedTuple):
    """Distribution of the position of each component, over all directions that may be measured.

    Attributes
    ----------
    weight : ndarray of shape (n,), m3
        Integral of the component's probability over positions and directions.
    mean : ndarray of shape (n, 3), m
    root : ndarray of shape (n, 3, 3), m
        Lower triangular; root root' is the covariance of the position.
    """

    weight: Array
    mean: NDArray[np.float32]
    root: NDArray[np.float32]


class _Blocks(NamedTuple):
    """Blocks of voxels.

    Attributes
    ----------
    side : int
        Voxels along a side.
    volume : ndarray of shape (nx, ny, nz), m3
        Of the free part.
    """

    origin: Array
    voxel_size: float
    free: NDArray[np.bool_]
    side: int
    volume: Array

    @property
    def voxels(self) -> tuple[Array, float, NDArray[np.bool_], int]:
        """The fields that the kernels need."""
        return self.origin, self.voxel_size, self.free, self.side


def _positions(level: Level, settings: BalanceSettings, advance: Callable[[int], None]) -> _Positions:
    """Condition all cells on a measurement in the middle of the cell, with the noise that the window is for.

    Multiplied by the cells' solid angles, this sums over all directions that may be measured.
    """
    window = level.window**2
    noise = window / settings.window_ratio**2
    left = window - noise
    log_factor = np.repeat(np.log(level.grid.solid_angles), level.grid.ring_cells) + level.cell_log_mass
    log_factor += LOG_2PI + 2.0 * np.log(window) - np.log(left)
    count = len(level.mixture)
    weight = np.empty(count)
    mean, root = np.empty((count, 3), np.float32), np.empty((count, 3, 3), np.float32)
    for first, last in level.ranges(_CHUNK):
        begin, end = int(level.cell_offsets[first]), int(level.cell_offsets[last])
        cells = slice(first, last)
        log_evidence, at, cov = np.empty(end - begin), np.empty((end - begin, 4)), np.empty((end - begin, 4, 4))
        measured = MeasuredCells(
            begins=np.asarray(level.cell_offsets[:-1][cells], np.int64) - begin,
            ends=np.asarray(level.cell_offsets[1:][cells], np.int64) - begin,
            rest_mean=np.zeros((last - first, 2)),
            rest_cov=np.repeat(np.array([[1.0, 0.0, 1.0]]) * window * noise / left, last - first, axis=0),
            log_factor=log_factor[cells],
        )
        condition_on_angle(expanded_tubes(level.mixture, begin, end), measured, Conditioned(log_evidence, at, cov))
        weight[begin:end], mean[begin:end] = np.exp(log_evidence), at[:, :3]
        root[begin:end], definite = cholesky_factors(cov[:, :3, :3] + settings.thickness * np.eye(3))
        # A component without a covariance has no position: it adds to no block, and its weight does not change.
        mean[begin:end][~definite] = np.nan
        advance(end - begin)
    return _Positions(weight, mean, root)


def _blocks(free_space: FreeSpace, size: float) -> _Blocks:
    side = max(1, round(size / free_space.voxel_size))
    shape = -(-np.array(free_space.free.shape) // side)
    padded = np.zeros(shape * side)
    nx, ny, nz = free_space.free.shape
    padded[:nx, :ny, :nz] = free_space.free
    count = padded.reshape(shape[0], side, shape[1], side, shape[2], side).sum(axis=(1, 3, 5))
    return _Blocks(
        origin=np.array(free_space.origin, np.float64),
        voxel_size=free_space.voxel_size,
        free=np.array(free_space.free, np.bool_),
        side=side,
        volume=count * free_space.voxel_size**3,
    )


def _total_probability(weight: Array, positions: _Positions, points: Array, blocks: _Blocks) -> Array:
    mass = np.zeros_like(blocks.volume)
    _spread(weight, positions.mean, positions.root, points, *blocks.voxels, mass)
    return np.divide(mass, blocks.volume, out=np.zeros_like(mass), where=blocks.volume > 0.0)


@numba.njit(cache=True, nogil=True)
def _block_of(x: Any, y: Any, z: Any, free: Any, side: Any, shape: Any) -> Any:
    """Index of the block of a position in C order, -1 if it is not free; coordinates are in voxels."""
    nx, ny, nz = free.shape
    i, j, k = np.floor(x), np.floor(y), np.floor(z)
    if not (0 <= i < nx and 0 <= j < ny and 0 <= k < nz and free[int(i), int(j), int(k)]):
        return -1
    return (int(i) // side * shape[1] + int(j) // side) * shape[2] + int(k) // side


@numba.njit(cache=True, nogil=True)
def _blocks_of(mean: Any, root: Any, points: Any, origin: Any, voxel_size: Any, free: Any, side: Any, out: Any) -> None:
    """Find the blocks of a component's points."""
    shape = (0, -(-free.shape[1] // side), -(-free.shape[2] // side))
    x0, y0, z0 = mean[0] - origin[0], mean[1] - origin[1], mean[2] - origin[2]
    xx, yx, yy, zx, zy, zz = root[0, 0], root[1, 0], root[1, 1], root[2, 0], root[2, 1], root[2, 2]
    for n in range(len(points)):
        p, q, r = points[n, 0], points[n, 1], points[n, 2]
        x, y, z = x0 + xx * p, y0 + (yx * p + yy * q), z0 + (zx * p + zy * q + zz * r)
        out[n] = _block_of(x / voxel_size, y / voxel_size, z / voxel_size, free, side, shape)


@numba.njit(cache=True, nogil=True)
def _spread(
    weight: Any, mean: Any, root: Any, points: Any, origin: Any, voxel_size: Any, free: Any, side: Any, mass: Any
) -> None:
    """Add the components' weights to the blocks that contain their points."""
    flat = mass.reshape(-1)
    blocks = np.empty(len(points), np.int64)
    for n in range(len(weight)):
        each = weight[n] / len(points)
        _blocks_of(mean[n], root[n], points, origin, voxel_size, free, side, blocks)
        for block in blocks:
            if block >= 0:
                flat[block] += each


@numba.njit(cache=True, nogil=True)
def _gather(
    mean: Any,
    root: Any,
    points: Any,
    origin: Any,
    voxel_size: Any,
    free: Any,
    side: Any,
    values: Any,
    out: Any,
) -> None:
    """Means of the blocks' values over the free points of each component; 1 if none is free."""
    flat = values.reshape(-1)
    blocks = np.empty(len(points), np.int64)
    for n in range(len(mean)):
        total, count = 0.0, 0
        _blocks_of(mean[n], root[n], points, origin, voxel_size, free, side, blocks)
        for block in blocks:
            if block >= 0:
                total += flat[block]
                count += 1
        out[n] = total / count if count else 1.0
