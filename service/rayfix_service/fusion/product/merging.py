"""Merge similar alternatives and hypotheses, so that the beam covers more of the posterior.

Neighbouring tubes overlap once a measurement has conditioned them, and so do thousands of their products. Two that take
the same measurements for outliers are replaced by one with their moments, if that changes the mixture by no more than a
stated divergence.
"""

from typing import Any

import numba
import numpy as np

from rayfix_service.fusion.product.information_form import dimension_of, invert_all
from rayfix_tables.gaussians.constants import LOG_2PI
from rayfix_tables.gaussians.tree_reduction import halve_and_merge
from rayfix_tables.gaussians.triangles import pack_lower, triangle, unpack_lower

_ONES = (1.0, 1.0, 1.0, 1.0)

NO_NOISE = (0.0, 0.0, 0.0, 0.0)


@numba.njit(cache=True, nogil=True)
def merge_gaussians(log_weight: Any, mean: Any, cov: Any, noise: Any, max_divergence: Any) -> Any:
    """Merge weighted Gaussians over (position, path length), in place.

    Parameters
    ----------
    log_weight : ndarray of shape (n,)
    mean : ndarray of shape (n, 4), m
    cov : ndarray of shape (n, 4, 4), m2
    noise : tuple of 4 floats, m2
        Variances of the noise under which Gaussians are compared.
    max_divergence : float
        What a merge may cost, nats.

    Returns
    -------
    ndarray of int64, shape (m,)
        Those that are left.
    """
    count = len(mean)
    if count < 2:
        return np.arange(count)
    top = log_weight.max()
    weight = np.exp(log_weight - top)
    total = weight.sum()
    weight /= total
    one_group = np.zeros(count, np.int64)
    into = halve_and_merge(weight, mean, cov, one_group, _ONES, noise, max_divergence)
    left = np.flatnonzero(into == np.arange(count))
    for n in left:
        log_weight[n] = np.log(weight[n] * total) + top
    return left


@numba.njit(cache=True, nogil=True)
def merge_hypotheses(columns: Any, score: Any, pattern: Any, max_divergence: Any) -> Any:
    """Merge products of factors, in place.

    Parameters
    ----------
    columns : ndarray of shape (rows, h)
        As :mod:`rayfix_service.fusion.product.information_form` has them.
    score : ndarray of shape (h,)
        Log evidence.
    pattern : ndarray of int64, shape (h,)
        What each product takes for outliers; only those with the same are merged.
    max_divergence : float
        What a merge may cost, nats. Those whose union rounding makes singular are not merged either.

    Returns
    -------
    ndarray of int64, shape (m,)
        Products that are left.
    """
    size = dimension_of(columns)
    packed, det = columns.copy(), np.empty(len(score))
    invert_all(packed, size, det)
    # A hypothesis that leaves the position or a clock unconstrained is no Gaussian.
    proper = np.flatnonzero((score > -np.inf) & (det > 0.0))
    if len(proper) == 0:
        return np.arange(len(score))
    top = score[proper].max()
    weight = np.exp(score[proper] - top)
    total = weight.sum()
    weight /= total
    mean, cov = _moments(columns, packed, proper)
    # Most reports have no clock, or one. Of these the compiler knows the dimension.
    group = pattern[proper]
    if size == 3:
        into = halve_and_merge(weight, mean, cov, group, _ONES[:3], NO_NOISE[:3], max_divergence)
    elif size == 4:
        into = halve_and_merge(weight, mean, cov, group, _ONES, NO_NOISE, max_divergence)
    else:
        into = halve_and_merge(weight, mean, cov, group, np.ones(size), np.zeros(size), max_divergence)
    has_grown = np.zeros(len(proper), np.bool_)
    for n in range(len(proper)):
        if into[n] != n:
            has_grown[into[n]] = weight[into[n]] > 0.0
    grown = np.flatnonzero(has_grown)
    regular = np.ones(len(proper), np.bool_)
    regular[grown] = _write_back(
        columns, score, proper[grown], np.log(weight[grown] * total) + top, mean[grown], cov[grown]
    )
    stays = np.ones(len(score), np.bool_)
    for n in range(len(proper)):
        if into[n] != n and regular[into[n]]:
            stays[proper[n]] = False
    return np.flatnonzero(stays)


@numba.njit(cache=True, nogil=True)
def _moments(columns: Any, packed: Any, which: Any) -> Any:
    """Means and covariances of columns, the latter given as packed triangles."""
    size = dimension_of(columns)
    first = triangle(size)
    mean, cov = np.zeros((len(which), size)), np.empty((len(which), size, size))
    for n in range(len(which)):
        h = which[n]
        unpack_lower(packed, h, cov[n])
        for i in range(size):
            for j in range(size):
                mean[n, i] += cov[n, i, j] * columns[first + j, h]
    return mean, cov


@numba.njit(cache=True, nogil=True)
def _write_back(columns: Any, score: Any, which: Any, log_weight: Any, mean: Any, cov: Any) -> Any:
    """Turn weighted Gaussians into columns where their covariances are positive definite; return where they are."""
    size = mean.shape[1]
    first = triangle(size)
    packed, det = np.empty((first, len(which))), np.empty(len(which))
    for n in range(len(which)):
        pack_lower(cov[n], packed, n)
    invert_all(packed, size, det)
    definite = det > 0.0
    for n in range(len(which)):
        if not definite[n]:
            continue
        h = which[n]
        score[h] = log_weight[n]
        columns[-1, h] = log_weight[n] - 0.5 * (size * LOG_2PI + np.log(det[n]))
        for i in range(size):
            columns[first + i, h] = 0.0
            for j in range(size):
                row = triangle(max(i, j)) + min(i, j)
                columns[row, h] = packed[row, n]
                columns[first + i, h] += packed[row, n] * mean[n, j]
            columns[-1, h] -= 0.5 * columns[first + i, h] * mean[n, i]
    return definite
