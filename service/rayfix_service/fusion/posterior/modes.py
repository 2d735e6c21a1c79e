"""The candidates of a mixture of hypotheses: modes of the posterior, and the hypotheses that belong to each.

The NumPy twins of some kernels are in ``reference.py``.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.posterior.saddles import squared_distance, unite_maxima
from rayfix_service.fusion.posterior.voxels import is_free_position, nearest_free
from rayfix_tables.gaussians.cholesky import cholesky, invert, solve

_SAME_MODE = 9.0
"""Two maxima nearer than this, squared and in what either is uncertain by, count as one mode."""

VALLEY = float(np.log(2.0))
"""Two maxima are of one mode unless the density between them falls to less than half of the lower one, nats.

Two equal Gaussians are two modes from 3.3 of their standard deviations on, nearer ones have too little between them.
"""

_FARTHEST = 64.0
"""Maxima farther apart than this, squared and in what either is uncertain by, are not compared."""


class _Gaussians(NamedTuple):
    """Gaussians with positive definite covariances.

    Attributes
    ----------
    log_density : ndarray of shape (h,)
        Log weight plus half the log determinant of the precision.
    weight : ndarray of shape (h,)
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
    precision : ndarray of shape (h, 3, 3), 1 / m2
    """

    log_density: NDArray[np.float64]
    weight: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]
    precision: NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def find_modes(log_weight: Any, mean: Any, cov: Any, origin: Any, voxel_size: Any, free: Any, stop: Any) -> Any:
    """Climb from Gaussians to the modes of their mixture, group them by mode, and sum each group up.

    Parameters
    ----------
    log_weight : ndarray of shape (h,)
        Natural logarithms; the weights sum to 1.
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
        A Gaussian whose covariance is not positive definite is left out with its weight.
    origin, voxel_size, free
        As in :class:`~rayfix_tables.freespace.FreeSpace`.
    stop : ndarray of uint8, shape (1,)
        As in :class:`~rayfix_service.fusion.stopping.Stop`, looked at before each climb.

    Returns
    -------
    probability : ndarray of shape (m,)
        Of each mode, the most probable first.
    position : ndarray of shape (m, 3), m
        Mean of the mode's Gaussians; the mode itself, or the nearest free position, where the mean is in a solid.
    moment : ndarray of shape (m, 3, 3), m2
        Second moment of the mode's Gaussians about ``position``.
    member : ndarray of int64, shape (h,)
        Mode of each Gaussian.
    """
    definite = np.zeros(len(log_weight), np.bool_)
    log_density = np.empty(len(log_weight))
    precision, lower = np.empty((len(log_weight), 3, 3)), np.empty((3, 3))
    for h in range(len(log_weight)):
        if cholesky(cov[h], lower):
            definite[h] = True
            invert(lower, precision[h])
            log_density[h] = log_weight[h] - np.log(lower[0, 0] * lower[1, 1] * lower[2, 2])
    which = np.flatnonzero(definite)
    definite_ones = _Gaussians(log_density[which], np.exp(log_weight[which]), mean[which], cov[which], precision[which])
    return _modes(definite_ones, which, len(log_weight), origin, voxel_size, free, stop)


@numba.njit(cache=True, nogil=True)
def _modes(gaussians: Any, which: Any, total: Any, origin: Any, voxel_size: Any, free: Any, stop: Any) -> Any:
    """Find the modes of Gaussians that are ``which`` of a ``total``; those left out count as the first mode's."""
    log_density, weight, mean, cov, precision = gaussians
    count = len(weight)
    top, member = gather(log_density, mean, precision, _SAME_MODE, VALLEY, _FARTHEST, stop)
    probability, position = np.zeros(len(top)), np.zeros((len(top), 3))
    for h in range(count):
        probability[member[h]] += weight[h]
        for i in range(3):
            position[member[h], i] += weight[h] * mean[h, i]
    for n in range(len(top)):
        position[n] /= probability[n]
        if not is_free_position(free, origin, voxel_size, position[n]):
            position[n] = top[n]
    moment = _second_moments(weight, mean, cov, member, probability, position)
    moved = False
    for n in range(len(top)):
        if not is_free_position(free, origin, voxel_size, position[n]):
            moved |= nearest_free(position[n], moment[n], origin, voxel_size, free)
    if moved:
        moment = _second_moments(weight, mean, cov, member, probability, position)
    order = np.argsort(-probability, kind="mergesort")
    rank = np.empty(len(top), np.int64)
    rank[order] = np.arange(len(top))
    member_of_all = np.zeros(total, np.int64)
    member_of_all[which] = rank[member]
    # A sum of rounded numbers may be a little more than 1.
    return np.minimum(probability[order], 1.0), position[order], moment[order], member_of_all


