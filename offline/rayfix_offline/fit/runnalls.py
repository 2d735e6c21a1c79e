"""Fewer components: merge those whose union loses least.

A. R. Runnalls, "Kullback-Leibler approach to Gaussian mixture reduction", IEEE Trans. Aerosp. Electron. Syst. 43 (3),
2007: merging components i and j into the Gaussian of their moments raises the divergence from the original mixture by
at most ``B(i, j) = ((w_i + w_j) log|P_ij| - w_i log|P_i| - w_j log|P_j|) / 2``.

What takes time are the determinants |P_ij|. They are computed for one component and many others at a time, so that the
processor works on several pairs in one instruction, and each bound is kept until one of its two components changes.
"""

from typing import Any

import numba
import numpy as np

from rayfix_tables.gaussians.tree_reduction import SMALLEST_PIVOT
from rayfix_tables.gaussians.triangles import pack_lower, triangle, unpack_lower

LANES = 128
"""Pairs whose determinants are computed side by side; their matrices fit the processor's first cache."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def union_log_dets(i: Any, first: Any, stop: Any, weight: Any, mean: Any, cov: Any, scratch: Any, out: Any) -> None:
    """Logarithms of the determinants of the covariances of component i united with others.

    The determinant is the product of the pivots of a symmetric elimination.

    Parameters
    ----------
    i : int
        United with itself, a component stays what it is.
    first, stop : int
        The others, numbers ``first`` to ``stop - 1``.
    weight : ndarray of shape (n,)
    mean : ndarray of shape (d, n)
    cov : ndarray of shape (d (d + 1) / 2, n)
        Lower triangles, row by row.
    scratch : ndarray
        Of :func:`new_scratch`.
    out : ndarray of shape (n,)
        Takes the logarithms at ``first`` to ``stop - 1``.
    """
    size = len(mean)
    share, spread, product, inverse, factor = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    apart = scratch[5 : 5 + size]
    union = scratch[5 + size :]
    for begin in range(first, stop, LANES):
        width = min(LANES, stop - begin)
        for k in range(width):
            share[k] = weight[i] / (weight[i] + weight[begin + k])
            spread[k] = share[k] * (1.0 - share[k])
            product[k] = 1.0
        place = 0
        for a in range(size):
            for k in range(width):
                apart[a, k] = mean[a, i] - mean[a, begin + k]
            for b in range(a + 1):
                for k in range(width):
                    other = cov[place, begin + k]
                    union[place, k] = other + share[k] * (cov[place, i] - other) + spread[k] * apart[a, k] * apart[b, k]
                place += 1
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
            # One logarithm of the product: the pivots of covariances in metres and radians are far from overflow.
            out[begin + k] = np.log(product[k])


@numba.njit(cache=True, nogil=True)
def new_scratch(size: Any) -> Any:
    """Room for :func:`union_log_dets` of components of ``size`` dimensions."""
    return np.empty((5 + size + triangle(size), LANES))


@numba.njit(cache=True, nogil=True)
def _unite(i: Any, j: Any, weight: Any, mean: Any, cov: Any) -> None:
    """Put the union of components i and j in the place of i."""
    total = weight[i] + weight[j]
    share = weight[i] / total
    place = 0
    for a in range(len(mean)):
        for b in range(a + 1):
            spread = share * (1.0 - share) * (mean[a, i] - mean[a, j]) * (mean[b, i] - mean[b, j])
            cov[place, i] = cov[place, j] + share * (cov[place, i] - cov[place, j]) + spread
            place += 1
    for a in range(len(mean)):
        mean[a, i] = mean[a, j] + share * (mean[a, i] - mean[a, j])
    weight[i] = total


@numba.njit(cache=True, nogil=True)
def _find_partner(i: Any, cost: Any, partner: Any, least: Any) -> None:
    """Find the later component that merges with component i at the least cost."""
    partner[i], least[i] = -1, np.inf
    for k in range(i + 1, len(cost)):
        if cost[i, k] < least[i]:
            partner[i], least[i] = k, cost[i, k]


@numba.njit(cache=True, nogil=True)
def merge_runnalls(weight: Any, mean: Any, cov: Any, label: Any, max_components: Any, max_divergence: Any) -> Any:
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
        _unite(i, j, weight, middle, packed)
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
