"""Reports' measurements against particles, straight from the path map, in compiled kernels.

A component of an observation's likelihood is a path, a Gaussian of the angles' errors and one of the times'; or the
case that all of it is an outlier. Measured minus expected, a component tells of up to three numbers: azimuth, zenith
and path length. Each has a drift, known to be Gaussian, and scatter besides.
"""

from typing import Any

import numba
import numpy as np

_OUTLIER = -1
"""In place of a path's sequence: all is an outlier."""

_NEGLIGIBLE = 1e-4
"""Paths that could add no more than this fraction of what others have added, the outlier included, are left out."""

_MOST = 4096
"""Components of one observation that are distinguished at a place."""

_NEAR = 1e-6
"""Squared distance from a station, m2, below which directions are not told apart."""


@numba.njit(cache=True, nogil=True)
def voxel_of(place: Any, x: Any, y: Any, z: Any) -> Any:
    """Index of the map's voxel that a point lies in, -1 beyond the map."""
    origin, size, shape = place
    i, j, k = np.floor((x - origin[0]) / size), np.floor((y - origin[1]) / size), np.floor((z - origin[2]) / size)
    if i < 0 or j < 0 or k < 0 or i >= shape[0] or j >= shape[1] or k >= shape[2]:
        return np.int64(-1)
    return (np.int64(i) * shape[1] + np.int64(j)) * shape[2] + np.int64(k)


@numba.njit(cache=True, nogil=True)
def _seen(at: Any, s: Any, geometry: Any, turn: Any) -> Any:
    """Way from a sequence's image to a place, in the scene's axes and in those of the measured angles."""
    images, mirrors, _ = geometry
    d0, d1, d2 = at[0] - images[s, 0], at[1] - images[s, 1], at[2] - images[s, 2]
    a = mirrors[s, 0, 0] * d0 + mirrors[s, 1, 0] * d1 + mirrors[s, 2, 0] * d2
    b = mirrors[s, 0, 1] * d0 + mirrors[s, 1, 1] * d1 + mirrors[s, 2, 1] * d2
    c = mirrors[s, 0, 2] * d0 + mirrors[s, 1, 2] * d1 + mirrors[s, 2, 2] * d2
    u = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c
    v = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c
    w = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c
    return d0, d1, d2, u, v, w


@numba.njit(cache=True, nogil=True)
def _expect(at: Any, s: Any, excess: Any, geometry: Any, factor: Any, error: Any) -> None:
    """Fill in the expected azimuth and zenith minus the measured ones, and the path length."""
    _, _, _, u, v, w = _seen(at, s, geometry, factor[0])
    square = max(u * u + v * v + w * w, _NEAR)
    error[0] = np.arctan2(v, u)
    error[1] = np.arctan2(np.sqrt(max(u * u + v * v, 1e-6 * square)), w) - factor[1]
    error[2] = np.sqrt(square) + excess


@numba.njit(cache=True, nogil=True)
def _differentiate(at: Any, s: Any, geometry: Any, turn: Any, slope: Any) -> None:
    """Fill in the gradients of what is expected."""
    mirrors = geometry[1]
    d0, d1, d2, u, v, w = _seen(at, s, geometry, turn)
    square = max(d0 * d0 + d1 * d1 + d2 * d2, _NEAR)
    length = np.sqrt(square)
    horizontal = max(u * u + v * v, 1e-6 * square)
    across = np.sqrt(horizontal)
    ja, jb = -v / horizontal, u / horizontal
    za, zb, zc = u * w / (across * square), v * w / (across * square), -across / square
    for i in range(3):
        # Row i of the mirror takes the scene's axis i to the station's direction.
        p = turn[0, 0] * mirrors[s, i, 0] + turn[0, 1] * mirrors[s, i, 1] + turn[0, 2] * mirrors[s, i, 2]
        q = turn[1, 0] * mirrors[s, i, 0] + turn[1, 1] * mirrors[s, i, 1] + turn[1, 2] * mirrors[s, i, 2]
        r = turn[2, 0] * mirrors[s, i, 0] + turn[2, 1] * mirrors[s, i, 1] + turn[2, 2] * mirrors[s, i, 2]
        slope[0, i] = ja * p + jb * q
        slope[1, i] = za * p + zb * q + zc * r
    slope[2, 0], slope[2, 1], slope[2, 2] = d0 / length, d1 / length, d2 / length


