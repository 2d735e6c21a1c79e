"""Fewer components: merge those whose union loses least.

A. R. Runnalls, "Kullback-Leibler approach to Gaussian mixture reduction", IEEE Trans. Aerosp. Electron. Syst. 43 (3),
2007: merging components i and j into the Gaussian of their moments raises the divergence from the original mixture by
at most ``B(i, j) = ((w_i + w_j) log|P_ij| - w_i log|P_i| - w_j log|P_j|) / 2``.
"""

from typing import Any

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def log_det(
    matrix: Any,
    scratch: Any,
) -> Any:
    """Logarithm of the determinant of a positive definite matrix, by Cholesky; ``scratch`` has its shape."""
    size = len(matrix)
    # One logarithm of the product: the pivots of covariances in metres and radians are far from overflow.
    product = 1.0
    for j in range(size):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= scratch[j, k] * scratch[j, k]
        pivot = max(pivot, 1e-30)
        product *= pivot
        root = np.sqrt(pivot)
        scratch[j, j] = root
        for i in range(j + 1, size):
            value = matrix[i, j]
            for k in range(j):
                value -= scratch[i, k] * scratch[j, k]
            scratch[i, j] = value / root
    return np.log(product)


@numba.njit(cache=True, nogil=True)
def merged_cov(
    wa: Any,
    mean_a: Any,
    cov_a: Any,
    wb: Any,
    mean_b: Any,
    cov_b: Any,
    out: Any,
) -> None:
    """Covariance of the union of two weighted Gaussians, into ``out``."""
    share_a = wa / (wa + wb)
    share_b = 1.0 - share_a
    for i in range(len(mean_a)):
        apart = mean_a[i] - mean_b[i]
        for j in range(i + 1):
            value = share_a * cov_a[i, j] + share_b * cov_b[i, j]
            value += share_a * share_b * apart * (mean_a[j] - mean_b[j])
            out[i, j] = value
            out[j, i] = value


@numba.njit(cache=True, nogil=True)
def _best_partner(
    i: Any,
    count: Any,
    alive: Any,
    weight: Any,
    mean: Any,
    cov: Any,
    logdet: Any,
    best: Any,
    cost: Any,
    union: Any,
    scratch: Any,
) -> None:
    best[i] = -1
    cost[i] = np.inf
    for j in range(i + 1, count):
        if alive[j]:
            merged_cov(weight[i], mean[i], cov[i], weight[j], mean[j], cov[j], union)
            joint = (weight[i] + weight[j]) * log_det(union, scratch)
            bound = 0.5 * (joint - weight[i] * logdet[i] - weight[j] * logdet[j])
            if bound < cost[i]:
                cost[i] = bound
                best[i] = j


@numba.njit(cache=True, nogil=True)
def merge_runnalls(
    weight: Any,
    mean: Any,
    cov: Any,
    label: Any,
    max_components: Any,
    max_divergence: Any,
) -> Any:
    """Merge components, in place, until the next merge would cost too much.

    Parameters
    ----------
    weight : ndarray of shape (n,)
        Sum to 1.
    mean : ndarray of shape (n, d)
    cov : ndarray of shape (n, d, d)
    label : ndarray of int64, shape (n,)
        Carried along; of two merged components the heavier one's stays.
    max_components : int
        Merging goes on at any cost until no more than these are left.
    max_divergence : float
        Below that number, merging stops at the first merge that costs more than this.

    Returns
    -------
    ndarray of bool, shape (n,)
        The components that are left.
    """
    count = len(weight)
    size = mean.shape[1]
    union = np.empty((size, size))
    scratch = np.empty((size, size))
    alive = np.ones(count, np.bool_)
    logdet = np.empty(count)
    best = np.empty(count, np.int64)
    cost = np.empty(count)
    for i in range(count):
        logdet[i] = log_det(cov[i], scratch)
    for i in range(count):
        _best_partner(i, count, alive, weight, mean, cov, logdet, best, cost, union, scratch)
    left = count
    while left > 1:
        i = int(np.argmin(cost))
        if left <= max_components and cost[i] > max_divergence:
            break
        j = best[i]
        merged_cov(weight[i], mean[i], cov[i], weight[j], mean[j], cov[j], union)
        if weight[j] > weight[i]:
            label[i] = label[j]
        total = weight[i] + weight[j]
        for a in range(size):
            mean[i, a] = (weight[i] * mean[i, a] + weight[j] * mean[j, a]) / total
            for b in range(size):
                cov[i, a, b] = union[a, b]
        weight[i] = total
        logdet[i] = log_det(cov[i], scratch)
        alive[j] = False
        cost[j] = np.inf
        left -= 1
        _best_partner(i, count, alive, weight, mean, cov, logdet, best, cost, union, scratch)
        for k in range(count):
            if not alive[k] or k == i:
                continue
            if best[k] == i or best[k] == j:
                _best_partner(k, count, alive, weight, mean, cov, logdet, best, cost, union, scratch)
            elif k < i:
                merged_cov(weight[k], mean[k], cov[k], weight[i], mean[i], cov[i], union)
                joint = (weight[k] + weight[i]) * log_det(union, scratch)
                bound = 0.5 * (joint - weight[k] * logdet[k] - weight[i] * logdet[i])
                if bound < cost[k]:
                    cost[k] = bound
                    best[k] = i
    return alive
