"""Compiled kernels of :mod:`rayfix_service.fusion.modes`; the NumPy twins of some are in ``reference.py``."""

from typing import Any

import numba
import numpy as np

from rayfix_service.fusion.kernels import cholesky, invert
from rayfix_service.fusion.voxels import is_free, is_free_place, nearest_free


@numba.njit(cache=True, nogil=True)
def cut_gaussians(mean: Any, cov: Any, points: Any, origin: Any, voxel_size: Any, free: Any, out_share: Any) -> None:
    """Cut Gaussians to the free space, in place.

    Parameters
    ----------
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
    points : ndarray of shape (n, 3)
        Points that stand for a standard normal.
    origin, voxel_size, free
        As in :class:`~rayfix_tables.freespace.FreeSpace`.
    out_share : ndarray of shape (h,)
        Share of each Gaussian's points in the free space. A Gaussian without any stays as it is, and one with few
        keeps its covariance.
    """
    lower = np.zeros((3, 3))
    first = np.empty(3)
    second = np.empty((3, 3))
    for h in range(len(mean)):
        cholesky(cov[h], lower)
        # In voxels.
        x0, y0, z0 = (mean[h] - origin) / voxel_size
        xx, yx, yy = lower[0, 0] / voxel_size, lower[1, 0] / voxel_size, lower[1, 1] / voxel_size
        zx, zy, zz = lower[2, 0] / voxel_size, lower[2, 1] / voxel_size, lower[2, 2] / voxel_size
        count = 0
        first[:] = 0.0
        second[:] = 0.0
        for n in range(len(points)):
            p, q, r = points[n, 0], points[n, 1], points[n, 2]
            if not is_free(free, x0 + xx * p, y0 + yx * p + yy * q, z0 + zx * p + zy * q + zz * r):
                continue
            count += 1
            for i in range(3):
                first[i] += points[n, i]
                for j in range(i + 1):
                    second[i, j] += points[n, i] * points[n, j]
        out_share[h] = count / len(points)
        if count == 0 or count == len(points):
            continue
        first /= count
        for i in range(3):
            for j in range(i + 1):
                second[i, j] = second[i, j] / count - first[i] * first[j]
                second[j, i] = second[i, j]
            mean[h, i] += lower[i, 0] * first[0] + lower[i, 1] * first[1] + lower[i, 2] * first[2]
        if count > 8:
            # A little of the uncut covariance keeps the cut one regular.
            for i in range(3):
                for j in range(3):
                    inner = 0.0
                    for k in range(i + 1):
                        for m in range(j + 1):
                            inner += lower[i, k] * second[k, m] * lower[j, m]
                    cov[h, i, j] = 0.9 * inner + 0.1 * cov[h, i, j]


@numba.njit(cache=True, nogil=True)
def find_hills(
    log_weight: Any, mean: Any, cov: Any, origin: Any, voxel_size: Any, free: Any, same_hill: Any, near: Any
) -> Any:
    """Gather Gaussians by the hills of their mixture, and sum each hill up.

    Parameters
    ----------
    log_weight : ndarray of shape (h,)
        Natural logarithms.
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
    origin, voxel_size, free
        As in :class:`~rayfix_tables.freespace.FreeSpace`.
    same_hill : float
        As in :func:`gather`.
    near : float
        A position in a solid moves to free space within this many standard deviations.

    Returns
    -------
    probability, position, moment, member : ndarray
        As in :class:`~rayfix_service.fusion.modes.Modes`.
    """
    count = len(log_weight)
    log_density = np.empty(count)
    precision, lower = np.empty((count, 3, 3)), np.empty((3, 3))
    for h in range(count):
        cholesky(cov[h], lower)
        invert(lower, precision[h])
        log_density[h] = log_weight[h] - np.log(lower[0, 0] * lower[1, 1] * lower[2, 2])
    top, member = gather(log_density, mean, precision, same_hill)
    weight = np.exp(log_weight)
    probability, position = np.zeros(len(top)), np.zeros((len(top), 3))
    for h in range(count):
        probability[member[h]] += weight[h]
        for i in range(3):
            position[member[h], i] += weight[h] * mean[h, i]
    for n in range(len(top)):
        position[n] /= probability[n]
        if not is_free_place(free, origin, voxel_size, position[n]):
            position[n] = top[n]
    moment = _second_moments(weight, mean, cov, member, probability, position)
    moved = False
    for n in range(len(top)):
        if not is_free_place(free, origin, voxel_size, position[n]):
            moved |= nearest_free(position[n], moment[n], near, origin, voxel_size, free)
    if moved:
        moment = _second_moments(weight, mean, cov, member, probability, position)
    order = np.argsort(-probability, kind="mergesort")
    rank = np.empty(len(top), np.int64)
    rank[order] = np.arange(len(top))
    # A sum of rounded numbers may be a little more than 1.
    return np.minimum(probability[order], 1.0), position[order], moment[order], rank[member]


