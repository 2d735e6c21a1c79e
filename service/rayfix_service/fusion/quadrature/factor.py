"""The likelihood of positions given the measurements of one path, from the path map.

    p(y | x) = (1 - e - u) sum_k w_k(x) p(angles | direction_k(x)) p(lengths | length_k(x))
               + u p_unmodelled(y | x) + e p_outlier

with the weights w_k and the geometry of the paths k to x, in the units that the factors of Gaussians have
(:mod:`rayfix_service.fusion.product.factors`).
"""

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.product.unmodelled import UnmodelledPath, unmodelled_density

_NEGLIGIBLE = 3e-3
"""Paths that could add no more than this fraction of what others have added, the outlier included, are left out."""

_FAR = 40.0
"""Squared chord, in variances, from which on a direction has nothing to do with the measured one."""


class PathFactor(NamedTuple):
    """Measurements of one path, as the kernel takes them.

    Attributes
    ----------
    turn : ndarray of shape (3, 3)
        Takes directions of the scene to the frame of the measured angles, turned so that the measured azimuth is 0.
    zenith : float, rad
        Measured zenith; NaN when it was not measured.
    cov : ndarray of shape (3,), rad2
        Variance of the azimuth, covariance, variance of the zenith. Infinite for what was not measured.
    spreads : ndarray of shape (s, 2)
        Weight and scale of the Gaussians that the error of the angles may be of.
    kinds : ndarray of shape (k, 4)
        Whether the times are outliers, weight, path length [m] and its variance [m2], infinite where it is not known.
    direct, reflected : float
        Weights of direct paths and of all others, from a line-of-sight indication.
    outlier : float
        Density of the case that all of it is an outlier.
    unmodelled : UnmodelledPath
    """

    turn: NDArray[np.float64]
    zenith: float
    cov: NDArray[np.float64]
    spreads: NDArray[np.float64]
    kinds: NDArray[np.float64]
    direct: float
    reflected: float
    outlier: float
    unmodelled: UnmodelledPath