@numba.njit(cache=True, nogil=True)
def _innovate(
    error: Any, slope: Any, factor: Any, length_variance: Any, c: Any, k: Any, drift: Any, of: Any, out: Any
) -> Any:
    """Independent scalars that a component measures: what is left, its gradient and variance; returns their number.

    The zenith is what it says beyond the azimuth, where their errors are correlated.
    """
    _, zenith, cov, spreads, kinds, _, _, _ = factor
    mean, variance, share = drift
    left, gradient, noise = out
    count = 0
    scale = spreads[c, 1] ** 2 - share[of]
    if np.isfinite(cov[0]):
        left[0] = -error[0] - mean[of, 0]
        left[0] -= 2.0 * np.pi * np.rint(left[0] / (2.0 * np.pi))
        noise[0] = cov[0] * scale + variance[of, 0]
        for i in range(3):
            gradient[0, i] = slope[0, i]
        count = 1
        if not np.isnan(zenith):
            common = cov[1] * scale
            part = common / noise[0]
            left[1] = -error[1] - mean[of, 1] - part * left[0]
            noise[1] = cov[2] * scale + variance[of, 1] - part * common
            for i in range(3):
                gradient[1, i] = slope[1, i] - part * slope[0, i]
            count = 2
    if np.isfinite(kinds[k, 3]):
        left[count] = kinds[k, 2] - error[2] - mean[of, 2]
        noise[count] = max(kinds[k, 3] - share[of] * length_variance, 1e-3 * kinds[k, 3]) + variance[of, 2]
        for i in range(3):
            gradient[count, i] = slope[2, i]
        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _log_density(count: Any, scalars: Any) -> Any:
    """Log density of independent scalars at a position."""
    left, _, noise = scalars
    square, product = 0.0, 1.0
    for m in range(count):
        square += left[m] ** 2 / noise[m]
        product *= 2.0 * np.pi * noise[m]
    return -0.5 * (square + np.log(product))


@numba.njit(cache=True, nogil=True)
def _take_in(mean: Any, cov: Any, count: Any, scalars: Any) -> Any:
    """Update a Gaussian with independent scalars, in place; returns the log density of these.

    ``left`` is as seen from the mean that comes in.
    """
    left, gradient, noise = scalars
    log = 0.0
    gain = np.empty(3)
    moved = np.zeros(3)
    for m in range(count):
        total, rest = noise[m], left[m]
        for i in range(3):
            gain[i] = cov[i, 0] * gradient[m, 0] + cov[i, 1] * gradient[m, 1] + cov[i, 2] * gradient[m, 2]
            rest -= gradient[m, i] * moved[i]
        for i in range(3):
            total += gradient[m, i] * gain[i]
        log -= 0.5 * (rest * rest / total + np.log(2.0 * np.pi * total))
        for i in range(3):
            moved[i] += gain[i] * rest / total
            for j in range(3):
                cov[i, j] -= gain[i] * gain[j] / total
    for i in range(3):
        mean[i] += moved[i]
    return log


@numba.njit(cache=True, nogil=True)
def _weight_of(paths: Any, geometry: Any, factor: Any, path: Any) -> Any:
    """Probability that this is the path, in the light of a line-of-sight indication."""
    _, sequence, weight, excess, num_walls = paths
    direct = geometry[2][sequence[path]] == 0 and not (len(excess) > 0 and num_walls[path] > 0)
    return float(weight[path]) * (factor[5] if direct else factor[6])


