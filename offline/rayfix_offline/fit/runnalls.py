"""Mixture reduction: merge the pair of components with the least increase in divergence, again and again.

A. R. Runnalls, "Kullback-Leibler approach to Gaussian mixture reduction", IEEE Trans. Aerosp. Electron. Syst. 43 (3),
2007: merging components i and j into the Gaussian of their moments raises the divergence from the original mixture by
at most ``B(i, j) = ((w_i + w_j) log|P_ij| - w_i log|P_i| - w_j log|P_j|) / 2``.

Most of the time is spent on the determinants |P_ij|. They are computed for one component and many others at a time, so
that one instruction of the processor treats several pairs. A bound is kept until one of its components changes.
"""

from typing import Any

import numba
import numpy as np

from rayfix_tables.gaussians.tree_reduction import SMALLEST_PIVOT
from rayfix_tables.gaussians.triangles import pack_lower, triangle, unpack_lower

LANES = 128
"""Pairs whose determinants are computed together; their matrices fit into the first-level cache."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def union_log_dets(i: Any, first: Any, stop: Any, weight: Any, mean: Any, cov: Any, scratch: Any, out: Any) -> None:
    """Logarithms of the determinants of the covariances of component i merged with others.

    The determinant is the product of the pivots of a symmetric elimination.

    Parameters
    ----------
    i : int
        Merged with itself, a component does not change.
    first, stop : int
        The others are ``first`` to ``stop - 1``.
    weight : ndarray of shape (n,)
    mean : ndarray of shape (d, n)
    cov : ndarray of shape (d (d + 1) / 2, n)
        Lower triangles, row by row.
    scratch : ndarray
        Of :func:`new_scratch`.
    out : ndarray of shape (n,)
        Filled from ``first`` to ``stop - 1``.
    """
    size = len(mean)
    fraction, spread, product, inverse, factor = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    apart = scratch[5 : 5 + size]
    union = scratch[5 + size :]
    for begin in range(first, stop, LANES):
        width = min(LANES, stop - begin)
        for k in range(width):
            fraction[k] = weight[i] / (weight[i] + weight[begin + k])
            spread[k] = fraction[k] * (1.0 - fraction[k])
            product[k] = 1.0
        row = 0
        for a in range(size):
            for k in range(width):
                apart[a, k] = mean[a, i] - mean[a, begin + k]
            for b in range(a + 1):
                for k in range(width):
                    other = cov[row, begin + k]
                    union[row, k] = other + fraction[k] * (cov[row, i] - other) + spread[k] * apart[a, k] * apart[b, k]
                row += 1
        for j in range(size):
            diagonal = triangle(j) + j
            for k in range(width):
                pivot = max(union[diagonal, k], SMALLEST_PIVOT)
                product[k] *= pivot
                inverse[k] = 1.0 / pivot
            for a in range(j + 1, size):
                row = triangle(a)
                for k in range(width):
                    factor[k] = union[row + j, k] * inverse[k]
                for b in range(j + 1, a + 1):
                    column = triangle(b) + j
                    for k in range(width):
                        union[row + b, k] -= factor[k] * union[column, k]
        for k in range(width):
            # One logarithm of the product, which is far from overflow for covariances in metres and radians.
            out[begin + k] = np.log(product[k])


@numba.njit(cache=True, nogil=True)
def new_scratch(size: Any) -> Any:
    """Allocate the scratch of :func:`union_log_dets` for components of ``size`` dimensions."""
    return np.empty((5 + size + triangle(size), LANES))


@numba.njit(cache=True, nogil=True)
def _merge(i: Any, j: Any, weight: Any, mean: Any, cov: Any) -> None:
    """Replace component i by the union of components i and j."""
    total = weight[i] + weight[j]
    fraction = weight[i] / total
    row = 0
    for a in range(len(mean)):
        for b in range(a + 1):
            spread = fraction * (1.0 - fraction) * (mean[a, i] - mean[a, j]) * (mean[b, i] - mean[b, j])
            cov[row, i] = cov[row, j] + fraction * (cov[row, i] - cov[row, j]) + spread
            row += 1
    for a in range(len(mean)):
        mean[a, i] = mean[a, j] + fraction * (mean[a, i] - mean[a, j])
    weight[i] = total


@numba.njit(cache=True, nogil=True)
def _find_partner(i: Any, cost: Any, partner: Any, least: Any) -> None:
    """Find the component after i that merges with it at the least cost."""
    partner[i], least[i] = -1, np.inf
    for k in range(i + 1, len(cost)):
        if cost[i, k] < least[i]:
            partner[i], least[i] = k, cost[i, k]


@numba.njit(cache=True, nogil=True)
def merge_runnalls(weight: Any, mean: Any, cov: Any, label: Any, max_components: Any, max_divergence: Any) -> Any:
    """Merge components, in place, until the next merge costs too much.

    Parameters
    ----------
    weight : ndarray of shape (n,)
        Sum to 1.
    mean : ndarray of shape (n, d)
    cov : ndarray of shape (n, d, d)
    label : ndarray of int64, shape (n,)
        Of two merged components the label of the heavier one remains.
    max_components : int
        Merging continues at any cost until this number is reached.
    max_divergence : float
        From then on, merging stops before the first merge that costs more than this.

    Returns
    -------
    ndarray of bool, shape (n,)
        The components that remain.
    """
    count, size = mean.shape
    middle = np.empty((size, count))
    packed = np.empty((triangle(size), count))
    for i in range(count):
        pack_lower(cov[i], packed, i)
        for a in range(size):
            middle[a, i] = mean[i, a]
    scratch = new_scratch(size)
    alive = np.ones(count, np.bool_)
    cost = np.empty((count, count))  # of a pair, at the lower number's row
    log_det = np.empty(count)
    row = np.empty(count)
    partner = np.empty(count, np.int64)
    least = np.empty(count)
    for i in range(count):
        union_log_dets(i, i, count, weight, middle, packed, scratch, cost[i])
        log_det[i] = cost[i, i]
    for i in range(count):
        for k in range(i + 1, count):
            joint = (weight[i] + weight[k]) * cost[i, k]
            cost[i, k] = 0.5 * (joint - weight[i] * log_det[i] - weight[k] * log_det[k])
        _find_partner(i, cost, partner, least)
    left = count
    while left > 1:
        i = int(np.argmin(least))
        if left <= max_components and least[i] > max_divergence:
            break
        j = partner[i]
        if weight[j] > weight[i]:
            label[i] = label[j]
        _merge(i, j, weight, middle, packed)
        alive[j] = False
        least[j] = np.inf
        left -= 1
        for k in range(j):
            cost[k, j] = np.inf
        # A plain 0 would have it compiled once more, for a constant.
        union_log_dets(i, np.int64(0), count, weight, middle, packed, scratch, row)
        log_det[i] = row[i]
        for k in range(count):
            if alive[k] and k != i:
                joint = (weight[i] + weight[k]) * row[k]
                cost[min(i, k), max(i, k)] = 0.5 * (joint - weight[i] * log_det[i] - weight[k] * log_det[k])
        for k in range(count):
            if not alive[k]:
                continue
            if k == i or partner[k] == i or partner[k] == j:
                _find_partner(k, cost, partner, least)
            elif k < i and cost[k, i] < least[k]:
                partner[k], least[k] = i, cost[k, i]
    for i in range(count):
        if not alive[i]:
            continue
        unpack_lower(packed, i, cov[i])
        for a in range(size):
            mean[i, a] = middle[a, i]
    return alive
