"""Find the cells of the table that answer an angle, and what is left of the measurement beside their windows.

A cell's entry already holds its window N(a; 0, W). For a measured angle ``a`` with covariance R the entry is
multiplied by what remains, N(.; a_rest, R_rest) with ``R_rest^-1 = R^-1 - W^-1`` and ``a_rest = R_rest R^-1 a``, so
that the product is N(.; a, R) exactly: the grid's quantisation costs nothing to first order.

Where R is wider than the coarsest window allows, it is split into R' that fits and D = R - R', and the cells along that
axis are summed with weights N(cell; a, D). An angle that is not measured is the limit of it: all cells alike.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.angles import tangent, wrap
from rayfix_tables.table import Level

WINDOW_RATIO = 1.25
"""A window's standard deviation is at least this times that of a measurement it serves."""

_SUM_REACH = 3.0
"""Cells within this many standard deviations of a wide measurement are summed."""


@dataclass(frozen=True, kw_only=True)
class Direction:
    """A measured direction in the scene frame.

    Attributes
    ----------
    azimuth, zenith : float or None, rad
        None when not measured.
    cov : ndarray of shape (2, 2), rad2
        Covariance of azimuth and zenith; infinite on the diagonal for what was not measured.
    """

    azimuth: float | None
    zenith: float | None
    cov: NDArray[np.float64]


NO_DIRECTION = Direction(azimuth=None, zenith=None, cov=np.diag([np.inf, np.inf]))
"""What a station without an angle has measured."""


@dataclass(frozen=True, kw_only=True)
class Lookup:
    """Cells that answer a direction.

    Attributes
    ----------
    level : Level
    cells : ndarray of int64, shape (n,)
    rest_mean : ndarray of shape (n, 2), rad
        a_rest of each cell, in its tangent plane.
    rest_cov : ndarray of shape (n, 3), rad2
        R_rest of each cell, packed: horizontal variance, covariance, vertical variance.
    log_factor : ndarray of shape (n,)
        Natural logarithm of what the cell's entry and N(.; a_rest, R_rest) are to be multiplied by.
    """

    level: Level
    cells: NDArray[np.int64]
    rest_mean: NDArray[np.float64]
    rest_cov: NDArray[np.float64]
    log_factor: NDArray[np.float64]


def look_up(levels: tuple[Level, ...], measured: Direction) -> Lookup:
    """Look a direction up in the finest level whose window holds its noise.

    Parameters
    ----------
    levels : tuple of Level
        Finest first.
    """
    for level in levels:
        if _limit(level) >= _widest_variance(level, measured):
            return _single_cell(level, measured)
    return _cell_sum(levels[-1], measured)


def _limit(level: Level) -> float:
    """Largest variance that the level's window serves."""
    return (level.window / WINDOW_RATIO) ** 2


def _widest_variance(level: Level, measured: Direction) -> float:
    """Largest variance of the measurement along any axis of its cell's tangent plane."""
    if measured.azimuth is None or measured.zenith is None:
        return np.inf
    cell = int(level.grid.nearest(measured.azimuth, measured.zenith))
    cov = _tangent_cov(measured.cov, level.grid.centres[cell, 1])
    half_sum, half_difference = 0.5 * (cov[0] + cov[2]), 0.5 * (cov[0] - cov[2])
    return float(half_sum + np.hypot(half_difference, cov[1]))


def _tangent_cov(cov: NDArray[np.float64], zenith: float) -> NDArray[np.float64]:
    """Covariance of azimuth and zenith in a tangent plane, packed."""
    sine = np.sin(zenith)
    return np.array([cov[0, 0] * sine * sine, cov[0, 1] * sine, cov[1, 1]])


def _single_cell(level: Level, measured: Direction) -> Lookup:
    assert measured.azimuth is not None
    assert measured.zenith is not None
    cell = int(level.grid.nearest(measured.azimuth, measured.zenith))
    centre_azimuth, centre_zenith = level.grid.centres[cell]
    offset = tangent(measured.azimuth, measured.zenith, centre_azimuth, centre_zenith)
    hh, hv, vv = _tangent_cov(measured.cov, centre_zenith)
    noise = np.array([[hh, hv], [hv, vv]])
    precision = np.linalg.inv(noise)
    rest = np.linalg.inv(precision - np.eye(2) / level.window**2)
    rest_mean = rest @ precision @ offset
    # N(.; a, R) = factor N(.; 0, W) N(.; a_rest, R_rest), compared at the cell's centre.
    log_factor = (
        -0.5 * offset @ precision @ offset
        + 0.5 * rest_mean @ np.linalg.solve(rest, rest_mean)
        + 0.5 * np.log(np.linalg.det(rest) / np.linalg.det(noise))
        + np.log(2.0 * np.pi * level.window**2)
    )
    return Lookup(
        level=level,
        cells=np.array([cell]),
        rest_mean=rest_mean[None],
        rest_cov=np.array([[rest[0, 0], rest[0, 1], rest[1, 1]]]),
        log_factor=np.array([log_factor]),
    )


