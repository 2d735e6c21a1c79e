"""Merge alternatives and hypotheses that mean the same, so that the beam holds more of the posterior.

Neighbouring tubes overlap once a measurement has cut them, and so do thousands of their products. Two that take the
same measurements for outliers become one, with their moments, where that changes the mixture by no more than a stated
divergence.
"""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.kernels import LOG_2PI, cholesky, invert
from rayfix_tables.halving import halve_and_merge

_NO_NOISE = np.zeros(4)


def merge_alternatives(
    keep: NDArray[np.int64],
    log_evidence: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    max_divergence: float,
    noise: NDArray[np.float64] = _NO_NOISE,
) -> NDArray[np.int64]:
    """Merge weighted Gaussians over (position, path length), in place.

    Parameters
    ----------
    keep : ndarray of int64, shape (n,)
        Gaussians that count; the others stay as they are.
    log_evidence : ndarray of shape (k,)
    mean : ndarray of shape (k, 4), m
    cov : ndarray of shape (k, 4, 4), m2
    max_divergence : float
        What a merge may cost, nats.
    noise : ndarray of shape (4,), m2
        Variances under which Gaussians are told apart.

    Returns
    -------
    ndarray of int64, shape (m,)
        Those of ``keep`` that are left.
    """
    if len(keep) < 2:
        return keep
    return np.asarray(_merge_gaussians(keep, log_evidence, mean, cov, max_divergence, noise))


@numba.njit(cache=True, nogil=True)
def _merge_gaussians(keep: Any, log_evidence: Any, mean: Any, cov: Any, max_divergence: Any, noise: Any) -> Any:
    logs = log_evidence[keep]
    top = logs.max()
    weight = np.exp(logs - top)
    total = weight.sum()
    weight /= total
    means, covs = mean[keep], cov[keep]
    size = means.shape[1]
    one_group = np.zeros(len(keep), np.int64)
    into = halve_and_merge(weight, means, covs, one_group, np.ones(size), noise, max_divergence)
    left = np.flatnonzero(into == np.arange(len(keep)))
    for n in left:
        log_evidence[keep[n]] = np.log(weight[n] * total) + top
        mean[keep[n]], cov[keep[n]] = means[n], covs[n]
    return keep[left]


@numba.njit(cache=True, nogil=True)
def merge_hypotheses(information: Any, eta: Any, log_scale: Any, score: Any, pattern: Any, max_divergence: Any) -> Any:
    """Merge products of factors, in place.

    Parameters
    ----------
    information : ndarray of shape (h, d, d)
    eta : ndarray of shape (h, d)
    log_scale : ndarray of shape (h,)
    score : ndarray of shape (h,)
        Log evidence.
    pattern : ndarray of int64, shape (h,)
        What each product takes for outliers; only those with the same are merged.
    max_divergence : float
        What a merge may cost, nats.

    Returns
    -------
    ndarray of int64, shape (m,)
        Products that are left.
    """
    count, size = eta.shape
    proper = np.empty(count, np.int64)
    stays = np.ones(count, np.bool_)
    mean, cov = np.empty((count, size)), np.empty((count, size, size))
    lower = np.empty((size, size))
    num = 0
    for h in range(count):
        # A hypothesis that leaves something open is no Gaussian.
        if score[h] > -np.inf and cholesky(information[h], lower):
            invert(lower, cov[num])
            for i in range(size):
                mean[num, i] = 0.0
                for j in range(size):
                    mean[num, i] += cov[num, i, j] * eta[h, j]
            proper[num] = h
            num += 1
    if num == 0:
        return np.arange(count)
    proper, mean, cov = proper[:num], mean[:num], cov[:num]
    top = score[proper[0]]
    for n in range(num):
        top = max(top, score[proper[n]])
    weight = np.exp(score[proper] - top)
    total = weight.sum()
    weight /= total
    into = halve_and_merge(weight, mean, cov, pattern[proper], np.ones(size), np.zeros(size), max_divergence)
    grown = np.zeros(num, np.bool_)
    for n in range(num):
        if into[n] != n:
            grown[into[n]] = True
            stays[proper[n]] = False
    for n in range(num):
        if not grown[n] or not weight[n] > 0.0 or not cholesky(cov[n], lower):
            continue
        h = proper[n]
        score[h] = np.log(weight[n] * total) + top
        invert(lower, information[h])
        log_scale[h] = score[h] - 0.5 * size * LOG_2PI
        for i in range(size):
            log_scale[h] -= np.log(lower[i, i])
            eta[h, i] = 0.0
            for j in range(size):
                eta[h, i] += information[h, i, j] * mean[n, j]
        for i in range(size):
            log_scale[h] -= 0.5 * eta[h, i] * mean[n, i]
    return np.flatnonzero(stays)
