"""Held-out log-likelihood of fits, and other common parts of the fit studies."""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.settings import RaySettings
from rayfix_offline.rays.trace import LevelRays, trace_station
from rayfix_offline.site import SiteFile
from rayfix_offline.twin.twin import Twin
from rayfix_tables.compact.tubes import COMPACT_FIELDS
from rayfix_tables.mixture import TubeMixture, joint_cov, unpack

REFERENCE_RATIO = 1.1
"""Slices of the rays that held-out points are drawn from: finer than those of any fit."""

COMPONENT_BYTES = sum(
    int(np.prod(shape, dtype=int)) * np.dtype(dtype).itemsize for dtype, shape in COMPACT_FIELDS.values()
)


def trace_sliced(station: int, site: SiteFile, twin: Twin, ratio: float) -> LevelRays:
    """Trace a station as a build does, but with slices of this ratio."""
    return trace_station(site.stations[station], site, twin, settings=RaySettings(slice_ratio=ratio)).finest


def trace_window(station: int, site: SiteFile, twin: Twin, window_deg: float) -> LevelRays:
    """Trace a station as a build does whose only window this is."""
    alone = site.model_copy(update={"table": site.table.model_copy(update={"windows_deg": (window_deg,)})})
    return trace_station(alone.stations[station], alone, twin).finest


def processor_seconds(run: Callable[[], object]) -> float:
    """Median of three runs."""
    times = []
    for _ in range(3):
        begin = time.thread_time()
        run()
        times.append(time.thread_time() - begin)
    return float(np.median(times))


def log_densities(mixture: TubeMixture, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Log density of points under a cell's stored numbers, in double precision.

    Parameters
    ----------
    points : ndarray of shape (n, 6)
        (path length, horizontal and vertical angle, x, y, z).

    Returns
    -------
    joint : ndarray of shape (n,)
        ``log sum_k w_k N(u) N(x | u)``.
    position : ndarray of shape (n,)
        ``log p(x | u)``.
    """
    u_offset = points[:, :3] - mixture.u_mean.astype(np.float64)[:, None]
    slope, u_cov = mixture.jacobian.astype(np.float64), unpack(mixture.u_cov.astype(np.float64))
    products = u_offset[:, :, :1] * u_offset[:, :, 1:] - u_cov[:, None, 0, 1:]
    widening = products @ np.swapaxes(slope[:, :, 1:], 1, 2) / mixture.u_mean[:, None, :1]
    predicted = mixture.x_mean[:, None] + u_offset @ np.swapaxes(slope, 1, 2) + widening
    log_u = mixture.log_weight[:, None] + _log_normal(u_offset, u_cov)
    log_x = _log_normal(points[:, 3:] - predicted, unpack(mixture.x_cov.astype(np.float64)))
    joint = np.logaddexp.reduce(log_u + log_x, axis=0)
    return joint, joint - np.logaddexp.reduce(log_u, axis=0)


def log_density_as_measured(
    mixture: TubeMixture, points: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Log density of measured points under a cell that knows of the noise of measurements.

    Parameters
    ----------
    points : ndarray of shape (n, 6)
        (path length, horizontal and vertical angle, x, y, z), of which length and angles are measured.
    noise : ndarray of shape (3,)
        Variances of the measured length [m^2] and angles [rad^2].

    Returns
    -------
    ndarray of shape (n,)
    """
    cov = joint_cov(mixture)
    cov[:, range(3), range(3)] += noise
    mean = np.concatenate([mixture.u_mean, mixture.x_mean], axis=1).astype(np.float64)
    log_parts = mixture.log_weight[:, None] + _log_normal(points - mean[:, None], cov)
    return np.asarray(np.logaddexp.reduce(log_parts, axis=0))


def _log_normal(offset: NDArray[np.float64], cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log densities, shape (k, n), of offsets of shape (k, n, d) under k covariances."""
    lower = np.linalg.cholesky(cov)
    white = offset @ np.swapaxes(np.linalg.inv(lower), 1, 2)
    log_det = np.log(np.einsum("kii->ki", lower)).sum(axis=1)
    return np.asarray(-0.5 * (white**2).sum(axis=2) - log_det[:, None] - 0.5 * cov.shape[-1] * np.log(2.0 * np.pi))