@numba.njit(cache=True, nogil=True)
def _around(point: Any, place: Any, paths: Any, voxels: Any, shares: Any) -> Any:
    """Fill in the voxels with any path between whose centres a point lies, and their shares; returns their number.

    Weights of voxels are of few rays each, and end at the edges of shadows: as steps they would draw particles.
    """
    origin, size, shape = place
    offsets = paths[0]
    u = (point[0] - origin[0]) / size - 0.5
    v = (point[1] - origin[1]) / size - 0.5
    w = (point[2] - origin[2]) / size - 0.5
    i, j, k = np.int64(np.floor(u)), np.int64(np.floor(v)), np.int64(np.floor(w))
    count, total = 0, 0.0
    for x in range(i, i + 2):
        for y in range(j, j + 2):
            for z in range(k, k + 2):
                if min(x, y, z) < 0 or x >= shape[0] or y >= shape[1] or z >= shape[2]:
                    continue
                voxel = (x * shape[1] + y) * shape[2] + z
                if offsets[voxel] == offsets[voxel + 1]:
                    continue
                voxels[count] = voxel
                shares[count] = (1.0 - abs(u - x)) * (1.0 - abs(v - y)) * (1.0 - abs(w - z))
                total += shares[count]
                count += 1
    if total <= 0.0:
        return 0
    for n in range(count):
        shares[n] /= total
    return count


@numba.njit(cache=True, nogil=True)
def _weigh(count: Any, voxels: Any, shares: Any, paths: Any, geometry: Any, factor: Any, s: Any, weighed: Any) -> Any:
    """Fill in the voxels' shares of the weight of a sequence, or of an outlier's of 1; returns their sum."""
    offsets, sequence = paths[0], paths[1]
    total = 0.0
    for n in range(count):
        own = 0.0
        if s == _OUTLIER:
            own = 1.0
        else:
            for path in range(offsets[voxels[n]], offsets[voxels[n] + 1]):
                if sequence[path] == s:
                    own += _weight_of(paths, geometry, factor, path)
        weighed[n] = shares[n] * own
        total += weighed[n]
    return total


@numba.njit(cache=True, nogil=True)
def _picked(weights: Any, count: Any, level: Any) -> Any:
    """Find the weight within which a level lies, counted from the first; -1 where it lies beyond the last."""
    for n in range(count):
        level -= weights[n]
        if level <= 0.0:
            return n
    return -1


@numba.njit(cache=True, nogil=True)
def _highest(factor: Any) -> Any:
    """Highest density that a path may have but for its drift, which is wider."""
    _, zenith, cov, _, kinds, direct, reflected, _ = factor
    peak = 0.0
    for k in range(len(kinds)):
        peak += kinds[k, 1] if np.isinf(kinds[k, 3]) else kinds[k, 1] / np.sqrt(2.0 * np.pi * 1e-3 * kinds[k, 3])
    peak *= max(direct, reflected)
    if np.isfinite(cov[0]):
        peak /= np.sqrt(2.0 * np.pi * 1e-2 * cov[0])
        if not np.isnan(zenith):
            peak /= np.sqrt(2.0 * np.pi * 1e-2 * max(cov[2] - cov[1] ** 2 / cov[0], 1e-12)) * np.sin(zenith)
    return peak


