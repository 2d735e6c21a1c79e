"""Find the cells of the table that answer an angle, and what is left of the measurement beside their windows.

A cell's entry already holds its window N(.; 0, W). For a measured angle ``a`` with covariance R the entry is
multiplied by what remains, ``f N(.; a_rest, R_rest)`` with ``R_rest^-1 = R^-1 - W^-1`` and ``a_rest = R_rest R^-1 a``,
so that the product is N(.; a, R) exactly: the grid's quantisation costs nothing to first order. With D = W - R this is

    R_rest = W D^-1 R        a_rest = W D^-1 a        log f = log(2 pi |W| / sqrt|D|) + a . D^-1 a / 2

Where R is wider than the coarsest window allows, it is split into R' that fits and the excess R - R', and the cells
along that axis are summed, weighted by their distance from ``a``. An angle that is not measured is the limit of it:
all cells alike.

What the factor approximates is the density of the measured angle per steradian when both angles were measured, per
radian when one was, and 1 when none was.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.lookup.partition_of_unity import sum_of_ellipse, sum_of_meridian
from rayfix_service.fusion.measurements.directions import Direction
from rayfix_tables.gaussians.constants import LOG_2PI
from rayfix_tables.geometry.angles import wrap
from rayfix_tables.level import WINDOW_RATIO, Level

_SUM_REACH = 3.0
"""Cells within this many standard deviations of their weights are summed."""

_LEAST_SPREAD = 0.6
"""Least standard deviation of the weights of a sum, in steps from cell to cell: narrower ones would not add up to 1."""

_LEAST_CORRELATION = 1e-3
"""Correlation of errors below which a sum along azimuths and zeniths leaves it aside."""

_MERIDIAN_WINDOW = float(np.deg2rad(4.0))
"""Narrower windows are not summed along a tilted meridian, which is straight enough over these."""

SUM_RATIO = 1.6
"""Noise up to this many times what a window serves is looked up in the sum of some ten cells.

A cell of the next window is merged for noise of its own size: for hardly more noise than this window serves, its
components are too wide.
"""


class Lookup(NamedTuple):
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
    """Look a direction up in the finest level whose window holds its noise, or in cells of it around that hold it.

    Parameters
    ----------
    levels : tuple of Level
        Finest first.
    """
    summed = levels[-1]
    if measured.azimuth is not None and measured.zenith is not None:
        (var_azimuth, covariance), (_, var_zenith) = measured.cov.tolist()
        for level in levels:
            cell, azimuth, zenith = level.grid.cell_around(measured.azimuth, measured.zenith)
            sine = math.sin(zenith)
            # The noise in the cell's tangent plane.
            hh, hv, vv = var_azimuth * sine**2, covariance * sine, var_zenith
            largest = 0.5 * (hh + vv) + math.hypot(0.5 * (hh - vv), hv)
            if largest <= _limit(level):
                turn = math.remainder(measured.azimuth - azimuth, 2.0 * math.pi)
                offset = (sine * turn, measured.zenith - zenith)
                return _single_cell(level, cell, offset, (hh, hv, vv))
            if largest <= SUM_RATIO**2 * _limit(level):
                summed = level
                break
        # Next to a pole, an azimuth of the array's own frame may have no variance left in the scene's.
        whole = math.sqrt(var_azimuth * var_zenith)
        if abs(covariance) > _LEAST_CORRELATION * whole > 0.0:
            ellipse = sum_of_ellipse(summed.grid, summed.window, measured.azimuth, measured.zenith, measured.cov)
            return Lookup(level=summed, **ellipse._asdict())
    elif measured.azimuth is not None and measured.local is not None:
        stdev = float(np.sqrt(measured.cov[0, 0]))
        level = next((level for level in levels if level.window >= max(_MERIDIAN_WINDOW, stdev)), levels[-1])
        meridian = sum_of_meridian(level.grid, level.window, measured.azimuth, stdev, measured.local.to_scene)
        return Lookup(level=level, **meridian._asdict())
    return _cell_sum(summed, measured)


def _limit(level: Level) -> float:
    """Largest variance that the level's window serves."""
    # Degrees become radians with rounding: 12 degrees must not just miss a window of 15.
    return (level.window / WINDOW_RATIO) ** 2 * (1.0 + 1e-9)


