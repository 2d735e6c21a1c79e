"""Fewer components, thousands at a time: halve the space they lie in and merge the halves where little is lost.

A tree over the components is made by halving the box of their means along its longest side, again and again. From the
leaves up, the two halves of a node become one component where that raises the divergence by no more than is allowed
(the bound is Runnalls', see :mod:`rayfix_offline.merge`). Each component meets only its like, so the time grows with
the number of components and not with that of their pairs.

What no measurement tells apart need not be kept apart. The divergence is therefore that of the mixture *as it is
measured*: noise is added to the ray coordinates before determinants are taken.
"""

from typing import Any

import numba
import numpy as np

from rayfix_offline.merge import SMALLEST_PIVOT
from rayfix_offline.moments import SIZE


@numba.njit(cache=True, nogil=True)
def halve_and_merge(
    weight: Any, mean: Any, cov: Any, label: Any, scale: Any, noise: Any, max_divergence: Any, alive: Any
) -> None:
    """Merge components, in place.

    Parameters
    ----------
    weight : ndarray of shape (n,)
        Sum to 1.
    mean : ndarray of shape (n, 6)
    cov : ndarray of shape (n, 6, 6)
    label : ndarray of int8, shape (n,)
        Carried along; of two merged components the heavier one's stays.
    scale : ndarray of shape (6,)
        Lengths in the units of which the sides of a box are compared.
    noise : ndarray of shape (6,)
        Variances of the noise that measurements add.
    max_divergence : float
        What a merge may cost, nats.
    alive : ndarray of bool, shape (n,)
        Set to the components that are left.
    """
    count = len(weight)
    order, left, right, size = _tree(mean, scale)
    log_det = np.empty(count)
    work = np.empty((SIZE, SIZE))
    for i in range(count):
        alive[i] = True
        log_det[i] = _noisy_log_det(cov[i], noise, work)
    whole = np.full(size, -1, np.int64)  # the one component that a node has become
    union = np.empty((SIZE, SIZE))
    for node in range(size - 1, -1, -1):
        if left[node] < 0:
            whole[node] = order[right[node]]
            continue
        i, j = whole[left[node]], whole[right[node]]
        if i < 0 or j < 0:
            continue
        total = weight[i] + weight[j]
        share = weight[i] / total
        for a in range(SIZE):
            apart = share * (1.0 - share) * (mean[i, a] - mean[j, a])
            for b in range(a + 1):
                value = cov[j, a, b] + share * (cov[i, a, b] - cov[j, a, b]) + apart * (mean[i, b] - mean[j, b])
                union[a, b] = value
                union[b, a] = value
        united = _noisy_log_det(union, noise, work)
        if 0.5 * (total * united - weight[i] * log_det[i] - weight[j] * log_det[j]) > max_divergence:
            continue
        if weight[j] > weight[i]:
            label[i] = label[j]
        for a in range(SIZE):
            mean[i, a] = mean[j, a] + share * (mean[i, a] - mean[j, a])
            for b in range(SIZE):
                cov[i, a, b] = union[a, b]
        weight[i] = total
        log_det[i] = united
        alive[j] = False
        whole[node] = i


@numba.njit(cache=True, nogil=True)
def _tree(mean: Any, scale: Any) -> Any:
    """Halve boxes until each holds one component.

    Returns
    -------
    order : ndarray of int64, shape (n,)
    left, right : ndarray of int64, shape (2 n - 1,)
        Children of each node, which come after it; of a leaf -1 and its place in ``order``.
    size : int
        Number of nodes.
    """
    count = len(mean)
    order = np.arange(count)
    most = 2 * count - 1
    first, stop = np.empty(most, np.int64), np.empty(most, np.int64)
    left, right = np.empty(most, np.int64), np.empty(most, np.int64)
    first[0], stop[0] = 0, count
    size = 1
    node = 0
    while node < size:
        begin, end = first[node], stop[node]
        if end - begin == 1:
            left[node], right[node] = -1, begin
            node += 1
            continue
        longest, axis, middle = -1.0, 0, 0.0
        for a in range(SIZE):
            low, high = np.inf, -np.inf
            for n in range(begin, end):
                low, high = min(low, mean[order[n], a]), max(high, mean[order[n], a])
            if (high - low) / scale[a] > longest:
                longest, axis, middle = (high - low) / scale[a], a, 0.5 * (low + high)
        i, j = begin, end - 1
        while i <= j:
            if mean[order[i], axis] < middle:
                i += 1
            else:
                order[i], order[j] = order[j], order[i]
                j -= 1
        if i in (begin, end):  # all in one place
            i = (begin + end) // 2
        left[node], right[node] = size, size + 1
        first[size], stop[size] = begin, i
        first[size + 1], stop[size + 1] = i, end
        size += 2
        node += 1
    return order, left, right, size


@numba.njit(cache=True, nogil=True)
def _noisy_log_det(cov: Any, noise: Any, work: Any) -> Any:
    """Logarithm of the determinant of a covariance with noise; ``work`` has its shape."""
    for a in range(SIZE):
        for b in range(a + 1):
            work[a, b] = cov[a, b]
        work[a, a] += noise[a]
    product = 1.0
    for j in range(SIZE):
        pivot = max(work[j, j], SMALLEST_PIVOT)
        product *= pivot
        for a in range(j + 1, SIZE):
            factor = work[a, j] / pivot
            for b in range(j + 1, a + 1):
                work[a, b] -= factor * work[b, j]
    return np.log(product)