@numba.njit(cache=True, nogil=True)
def _densities(
    at: Any, cov: Any, exact: Any, of: Any, voxel: Any, of_map: Any, measured: Any, drift: Any, out: Any
) -> Any:
    """Evaluate all components of an observation for a Gaussian over the position; returns their number and sum.

    Where the position is ``exact``, the covariance does not count. The sum has the outlier in it. ``out`` gets the
    densities, and each one's path, Gaussian of the angles and Gaussian of the times.
    """
    _, paths, geometry = of_map
    factor, length_variance = measured
    offsets, sequence, weight, excess, _ = paths
    spreads, kinds, outlier = factor[3], factor[4], factor[7]
    density, component = out
    sine = 1.0 if np.isnan(factor[1]) else np.sin(factor[1])
    error, slope = np.empty(3), np.empty((3, 3))
    scalars = np.empty(3), np.empty((3, 3)), np.empty(3)
    trial, trial_cov = np.empty(3), np.empty((3, 3))
    peak, total, count = _highest(factor), outlier, 0
    first, last = (offsets[voxel], offsets[voxel + 1]) if voxel >= 0 else (0, 0)
    for path in range(first, last):
        if float(weight[path]) * peak < _NEGLIGIBLE * total:
            break
        own = _weight_of(paths, geometry, factor, path)
        longer = excess[path] if len(excess) > 0 else 0.0
        _expect(at, np.int64(sequence[path]), longer, geometry, factor, error)
        if not exact:
            _differentiate(at, np.int64(sequence[path]), geometry, factor[0], slope)
        for c in range(len(spreads)):
            for k in range(len(kinds)):
                if count == _MOST:
                    continue
                number = _innovate(error, slope, factor, length_variance, c, k, drift, of, scalars)
                if exact:
                    log = _log_density(number, scalars)
                else:
                    trial[:] = at
                    trial_cov[:] = cov
                    log = _take_in(trial, trial_cov, number, scalars)
                density[count] = own * spreads[c, 0] * kinds[k, 1] * np.exp(log) / sine
                component[count, 0], component[count, 1], component[count, 2] = path, c, k
                total += density[count]
                count += 1
    return count, total


@numba.njit(cache=True, nogil=True)
def propose(
    mean: Any, cov: Any, home: Any, of_map: Any, measured: Any, drift: Any, uniform: Any, chosen: Any, out: Any
) -> None:
    """Draw a component of an observation for each particle by its probability, and take it in to first order.

    Parameters
    ----------
    mean : ndarray of shape (n, 3), m
    cov : ndarray of shape (n, 3, 3), m2
        Gaussians over the positions, changed in place.
    home : ndarray of shape (n, 3), m
        Whose paths are taken where a mean lies beyond the map.
    of_map : tuple
        Origin, voxel size and shape of the map; its paths as in :class:`.quadrature.blocks.BlockPaths`; images, mirrors
        and numbers of reflections.
    measured : tuple
        :class:`.quadrature.factor.PathFactor`, and the variance of a path length's error, m2, of which the drift has
        its share.
    drift : tuple
        Means and variances of the drifts of azimuth, zenith and length, shape (n, 3), and their share of the variance,
        shape (n,).
    uniform : ndarray of shape (n,) or (0,)
        Random numbers between 0 and 1; empty where the components are given.
    chosen : tuple of ndarrays of shape (n,)
        Sequences, -1 for an outlier, the path's excess length and its weight, and the numbers of both Gaussians. Given
        ones get the weight alone.
    out : ndarray of shape (n,)
        Gets the logarithm of the component's probability; of a given one 0, or -inf where it would not be drawn.
    """
    place, paths, geometry = of_map
    factor, length_variance = measured
    offsets, sequence, _, excess, _ = paths
    outlier = factor[7]
    sequences, excesses, weights, of_spread, of_kind = chosen
    error, slope = np.empty(3), np.empty((3, 3))
    scalars = np.empty(3), np.empty((3, 3)), np.empty(3)
    density, component = np.empty(_MOST), np.empty((_MOST, 3), np.int64)
    drawing = len(uniform) > 0
    for n in range(len(mean)):
        voxel = voxel_of(place, mean[n, 0], mean[n, 1], mean[n, 2])
        if voxel < 0 or offsets[voxel] == offsets[voxel + 1]:
            voxel = voxel_of(place, home[n, 0], home[n, 1], home[n, 2])
        path, out[n] = -1, 0.0
        if drawing:
            sequences[n], excesses[n], of_spread[n], of_kind[n] = _OUTLIER, 0.0, 0, 0
            count, total = _densities(mean[n], cov[n], False, n, voxel, of_map, measured, drift, (density, component))
            out[n] = np.log(outlier / total)
            m = _picked(density, count, uniform[n] * total)
            if m >= 0:
                path, of_spread[n], of_kind[n] = component[m, 0], component[m, 1], component[m, 2]
                sequences[n], excesses[n] = sequence[path], excess[path] if len(excess) > 0 else 0.0
                out[n] = np.log(density[m] / total)
        elif sequences[n] != _OUTLIER:
            first, last = (offsets[voxel], offsets[voxel + 1]) if voxel >= 0 else (0, 0)
            for other in range(first, last):
                if sequence[other] == sequences[n]:
                    path = other
                    break
            if path < 0:
                out[n] = -np.inf
        weights[n] = _weight_of(paths, geometry, factor, path) if path >= 0 else 0.0
        if path >= 0:
            _expect(mean[n], np.int64(sequences[n]), excesses[n], geometry, factor, error)
            _differentiate(mean[n], np.int64(sequences[n]), geometry, factor[0], slope)
            number = _innovate(error, slope, factor, length_variance, of_spread[n], of_kind[n], drift, n, scalars)
            _take_in(mean[n], cov[n], number, scalars)