@numba.njit(cache=True, nogil=True)
def _second_moments(weight: Any, mean: Any, cov: Any, member: Any, total: Any, position: Any) -> Any:
    """Second moment of each mode, shape (m, 3, 3), about its position."""
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
def gather(log_density: Any, mean: Any, precision: Any, same_mode: Any, valley: Any, farthest: Any, stop: Any) -> Any:
    """Climb from each hypothesis, the densest first, and group the hypotheses by the mode they come to.

    Parameters
    ----------
    log_density : ndarray of shape (h,)
        Log weight plus half the log determinant of the precision.
    mean : ndarray of shape (h, 3), m
    precision : ndarray of shape (h, 3, 3), 1 / m2
    same_mode : float
        Two maxima are one mode when their squared distance is below this in what either is
        uncertain by.
    valley, farthest : float
        As ``depth`` and ``reach`` of :func:`~rayfix_service.fusion.posterior.saddles.unite_maxima`.
    stop : ndarray of uint8, shape (1,)
        As in :class:`~rayfix_service.fusion.stopping.Stop`; once it is set, those that are left go to the first mode.

    Returns
    -------
    top : ndarray of shape (m, 3), m
        Highest maximum of each mode, in the order in which they were found.
    member : ndarray of int64, shape (h,)
        Mode of each hypothesis.
    """
    count = len(log_density)
    member = np.zeros(count, np.int64)
    top = np.empty((count, 3))
    curvature = np.empty((count, 3, 3))
    found = 0
    for h in np.argsort(-log_density):
        if stop[0] != 0 and found > 0:
            break
        mode, here, known = climb(log_density, mean, precision, mean[h], top[:found], curvature[:found])
        for n in range(found):
            if known >= 0:
                break
            if min(squared_distance(mode, top[n], curvature[n]), squared_distance(mode, top[n], here)) < same_mode:
                known = n
        if known < 0:
            known = found
            top[found] = mode
            curvature[found] = here
            found += 1
        member[h] = known
    first = unite_maxima(log_density, mean, precision, top[:found], curvature[:found], valley, farthest, stop)
    number, kept = np.empty(found, np.int64), np.flatnonzero(first == np.arange(found))
    number[kept] = np.arange(len(kept))
    for h in range(count):
        member[h] = number[first[member[h]]]
    return top[kept], member


@numba.njit(cache=True, nogil=True)
def climb(log_density: Any, mean: Any, precision: Any, start: Any, top: Any, curvature: Any) -> Any:
    """Climb to a mode of a Gaussian mixture by the fixed point of its stationarity condition.

    M. A. Carreira-Perpinan, "Mode-finding for mixtures of Gaussian distributions", IEEE Trans. PAMI 22 (11), 2000:
    at a mode ``x = (sum r_h P_h)^-1 sum r_h P_h m_h`` with the responsibilities r_h at x.

    Parameters
    ----------
    log_density, mean, precision : ndarray
        As in :func:`gather`.
    start : ndarray of shape (3,), m
    top : ndarray of shape (m, 3), m
        Modes found already, the climb to which may be cut short.
    curvature : ndarray of shape (m, 3, 3), 1 / m2
        Mean precision of the hypotheses there.

    Returns
    -------
    mode : ndarray of shape (3,), m
    curvature : ndarray of shape (3, 3), 1 / m2
    found : int
        Which of the modes found already attracts here, -1 for none.
    """
    count = len(log_density)
    x, step = start.copy(), np.empty(3)
    logs = np.empty(count)
    matrix = np.empty((3, 3))
    vector = np.empty(3)
    lower = np.empty((3, 3))
    for _ in range(500):
        for n in range(len(top)):
            # A hundredth: within a tenth of its standard deviation only the mode itself attracts.
            if squared_distance(x, top[n], curvature[n]) < 0.01:
                return x, matrix, n
        highest = -np.inf
        for h in range(count):
            logs[h] = log_density[h] - 0.5 * squared_distance(x, mean[h], precision[h])
            highest = max(highest, logs[h])
        total = 0.0
        xx, yx, yy, zx, zy, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        px, py, pz = 0.0, 0.0, 0.0
        for h in range(count):
            if logs[h] < highest - 28.0:
                continue
            share = np.exp(logs[h] - highest)
            total += share
            a, b, c = mean[h, 0] - x[0], mean[h, 1] - x[1], mean[h, 2] - x[2]
            own = precision[h]
            xx += share * own[0, 0]
            yx += share * own[1, 0]
            yy += share * own[1, 1]
            zx += share * own[2, 0]
            zy += share * own[2, 1]
            zz += share * own[2, 2]
            px += share * (own[0, 0] * a + own[1, 0] * b + own[2, 0] * c)
            py += share * (own[1, 0] * a + own[1, 1] * b + own[2, 1] * c)
            pz += share * (own[2, 0] * a + own[2, 1] * b + own[2, 2] * c)
        matrix[0, 0], matrix[1, 1], matrix[2, 2] = xx, yy, zz
        matrix[0, 1], matrix[0, 2], matrix[1, 2] = yx, zx, zy
        matrix[1, 0], matrix[2, 0], matrix[2, 1] = yx, zx, zy
        vector[0], vector[1], vector[2] = px, py, pz
        if not cholesky(matrix, lower):
            break
        solve(lower, vector, step)
        x += step
        matrix /= total
        if max(abs(step[0]), abs(step[1]), abs(step[2])) < 1e-6:
            break
    return x, matrix, -1
