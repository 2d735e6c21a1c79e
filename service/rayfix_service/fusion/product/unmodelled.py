"""Paths that the table does not know: round an edge, off a rough surface, off what is not in the twin.

Such a path is no outlier, which may be anything: it comes from about where the target is, and is longer than the
straight one. Its density at a position x, in the units of the factors, is a sum of two of the form

    p(y | x) = vMF(measured direction; direction of x, kappa) * E[ N(measured length; |x| + d, variance) ]

with x from the station on, a von Mises-Fisher density over directions, and a detour d. Paths that hardly bend have a
narrow density and no detour, others a broad one and a detour of exponential density. That is taken for a few Gaussians
of its moments between quantiles, so that its convolution with the error of a length is a sum of Gaussians as well.
Times against a clock that is not known may be any. Without azimuth and zenith such a path would tell little, and is
left to the outliers.

The quadrature evaluates it at each point (:func:`unmodelled_density`); among the Gaussians of tubes it is further
Gaussians, each of which has the moments of a slice of the cone (:func:`unmodelled_columns`).
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.line_of_sight import line_of_sight_weights
from rayfix_service.fusion.measurements.observations import Observation
from rayfix_service.fusion.product.factor_kernels import READING, to_columns
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.gaussians.triangles import triangle

_ENDS = (0.0, 0.35, 0.9, 1.9, math.inf)
"""Ends of the slices that Gaussians stand for, in means of the detour."""

_NEAR, _NEAR_SPREAD = 0.3, 0.25
"""Share of paths that bend so little that they come from about where the target is: their direction spreads by so many
times that of the others, and they are hardly longer than the straight path."""

_RATIO = 1.6
"""Ends of slices of distance where no length is measured: each is so many times the one before."""

_NEAREST = 0.5
"""Distance of the first slice's end, m."""

Array = NDArray[np.float64]


class UnmodelledPath(NamedTuple):
    """Density of a measured path that the table does not know, as kernels take it.

    Attributes
    ----------
    station : ndarray of shape (3,), m
    heading : ndarray of shape (3,)
        Measured direction.
    terms : ndarray of shape (n, 4)
        Weight, which includes the prior probability and the greatest density of a direction, concentration of the
        direction, and mean [m] and variance [m2] of a Gaussian over the distance of x, infinite where no length was
        measured.
    probability : float
        Prior probability that the path is one of these.
    """

    station: Array
    heading: Array
    terms: Array
    probability: float


def unmodelled_path(
    observation: Observation,
    lengths: Sequence[tuple[float, float, float]],
    station: Array,
    log_any_time: float,
    settings: FusionSettings,
) -> UnmodelledPath | None:
    """Return the density of an unmodelled path, None where such paths are not considered or tell nothing.

    Parameters
    ----------
    observation : Observation
    lengths : sequence of tuple
        Log weight, value [m] and variance [m2] of each Gaussian that the path's length may be of.
    station : ndarray of shape (3,), m
    log_any_time : float
        Log density of the observation's times where they may be any.
    settings : FusionSettings
    """
    measured = observation.direction
    timed = bool(observation.lengths) and not observation.readings
    probability = settings.unmodelled_probability if timed else settings.unmodelled_without_length
    if probability == 0.0 or measured.azimuth is None or measured.zenith is None:
        return None
    weight = probability
    if observation.los_probability is not None:
        weight *= math.exp(line_of_sight_weights(observation.los_probability, settings.sight_error).log_reflected)
    sine = math.sin(measured.zenith)
    heading = (sine * math.cos(measured.azimuth), sine * math.sin(measured.azimuth), math.cos(measured.zenith))
    if not timed:
        lengths = [(log_any_time, 0.0, math.inf)]
    terms = [
        (weight * share * math.exp(log_weight), kappa, value - mean, variance + spread)
        for share, kappa, mean, spread in _ways(settings, timed)
        for log_weight, value, variance in lengths
    ]
    return UnmodelledPath(station, np.array(heading), np.array(terms), probability)


@lru_cache(maxsize=8)
def _ways(settings: FusionSettings, timed: bool) -> tuple[tuple[float, float, float, float], ...]:
    """Weight, concentration of the direction, mean [m] and variance [m2] of the detour of each kind of path."""
    found = []
    for share, spread, scale in (
        (_NEAR, _NEAR_SPREAD * settings.unmodelled_spread, 0.0),
        (1.0 - _NEAR, settings.unmodelled_spread, settings.unmodelled_detour),
    ):
        kappa = spread**-2
        peak = kappa / (2.0 * math.pi * -math.expm1(-2.0 * kappa))
        slices = detours() if timed and scale > 0.0 else ((1.0, 0.0, 0.0),)
        found += [(share * peak * part, kappa, scale * mean, scale**2 * square) for part, mean, square in slices]
    return tuple(found)


NO_PATH = UnmodelledPath(np.zeros(3), np.zeros(3), np.empty((0, 4)), 0.0)
"""Where unmodelled paths are left out."""