@numba.njit(cache=True, nogil=True)
def refine(mean: Any, cov: Any, about: Any, geometry: Any, measured: Any, drift: Any, chosen: Any, out: Any) -> None:
    """Take the chosen components in anew, to first order about better positions.

    Parameters
    ----------
    mean, cov : ndarray of shape (n, 3) and (n, 3, 3)
        Gaussians before the observation, changed in place.
    about : ndarray of shape (n, 3), m
    geometry, measured, drift, chosen
        As of :func:`propose`.
    out : ndarray of shape (n,)
        Gets the log density of the observation and the component, given the Gaussian.
    """
    factor, length_variance = measured
    spreads, kinds, outlier = factor[3], factor[4], factor[7]
    sequences, excesses, weights, of_spread, of_kind = chosen
    sine = 1.0 if np.isnan(factor[1]) else np.sin(factor[1])
    error, slope = np.empty(3), np.empty((3, 3))
    scalars = np.empty(3), np.empty((3, 3)), np.empty(3)
    for n in range(len(mean)):
        if sequences[n] == _OUTLIER:
            out[n] = np.log(outlier)
            continue
        c, k = of_spread[n], of_kind[n]
        _expect(about[n], sequences[n], excesses[n], geometry, factor, error)
        _differentiate(about[n], sequences[n], geometry, factor[0], slope)
        number = _innovate(error, slope, factor, length_variance, c, k, drift, n, scalars)
        for m in range(number):
            for i in range(3):
                scalars[0][m] -= scalars[1][m, i] * (mean[n, i] - about[n, i])
        log = _take_in(mean[n], cov[n], number, scalars)
        out[n] = np.log(weights[n] * spreads[c, 0] * kinds[k, 1] / sine) + log


