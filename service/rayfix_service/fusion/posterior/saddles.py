"""Unite maxima of a mixture of Gaussians between which its density hardly falls.

A sum of Gaussians that stands for one wide peak ripples: each ripple is a maximum of its own, though the posterior that
the sum approximates has one. Two maxima are of one mode when the density between them stays near the lower of the two.
"""

from typing import Any

import numba
import numpy as np

_POINTS = 7
"""Points between two maxima at which the density is looked at."""

_NEGLIGIBLE = 20.0
"""A Gaussian that is this much below the density at its best, nats, is left out."""


@numba.njit(cache=True, nogil=True)
def unite_maxima(
    log_density: Any, mean: Any, precision: Any, top: Any, curvature: Any, depth: Any, reach: Any, stop: Any
) -> Any:
    """Unite maxima, each with those to which it is connected.

    Parameters
    ----------
    log_density : ndarray of shape (h,)
        Logarithm of each Gaussian's density at its mean, up to a common constant.
    mean : ndarray of shape (h, 3), m
    precision : ndarray of shape (h, 3, 3), 1 / m2
    top : ndarray of shape (m, 3), m
        The maxima.
    curvature : ndarray of shape (m, 3, 3), 1 / m2
        Mean precision of the Gaussians there.
    depth : float, nats
        Two maxima are connected when the density on the line between them falls by less than this below the lower one.
    reach : float
        Maxima farther apart than this, as squared Mahalanobis distance under either curvature, are not connected.
    stop : ndarray of uint8, shape (1,)
        Once it is set, the maxima that are left stay as they are.

    Returns
    -------
    ndarray of int64, shape (m,)
        Of each maximum, the first one of its mode.
    """
    count = len(top)
    first = np.arange(count)
    if count < 2:
        return first
    height = np.empty(count)
    for n in range(count):
        height[n] = _log_mixture(log_density, mean, precision, top[n])
    for b in range(1, count):
        for a in range(b - 1, -1, -1):
            if stop[0] != 0:
                break
            if _root(first, a) == _root(first, b):
                continue
            if (
                min(squared_distance(top[a], top[b], curvature[a]), squared_distance(top[a], top[b], curvature[b]))
                > reach
            ):
                continue
            if _connected(log_density, mean, precision, top[a], top[b], min(height[a], height[b]) - depth):
                low, high = min(_root(first, a), _root(first, b)), max(_root(first, a), _root(first, b))
                first[high] = low
    for n in range(count):
        first[n] = _root(first, n)
    return first


@numba.njit(cache=True, nogil=True)
def _root(first: Any, n: Any) -> Any:
    """Follow a forest from an entry to its root."""
    while first[n] != n:
        n = first[n]
    return n


@numba.njit(cache=True, nogil=True)
def _connected(log_density: Any, mean: Any, precision: Any, a: Any, b: Any, floor: Any) -> Any:
    """Whether the density stays above a floor on the line between two points, looked at from its middle outwards."""
    point = np.empty(3)
    for step in range(_POINTS):
        offset = (step + 1) // 2 if step % 2 else -(step // 2)
        fraction = 0.5 + offset / (_POINTS + 1)
        for i in range(3):
            point[i] = a[i] + fraction * (b[i] - a[i])
        if _log_mixture(log_density, mean, precision, point) < floor:
            return False
    return True


@numba.njit(cache=True, nogil=True)
def _log_mixture(log_density: Any, mean: Any, precision: Any, point: Any) -> Any:
    """Logarithm of the mixture's density at a point, up to the constant of ``log_density``."""
    highest, total = -np.inf, 0.0
    for h in range(len(log_density)):
        if log_density[h] < highest - _NEGLIGIBLE:
            continue
        value = log_density[h] - 0.5 * squared_distance(point, mean[h], precision[h])
        if value > highest:
            total = total * np.exp(highest - value) + 1.0
            highest = value
        elif value > highest - _NEGLIGIBLE:
            total += np.exp(value - highest)
    return highest + np.log(total)


@numba.njit(cache=True, nogil=True)
def squared_distance(x: Any, y: Any, precision: Any) -> Any:
    """Square of the Mahalanobis distance."""
    a, b, c = x[0] - y[0], x[1] - y[1], x[2] - y[2]
    straight = a * a * precision[0, 0] + b * b * precision[1, 1] + c * c * precision[2, 2]
    return straight + 2.0 * (a * b * precision[1, 0] + a * c * precision[2, 0] + b * c * precision[2, 1])