@numba.njit(cache=True, nogil=True, error_model="numpy")
def evaluate(
    points: Any, blocks: Any, spread: Any, resolution: Any, paths: Any, geometry: Any, factor: Any, out: Any
) -> None:
    """Evaluate the factor of an observation at points.

    Parameters
    ----------
    points : ndarray of shape (n, 3), m
    blocks : ndarray of int64, shape (n,)
        Block of each point.
    spread : float, m2
        Variance of a position in a point's surroundings along each axis.
    resolution : float
        Surroundings are averaged over when their variance times the information of a path is above this.
    paths, geometry, factor : tuple
        Of :class:`.blocks.BlockPaths`; images, mirrors, numbers of reflections, and the measured direction after the
        reflections (:func:`expected_directions`); of :class:`PathFactor`.
    out : tuple of ndarrays of shape (n,)
        Changed in place: the density; the fractions of it that times are outliers, and that all is or that the path is
        none of the map's; the information about the position [1 / m2].
    """
    offsets, sequence, weight, excess, num_walls = paths
    passes = len(excess) > 0
    images, mirrors, reflections, expected = geometry
    turn, zenith, cov, spreads, kinds, direct, reflected, outlier, unmodelled = factor
    density, late, lost, information = out
    with_angle, with_zenith = np.isfinite(cov[0]), np.isfinite(cov[2])
    peak = _peak(zenith, cov, kinds) * max(direct, reflected)
    widest = spreads[:, 1].max()
    angle_variance = max(cov[0], cov[2]) * widest**2
    least_variance = min(cov[0], cov[2]) if with_zenith else cov[0]
    length_variance = kinds[:, 3].min()
    sine, cosine = np.sin(zenith), np.cos(zenith)
    for n in range(len(points)):
        good, bad = 0.0, 0.0
        x, y, z = points[n]
        unknown, sharp = unmodelled_density(unmodelled, x, y, z, spread)
        for path in range(offsets[blocks[n]], offsets[blocks[n] + 1]):
            own = float(weight[path])
            if own * peak < _NEGLIGIBLE * (good + bad + unknown + outlier):
                break
            s = sequence[path]
            own *= direct if reflections[s] == 0 and not (passes and num_walls[path] > 0) else reflected
            x, y, z = points[n, 0] - images[s, 0], points[n, 1] - images[s, 1], points[n, 2] - images[s, 2]
            square = max(x * x + y * y + z * z, spread, 1e-6)
            length = np.sqrt(square)
            told = 1.0 / (least_variance * square) + 1.0 / length_variance
            blur = spread if spread * told > resolution else 0.0
            if with_zenith:
                along = expected[s, 0] * x + expected[s, 1] * y + expected[s, 2] * z
                if 2.0 * (length - along) * length > _FAR * (angle_variance * square + blur):
                    continue
            if with_angle:
                a = mirrors[s, 0, 0] * x + mirrors[s, 1, 0] * y + mirrors[s, 2, 0] * z
                b = mirrors[s, 0, 1] * x + mirrors[s, 1, 1] * y + mirrors[s, 2, 1] * z
                c = mirrors[s, 0, 2] * x + mirrors[s, 1, 2] * y + mirrors[s, 2, 2] * z
                u = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c
                v = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c
                horizontal = max(u * u + v * v, 1e-9 * square)
                azimuth_error = _angle_of(u, v, np.sqrt(horizontal))
                if with_zenith:
                    w = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c
                    across = np.sqrt(horizontal)
                    zenith_error = _angle_of(w * cosine + across * sine, across * cosine - w * sine, length)
                    own *= _of_both(azimuth_error, zenith_error, cov, spreads, blur / horizontal, blur / square) / sine
                else:
                    own *= _of_azimuth(azimuth_error, cov[0], spreads, blur / horizontal)
            added = 0.0
            if passes:
                length += excess[path]
            for k in range(len(kinds)):
                of_length = own * kinds[k, 1]
                if kinds[k, 3] < np.inf:
                    variance = kinds[k, 3] + blur
                    of_length *= np.exp(-0.5 * (length - kinds[k, 2]) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
                added += of_length
                if kinds[k, 0] > 0.0:
                    bad += of_length
                else:
                    good += of_length
            sharp += added * told
        total = good + bad + unknown + outlier
        density[n] = total
        late[n] = bad / total
        lost[n] = (unknown + outlier) / total
        information[n] = sharp / total


@numba.njit(cache=True, nogil=True)
def expected_directions(mirrors: Any, direction: Any) -> Any:
    """Direction of arrival for each sequence if the measured direction were exact, shape (n_sequences, 3)."""
    out = np.empty((len(mirrors), 3))
    for s in range(len(mirrors)):
        for i in range(3):
            out[s, i] = (
                mirrors[s, i, 0] * direction[0] + mirrors[s, i, 1] * direction[1] + mirrors[s, i, 2] * direction[2]
            )
    return out


@numba.njit(cache=True, nogil=True)
def _peak(zenith: Any, cov: Any, kinds: Any) -> Any:
    """Highest density that a path may have."""
    peak = 0.0
    for k in range(len(kinds)):
        peak += kinds[k, 1] if np.isinf(kinds[k, 3]) else kinds[k, 1] / np.sqrt(2.0 * np.pi * kinds[k, 3])
    if np.isfinite(cov[2]):
        return peak / (2.0 * np.pi * np.sqrt(max(cov[0] * cov[2] - cov[1] ** 2, 1e-30)) * np.sin(zenith))
    return peak / np.sqrt(2.0 * np.pi * cov[0]) if np.isfinite(cov[0]) else peak


@numba.njit(cache=True, nogil=True, inline="always")
def _angle_of(along: Any, aside: Any, length: Any) -> Any:
    """Angle of a vector of a length, by the series of the arc sine up to 30 deg, where its error is below 1e-5 rad."""
    t = aside / length
    if along > 0.0 and abs(t) < 0.5:
        q = t * t
        return t * (1.0 + q * (1.0 / 6.0 + q * (3.0 / 40.0 + q * (15.0 / 336.0 + q * (105.0 / 3456.0 + q * 0.03)))))
    return np.arctan2(aside, along)


@numba.njit(cache=True, nogil=True)
def _of_azimuth(error: Any, variance: Any, spreads: Any, blur: Any) -> Any:
    """Density of the measured azimuth, per radian."""
    total = 0.0
    for s in range(len(spreads)):
        wide = variance * spreads[s, 1] ** 2 + blur
        total += spreads[s, 0] * np.exp(-0.5 * error**2 / wide) / np.sqrt(2.0 * np.pi * wide)
    return total


@numba.njit(cache=True, nogil=True)
def _of_both(azimuth: Any, zenith: Any, cov: Any, spreads: Any, azimuth_blur: Any, zenith_blur: Any) -> Any:
    """Density of the measured angles for their errors, per radian squared."""
    total = 0.0
    for s in range(len(spreads)):
        scale = spreads[s, 1] ** 2
        aa, az, zz = cov[0] * scale + azimuth_blur, cov[1] * scale, cov[2] * scale + zenith_blur
        determinant = aa * zz - az * az
        distance = (zz * azimuth**2 - 2.0 * az * azimuth * zenith + aa * zenith**2) / determinant
        total += spreads[s, 0] * np.exp(-0.5 * distance) / (2.0 * np.pi * np.sqrt(determinant))
    return total


def unknown_angles() -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Return ``turn``, ``zenith`` and ``cov`` of a path whose direction was not measured."""
    return np.eye(3), math.nan, np.array([np.inf, 0.0, np.inf])