@numba.njit(cache=True, nogil=True)
def settle(
    points: Any, of_map: Any, measured: Any, drift: Any, uniform: Any, given: Any, chosen: Any, out: Any
) -> None:
    """Evaluate an observation at positions exactly, and update the drifts.

    Weights are interpolated between voxels by drawing one: by its share of the given component's weight, or, where none
    is given, by its share alone, and then a component by its probability.

    Parameters
    ----------
    points : ndarray of shape (n, 3), m
    of_map, measured, chosen
        As of :func:`propose`.
    drift : tuple
        As of :func:`propose`; means and variances are changed in place.
    uniform : ndarray of shape (n, 2)
        Random numbers between 0 and 1.
    given : bool
        Whether the components are; otherwise they are filled in.
    out : tuple of two ndarrays of shape (n,)
        The first gets the log density of the observation and the component; the second that of the observation, with
        the weights of the voxel drawn.
    """
    place, paths, geometry = of_map
    factor, length_variance = measured
    sequence, excess = paths[1], paths[3]
    spreads, kinds, outlier = factor[3], factor[4], factor[7]
    sequences, excesses, _, of_spread, of_kind = chosen
    log_component, log_all = out
    sine = 1.0 if np.isnan(factor[1]) else np.sin(factor[1])
    error, slope = np.empty(3), np.empty((3, 3))
    scalars = np.empty(3), np.empty((3, 3)), np.empty(3)
    nothing = np.zeros((3, 3))
    density, component = np.empty(_MOST), np.empty((_MOST, 3), np.int64)
    voxels, shares, weighed = np.empty(8, np.int64), np.empty(8), np.empty(8)
    for n in range(len(points)):
        near = _around(points[n], place, paths, voxels, shares)
        s = np.int64(sequences[n]) if given else np.int64(_OUTLIER)
        own = _weigh(near, voxels, shares, paths, geometry, factor, s, weighed)
        log_component[n], log_all[n] = np.log(outlier), np.log(outlier)
        if near == 0 or own <= 0.0:
            if s != _OUTLIER:
                log_component[n] = -np.inf
            elif not given:
                sequences[n] = _OUTLIER
            continue
        voxel = voxels[max(_picked(weighed, near, uniform[n, 0] * own), 0)]
        count, total = _densities(points[n], nothing, True, n, voxel, of_map, measured, drift, (density, component))
        log_all[n] = np.log(total)
        if not given:
            sequences[n] = _OUTLIER
            m = _picked(density, count, uniform[n, 1] * total)
            if m >= 0:
                path, of_spread[n], of_kind[n] = component[m, 0], component[m, 1], component[m, 2]
                sequences[n], excesses[n] = sequence[path], excess[path] if len(excess) > 0 else 0.0
                own = _weigh(near, voxels, shares, paths, geometry, factor, np.int64(sequences[n]), weighed)
        if sequences[n] != _OUTLIER:
            c, k = of_spread[n], of_kind[n]
            _expect(points[n], np.int64(sequences[n]), excesses[n], geometry, factor, error)
            number = _innovate(error, slope, factor, length_variance, c, k, drift, n, scalars)
            log = _log_density(number, scalars)
            log_component[n] = np.log(own * spreads[c, 0] * kinds[k, 1] / sine) + log
            _learn(error, factor, length_variance, c, k, drift, n)


@numba.njit(cache=True, nogil=True)
def _learn(error: Any, factor: Any, length_variance: Any, c: Any, k: Any, drift: Any, of: Any) -> None:
    """Update a particle's drifts with what a component measures; correlations between drifts are left out."""
    _, zenith, cov, spreads, kinds, _, _, _ = factor
    mean, variance, share = drift
    scale = spreads[c, 1] ** 2 - share[of]
    if np.isfinite(cov[0]):
        left = -error[0] - mean[of, 0]
        left -= 2.0 * np.pi * np.rint(left / (2.0 * np.pi))
        total = cov[0] * scale + variance[of, 0]
        if np.isnan(zenith):
            mean[of, 0] += variance[of, 0] * left / total
            variance[of, 0] -= variance[of, 0] ** 2 / total
        else:
            high = -error[1] - mean[of, 1]
            common, total_high = cov[1] * scale, cov[2] * scale + variance[of, 1]
            determinant = total * total_high - common**2
            mean[of, 0] += variance[of, 0] * (total_high * left - common * high) / determinant
            mean[of, 1] += variance[of, 1] * (total * high - common * left) / determinant
            variance[of, 0] -= variance[of, 0] ** 2 * total_high / determinant
            variance[of, 1] -= variance[of, 1] ** 2 * total / determinant
    if np.isfinite(kinds[k, 3]):
        total = max(kinds[k, 3] - share[of] * length_variance, 1e-3 * kinds[k, 3]) + variance[of, 2]
        mean[of, 2] += variance[of, 2] * (kinds[k, 2] - error[2] - mean[of, 2]) / total
        variance[of, 2] -= variance[of, 2] ** 2 / total