@lru_cache(maxsize=1)
def detours() -> tuple[tuple[float, float, float], ...]:
    """Share, mean and variance of each slice of an exponential density of mean 1."""
    found = []
    for begin, end in pairwise(_ENDS):
        at_begin, at_end = math.exp(-begin), math.exp(-end)
        share = at_begin - at_end
        # Integrals of t exp(-t) and t^2 exp(-t).
        first = (1.0 + begin) * at_begin - (0.0 if math.isinf(end) else (1.0 + end) * at_end)
        second = (2.0 + 2.0 * begin + begin**2) * at_begin
        second -= 0.0 if math.isinf(end) else (2.0 + 2.0 * end + end**2) * at_end
        found.append((share, first / share, second / share - (first / share) ** 2))
    return tuple(found)


@numba.njit(cache=True, nogil=True)
def unmodelled_gaussians(path: Any, farthest: Any) -> Any:
    """Gaussians over the position that stand for the density of an unmodelled path with a measured direction.

    Each has the moments of a slice: of the Gaussian of a length, or of a part of the cone's length.

    Parameters
    ----------
    path : tuple
        The fields of :class:`UnmodelledPath`.
    farthest : float, m
        Length of the cone where no length was measured.

    Returns
    -------
    log_mass : ndarray of shape (n,)
        Logarithms of their integrals.
    mean : ndarray of shape (n, 4), m
    cov : ndarray of shape (n, 4, 4), m2
        The fourth coordinate means nothing.
    """
    station, heading, terms, _ = path
    slices = 0
    if np.isinf(terms[0, 3]):
        slices = 1 + int(np.ceil(np.log(max(farthest / _NEAREST, 1.1)) / np.log(_RATIO)))
    count = len(terms) if slices == 0 else slices * len(terms)
    log_mass, mean, cov = np.empty(count), np.zeros((count, 4)), np.zeros((count, 4, 4))
    for n in range(count):
        weight, kappa, value, variance = terms[n // max(slices, 1)]
        # A von Mises-Fisher density has the mean cosine c = coth(k) - 1 / k; c / k is the variance along each angle.
        cosine = 1.0 / np.tanh(kappa) - 1.0 / kappa
        aside = cosine / kappa
        weight *= 2.0 * np.pi * -np.expm1(-2.0 * kappa) / kappa
        if slices == 0:
            # Moments of r^2 N(r; m, v).
            m = max(value, 0.5 * np.sqrt(variance))
            mass = m * m + variance
            first = (m**3 + 3.0 * m * variance) / mass
            second = (m**4 + 6.0 * m * m * variance + 3.0 * variance**2) / mass
            log_mass[n] = np.log(weight * mass)
            if value < m:  # most of it would be behind the station
                log_mass[n] -= 0.5 * (m - value) ** 2 / variance
        else:
            end = _NEAREST * _RATIO ** (n % slices)
            begin = end / _RATIO if n % slices else 0.0
            mass = (end**3 - begin**3) / 3.0
            first = (end**4 - begin**4) / 4.0 / mass
            second = (end**5 - begin**5) / 5.0 / mass
            log_mass[n] = np.log(weight * mass)
        along = second * (1.0 - 2.0 * aside) - (cosine * first) ** 2
        across = second * aside
        for i in range(3):
            mean[n, i] = station[i] + cosine * first * heading[i]
            for j in range(3):
                cov[n, i, j] = (along - across) * heading[i] * heading[j]
            cov[n, i, i] += across
        cov[n, 3, 3] = 1.0
    return log_mass, mean, cov


@numba.njit(cache=True, nogil=True)
def unmodelled_columns(path: Any, farthest: Any, dimension: Any) -> Any:
    """Return the same as functions of the state, as ``information_form`` has them, shape (rows, n)."""
    log_mass, mean, cov = unmodelled_gaussians(path, farthest)
    columns = np.empty((triangle(dimension) + dimension + 1, len(log_mass)))
    # A slice, and readings that could be written to: as make_alternatives has them, so that one is compiled for both.
    to_columns(log_mass, mean, cov, np.empty(0, READING), dimension, columns[:, : len(log_mass)])
    return columns


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def unmodelled_density(path: Any, x: Any, y: Any, z: Any, spread: Any) -> Any:
    """Density of an unmodelled path at a place, averaged over its surroundings, and what it tells of the position.

    Parameters
    ----------
    path : tuple
        The fields of :class:`UnmodelledPath`.
    x, y, z : float, m
    spread : float, m2
        Variance of a position in the surroundings along each axis.

    Returns
    -------
    density : float
    told : float, 1 / m2
        Information about the position times the density.
    """
    station, heading, terms, _ = path
    density, told = 0.0, 0.0
    if len(terms) > 0:
        x, y, z = x - station[0], y - station[1], z - station[2]
        square = max(x * x + y * y + z * z, spread, 1e-6)
        distance = np.sqrt(square)
        aside = 1.0 - (heading[0] * x + heading[1] * y + heading[2] * z) / distance
        for n in range(len(terms)):
            weight, kappa, value, variance = terms[n]
            sharper = 1.0 + kappa * spread / square
            exponent, information = kappa / sharper * aside, kappa / square
            if variance < np.inf:
                apart, wide = distance - value, variance + spread
                exponent += 0.5 * apart * apart / wide
                information += 1.0 / variance
                sharper *= np.sqrt(2.0 * np.pi * wide)
            own = weight * np.exp(-exponent) / sharper
            density += own
            told += own * information
    return density, told