@numba.njit(cache=True, nogil=True)
def _second_moments(weight: Any, mean: Any, cov: Any, member: Any, total: Any, position: Any) -> Any:
    """Second moment of each hill, shape (m, 3, 3), about its position."""
    moment = np.zeros((len(total), 3, 3))
    for h in range(len(weight)):
        n = member[h]
        share = weight[h] / total[n]
        for i in range(3):
            for j in range(3):
                apart = (mean[h, i] - position[n, i]) * (mean[h, j] - position[n, j])
                moment[n, i, j] += share * (cov[h, i, j] + apart)
    return moment


@numba.njit(cache=True, nogil=True)
def climb(log_density: Any, mean: Any, precision: Any, start: Any) -> Any:
    """Climb to a mode of a Gaussian mixture in three dimensions by the fixed point of its stationarity condition.

    M. A. Carreira-Perpinan, "Mode-finding for mixtures of Gaussian distributions", IEEE Trans. PAMI 22 (11), 2000:
    at a mode ``x = (sum r_h P_h)^-1 sum r_h P_h m_h`` with the responsibilities r_h at x.

    Parameters
    ----------
    log_density : ndarray of shape (h,)
        Log weight plus half the log determinant of the precision.
    mean : ndarray of shape (h, 3), m
    precision : ndarray of shape (h, 3, 3), 1 / m2
    start : ndarray of shape (3,), m

    Returns
    -------
    mode : ndarray of shape (3,), m
    curvature : ndarray of shape (3, 3), 1 / m2
        Mean precision of the hypotheses there.
    """
    mode, curvature, _ = _climb(log_density, mean, precision, start, np.empty((0, 3)), np.empty((0, 3, 3)))
    return mode, curvature


@numba.njit(cache=True, nogil=True)
def gather(log_density: Any, mean: Any, precision: Any, same_hill: Any) -> Any:
    """Climb from each hypothesis, the densest first, and gather the hypotheses by the hill they come to.

    Parameters
    ----------
    log_density, mean, precision : ndarray
        As in :func:`climb`.
    same_hill : float
        Two modes are one hill, though with two humps, when their squared distance is below this in what either is
        uncertain by.

    Returns
    -------
    top : ndarray of shape (m, 3), m
        Mode of each hill, in the order in which they were found.
    member : ndarray of int64, shape (h,)
        Hill of each hypothesis.
    """
    count = len(log_density)
    member = np.empty(count, np.int64)
    top = np.empty((count, 3))
    curvature = np.empty((count, 3, 3))
    found = 0
    for h in np.argsort(-log_density):
        mode, here, hill = _climb(log_density, mean, precision, mean[h], top[:found], curvature[:found])
        for n in range(found):
            if hill >= 0:
                break
            if min(_square(mode, top[n], curvature[n]), _square(mode, top[n], here)) < same_hill:
                hill = n
        if hill < 0:
            hill = found
            top[found] = mode
            curvature[found] = here
            found += 1
        member[h] = hill
    return top[:found].copy(), member


@numba.njit(cache=True, nogil=True)
def _square(x: Any, y: Any, precision: Any) -> Any:
    """Square of the Mahalanobis distance."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += (x[i] - y[i]) * precision[i, j] * (x[j] - y[j])
    return total


@numba.njit(cache=True, nogil=True)
def _climb(log_density: Any, mean: Any, precision: Any, start: Any, top: Any, curvature: Any) -> Any:
    """Climb until a mode is reached, or the place where one of those found already attracts (its number comes last)."""
    count = len(log_density)
    x = start.copy()
    logs = np.empty(count)
    matrix = np.empty((3, 3))
    vector = np.empty(3)
    lower = np.empty((3, 3))
    inverse = np.empty((3, 3))
    for _ in range(500):
        for n in range(len(top)):
            # A hundredth: within a tenth of its deviation nothing but the mode itself attracts.
            if _square(x, top[n], curvature[n]) < 0.01:
                return x, matrix, n
        highest = -np.inf
        for h in range(count):
            logs[h] = log_density[h] - 0.5 * _square(x, mean[h], precision[h])
            highest = max(highest, logs[h])
        total = 0.0
        matrix[:] = 0.0
        vector[:] = 0.0
        for h in range(count):
            if logs[h] < highest - 28.0:
                continue
            share = np.exp(logs[h] - highest)
            total += share
            for i in range(3):
                for j in range(3):
                    matrix[i, j] += share * precision[h, i, j]
                    vector[i] += share * precision[h, i, j] * (mean[h, j] - x[j])
        cholesky(matrix, lower)
        invert(lower, inverse)
        longest = 0.0
        for i in range(3):
            step = inverse[i, 0] * vector[0] + inverse[i, 1] * vector[1] + inverse[i, 2] * vector[2]
            longest = max(longest, abs(step))
            x[i] += step
        matrix /= total
        if longest < 1e-6:
            break
    return x, matrix, -1