def _single_cell(level: Level, cell: int, offset: tuple[float, float], noise: tuple[float, float, float]) -> Lookup:
    """Look up in one cell, from which the measurement is ``offset`` away, with noise of a packed covariance."""
    (a_h, a_v), (hh, hv, vv) = offset, noise
    window = level.window**2
    d_hh, d_vv = window - hh, window - vv
    det = d_hh * d_vv - hv * hv
    # D^-1 = [[d_vv, hv], [hv, d_hh]] / det
    g_h, g_v = (d_vv * a_h + hv * a_v) / det, (hv * a_h + d_hh * a_v) / det
    scale = window / det
    rest = [(d_vv * hh + hv * hv) * scale, window * hv * scale, (d_hh * vv + hv * hv) * scale]
    log_factor = LOG_2PI + 2.0 * math.log(window) - 0.5 * math.log(det) + 0.5 * (a_h * g_h + a_v * g_v)
    mean = [window * g_h, window * g_v]
    return Lookup(level, np.array([cell]), np.array([mean]), np.array([rest]), np.array([log_factor]))


def _cell_sum(level: Level, measured: Direction) -> Lookup:
    """Sum cells along the axes whose noise is too wide, as if the errors were not correlated."""
    num_rings = level.grid.num_rings
    height = np.pi / num_rings
    zeniths = (np.arange(num_rings) + 0.5) * height
    limit, window = _limit(level), level.window**2
    if measured.zenith is None:
        rings, vertical, log_rings = _share(np.zeros(num_rings), np.inf, limit, height)
        per_angle = 1.0
    else:
        from_rings = np.asarray(measured.zenith - zeniths, np.float64)
        rings, vertical, log_rings = _share(from_rings, measured.cov[1, 1], limit, height)
        per_angle = float(np.sin(zeniths[np.argmin(np.abs(from_rings))]))
    var_v, rest_v, log_v = _remainder(vertical, min(measured.cov[1, 1], limit), window)
    cells, means, variances, logs = [], [], [], []
    for n, ring in enumerate(rings):
        count, sine = int(level.grid.ring_cells[ring]), float(np.sin(zeniths[ring]))
        width = 2.0 * np.pi / count
        if measured.azimuth is None:
            variance, log_sine = np.inf, 0.0
            offset = np.zeros(count)
        else:
            # Tangent coordinates stretch the azimuth's density by 1 / sine.
            variance, log_sine = measured.cov[0, 0] * sine**2, np.log(sine / per_angle)
            offset = sine * wrap(measured.azimuth - (-np.pi + (np.arange(count) + 0.5) * width))
        steps, horizontal, log_steps = _share(offset, variance, limit, sine * width)
        var_h, rest_h, log_h = _remainder(horizontal, min(variance, limit), window)
        cells.append(level.grid.ring_offsets[ring] + steps)
        means.append(np.stack([rest_h, np.full(len(steps), rest_v[n])], axis=-1))
        variances.append(np.broadcast_to([var_h, 0.0, var_v], (len(steps), 3)))
        logs.append(log_h + log_steps + (log_v[n] + log_rings[n] + log_sine))
    return Lookup(
        level=level,
        cells=np.concatenate(cells),
        rest_mean=np.concatenate(means),
        rest_cov=np.concatenate(variances),
        log_factor=np.concatenate(logs),
    )


def _share(
    offset: NDArray[np.float64], variance: float, limit: float, step: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Share a measurement among the cells along one axis.

    Parameters
    ----------
    offset : ndarray of shape (n,), rad
        Of the measurement from each cell's centre.
    variance : float, rad2
        Of the measurement; infinite when there is none.
    limit : float, rad2
        Largest variance that one cell takes.
    step : float, rad
        From cell to cell.

    Returns
    -------
    index : ndarray of int64, shape (m,)
        Cells that take part.
    offset : ndarray of shape (m,), rad
        Of the measurement that each of them gets, of variance at most ``limit``.
    log_weight : ndarray of shape (m,)
    """
    excess = variance - limit
    if excess <= 0.0:
        nearest = int(np.argmin(np.abs(offset)))
        return np.array([nearest]), offset[nearest : nearest + 1], np.zeros(1)
    if np.isinf(excess):
        return np.arange(len(offset)), np.zeros(len(offset)), np.full(len(offset), np.log(step))
    spread = max(excess, (_LEAST_SPREAD * step) ** 2)
    index = np.flatnonzero(np.abs(offset) <= _SUM_REACH * np.sqrt(spread))
    # Where the weights are wider than the excess, moving the parts towards the measurement makes up for it.
    moved = (1.0 - np.sqrt(excess / spread)) * offset[index]
    return index, moved, _log_normal(offset[index], spread) + np.log(step)


def _remainder(
    offset: NDArray[np.float64], variance: float, window: float
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """``R_rest``, ``a_rest`` and log f along one axis, where W is ``window``."""
    left = window - variance
    log_factor = 0.5 * (LOG_2PI + 2.0 * np.log(window) - np.log(left) + offset**2 / left)
    return window * variance / left, window * offset / left, log_factor


def _log_normal(offset: NDArray[np.float64], variance: float) -> NDArray[np.float64]:
    return np.asarray(-0.5 * (offset**2 / variance + np.log(variance) + LOG_2PI))