def _cell_sum(level: Level, measured: Direction) -> Lookup:
    """Sum cells along the axes whose noise is too wide; a correlation of the noise is then left aside."""
    limit = _limit(level)
    cells, means, variances, logs = [], [], [], []
    for ring, vertical, log_ring in zip(*_along_zenith(level, measured), strict=True):
        steps, horizontal, variance, log_step = _along_ring(level, int(ring), measured)
        cells.append(level.grid.ring_offsets[ring] + steps)
        rest_h, var_h, log_h = _remainder(horizontal, variance, level.window**2)
        rest_v, var_v, log_v = _remainder(vertical, min(measured.cov[1, 1], limit), level.window**2)
        means.append(np.stack(np.broadcast_arrays(rest_h, rest_v), axis=-1))
        variances.append(np.broadcast_to([var_h, 0.0, var_v], (len(steps), 3)))
        logs.append(log_h + log_v + log_ring + log_step)
    return Lookup(
        level=level,
        cells=np.concatenate(cells),
        rest_mean=np.concatenate(means),
        rest_cov=np.concatenate(variances),
        log_factor=np.concatenate(logs),
    )


def _along_zenith(
    level: Level, measured: Direction
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Rings to sum over, the offset of the measurement from each, and their log weights."""
    num_rings = level.grid.num_rings
    height = np.pi / num_rings
    centres = (np.arange(num_rings) + 0.5) * height
    if measured.zenith is None:
        return np.arange(num_rings), np.zeros(num_rings), np.full(num_rings, np.log(height))
    spread = measured.cov[1, 1] - _limit(level)
    offset = measured.zenith - centres
    if spread <= 0.0:
        ring = min(max(int(measured.zenith / height), 0), num_rings - 1)
        return np.array([ring]), offset[ring : ring + 1], np.zeros(1)
    rings = np.flatnonzero(np.abs(offset) <= max(_SUM_REACH * np.sqrt(spread), height))
    return rings, np.zeros(len(rings)), _log_normal(offset[rings], spread) + np.log(height)


def _along_ring(
    level: Level, ring: int, measured: Direction
) -> tuple[NDArray[np.int64], NDArray[np.float64], float, NDArray[np.float64]]:
    """Cells of a ring to sum over, the tangent offset from each, the noise that is left, and their log weights."""
    count = int(level.grid.ring_cells[ring])
    sine = float(np.sin((ring + 0.5) * np.pi / level.grid.num_rings))
    width = 2.0 * np.pi / count
    limit = _limit(level)
    if measured.azimuth is None:
        return np.arange(count), np.zeros(count), limit, np.full(count, np.log(sine * width))
    variance = measured.cov[0, 0] * sine**2
    offset = sine * wrap(measured.azimuth - (-np.pi + (np.arange(count) + 0.5) * width))
    if variance <= limit:
        step = int(np.argmin(np.abs(offset)))
        return np.array([step]), offset[step : step + 1], variance, np.zeros(1)
    spread = variance - limit
    steps = np.flatnonzero(np.abs(offset) <= max(_SUM_REACH * np.sqrt(spread), sine * width))
    log_weight = _log_normal(offset[steps], spread) + np.log(sine * width)
    return steps, np.zeros(len(steps)), limit, log_weight


def _remainder(
    offset: NDArray[np.float64], variance: float, window_variance: float
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """``a_rest``, ``R_rest`` and the log factor along one axis."""
    rest_variance = 1.0 / (1.0 / variance - 1.0 / window_variance)
    rest_mean = offset * rest_variance / variance
    at_centre = _log_normal(np.zeros(1), window_variance) + _log_normal(rest_mean, rest_variance)
    return rest_mean, rest_variance, _log_normal(offset, variance) - at_centre


def _log_normal(offset: NDArray[np.float64], variance: float) -> NDArray[np.float64]:
    return np.asarray(-0.5 * (offset**2 / variance + np.log(2.0 * np.pi * variance)))
