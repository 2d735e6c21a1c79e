"""Likelihoods of directions that no product of an azimuth's and a zenith's is: slanted ellipses and tilted meridians.

The windows of all cells, times the cells' areas, add up to one: ``sum_c area_c N(a_c; 0, W) = 1``. So any likelihood is
the sum over cells of itself times their windows, and within each window it is close to the Gaussian that it is there to
first order. That takes more cells than :mod:`rayfix_service.fusion.lookup.lookup` needs for axes of azimuth and zenith,
and no assumption on the likelihood's shape.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.gaussians.constants import LOG_2PI
from rayfix_tables.geometry.angles import angles_of, direction, tangent, wrap
from rayfix_tables.grid import AngularGrid

_REACH = 3.5
"""Cells within this many standard deviations, of window and measurement together, are summed."""

_ACROSS = 30.0
"""Standard deviation, rad, that stands for no knowledge along a meridian."""

Array = NDArray[np.float64]


class CellSum(NamedTuple):
    """Cells, and what their entries are to be multiplied by.

    Attributes
    ----------
    cells : ndarray of int64, shape (n,)
    rest_mean : ndarray of shape (n, 2), rad
        In the cells' tangent planes.
    rest_cov : ndarray of shape (n, 3), rad2
        Packed: horizontal variance, covariance, vertical variance.
    log_factor : ndarray of shape (n,)
    """

    cells: NDArray[np.int64]
    rest_mean: Array
    rest_cov: Array
    log_factor: Array


def sum_of_ellipse(grid: AngularGrid, window: float, azimuth: float, zenith: float, cov: Array) -> CellSum:
    """Likelihood of both angles with correlated errors, per steradian.

    Parameters
    ----------
    window : float, rad
        Standard deviation of the cells' windows.
    azimuth, zenith : float, rad
    cov : ndarray of shape (2, 2), rad2
    """
    rest_mean = tangent(azimuth, zenith, grid.centres[:, 0], grid.centres[:, 1])
    sine = np.sin(grid.centres[:, 1])
    hh, hv, vv = cov[0, 0] * sine**2, cov[0, 1] * sine, np.full(len(sine), cov[1, 1])
    both_h, both_v = hh + window**2, vv + window**2
    square = (
        both_v * rest_mean[:, 0] ** 2 - 2.0 * hv * rest_mean[:, 0] * rest_mean[:, 1] + both_h * rest_mean[:, 1] ** 2
    )
    cells = np.flatnonzero(square <= _REACH**2 * (both_h * both_v - hv**2))
    # Tangent coordinates stretch the azimuth's density by 1 / sine; a steradian is meant where the measurement lies.
    rings = grid.num_rings
    per_angle = float(np.sin((min(int(zenith * rings / np.pi), rings - 1) + 0.5) * np.pi / rings))
    return CellSum(
        cells,
        rest_mean[cells],
        np.stack([hh, hv, vv], axis=-1)[cells],
        _log_area(grid)[cells] + np.log(sine[cells] / per_angle),
    )


def sum_of_meridian(grid: AngularGrid, window: float, azimuth: float, stdev: float, rotation: Array) -> CellSum:
    """Likelihood of an azimuth alone in a frame whose z axis is tilted, per radian.

    Parameters
    ----------
    azimuth, stdev : float, rad
        In the tilted frame.
    rotation : ndarray of shape (3, 3)
        Takes vectors of the tilted frame into the scene's.
    """
    centres = grid.centres
    towards = direction(centres[:, 0], centres[:, 1])
    local_azimuth, local_zenith = angles_of(towards @ rotation)
    sine = np.sin(local_zenith)
    apart = wrap(azimuth - local_azimuth)
    # Beyond the poles of the tilted frame the meridian is another one.
    near = np.abs(apart) < 0.5 * np.pi
    near &= np.abs(sine * apart) <= _REACH * np.hypot(window, sine * stdev)
    cells = np.flatnonzero(near & (sine > 1e-9))
    # Where the tilted frame's azimuth grows, in the cell's tangent plane: a unit vector.
    zeros = np.zeros(len(cells))
    grows = np.stack([-np.sin(local_azimuth[cells]), np.cos(local_azimuth[cells]), zeros], axis=-1) @ rotation.T
    east, south = _basis(centres[cells])
    along = np.stack([(grows * east).sum(axis=1), (grows * south).sum(axis=1)], axis=-1)
    noise, free = (sine[cells] * stdev) ** 2, _ACROSS**2
    h, v = along[:, 0], along[:, 1]
    rest_cov = np.stack([noise * h**2 + free * v**2, (noise - free) * h * v, noise * v**2 + free * h**2], axis=-1)
    return CellSum(
        cells,
        (sine * apart)[cells, None] * along,
        rest_cov,
        _log_area(grid)[cells] + np.log(sine[cells]) + 0.5 * LOG_2PI + np.log(_ACROSS),
    )


def _basis(centres: Array) -> tuple[Array, Array]:
    """Give the unit vectors of growing azimuth and zenith, each of shape (n, 3)."""
    azimuth, zenith = centres[:, 0], centres[:, 1]
    east = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(azimuth))], axis=-1)
    return east, direction(azimuth, zenith + 0.5 * np.pi)


def _log_area(grid: AngularGrid) -> Array:
    """Logarithm of each cell's area in its tangent plane, rad2."""
    height = np.pi / grid.num_rings
    width = 2.0 * np.pi / np.repeat(grid.ring_cells, grid.ring_cells)
    return np.asarray(np.log(height * width * np.sin(grid.centres[:, 1])))
