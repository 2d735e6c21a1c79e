"""Mixture reduction by a tree, for thousands of components.

The tree is made by repeatedly halving the bounding box of the means along its longest side. From the leaves up,
the two halves of a node are merged into one component if that raises the divergence by no more than a limit (the bound
of A. R. Runnalls, "Kullback-Leibler approach to Gaussian mixture reduction", IEEE Trans. Aerosp.
Electron. Syst. 43 (3), 2007: ``((w_i + w_j) log|P_ij| - w_i log|P_i| - w_j log|P_j|) / 2`` for components i and j and
their union's covariance P_ij). Only neighbours are compared: the time grows with the number of components, not of
pairs.

The divergence may be that of the mixture *as it is measured*: noise is added before determinants are computed. This
merges components that no measurement distinguishes.
"""

from typing import Any

import numba
import numpy as np

SMALLEST_PIVOT = 1e-30
"""Smallest pivot of an elimination, for covariances that rounding has made singular."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def halve_and_merge(weight: Any, mean: Any, cov: Any, group: Any, scale: Any, noise: Any, max_divergence: Any) -> Any:
    """Merge components, in place.

    Parameters
    ----------
    weight : ndarray of shape (n,)
        Sum to 1.
    mean : ndarray of shape (n, d)
    cov : ndarray of shape (n, d, d)
    group : ndarray of int64, shape (n,)
        Components of different groups are not merged.
    scale : tuple of d floats, or ndarray of shape (d,)
        Units in which the sides of a box are compared. With a tuple, d is known at compile time, which is twice as
        fast.
    noise : tuple of d floats, or ndarray of shape (d,)
        Variances of the noise that measurements add.
    max_divergence : float
        Largest divergence of a merge, nats.

    Returns
    -------
    ndarray of int64, shape (n,)
        Component that each one was merged into; its own index if it remains.
    """
    count, dimension = len(mean), len(scale)
    order, left, right, size = _tree(mean, group, scale)
    log_det = np.empty(count)
    work = np.empty((dimension, dimension))
    into = np.arange(count)
    for i in range(count):
        log_det[i] = _noisy_log_det(cov[i], noise, work)
    whole = np.full(size, -1, np.int64)  # the component that a node was merged into
    union = np.empty((dimension, dimension))
    for node in range(size - 1, -1, -1):
        if left[node] < 0:
            whole[node] = order[right[node]]
            continue
        i, j = whole[left[node]], whole[right[node]]
        if i < 0 or j < 0 or group[i] != group[j]:
            continue
        total = weight[i] + weight[j]
        fraction = weight[i] / total if total > 0.0 else 0.5
        for a in range(dimension):
            offset = fraction * (1.0 - fraction) * (mean[i, a] - mean[j, a])
            for b in range(a + 1):
                union[a, b] = (
                    cov[j, a, b] + fraction * (cov[i, a, b] - cov[j, a, b]) + offset * (mean[i, b] - mean[j, b])
                )
        united = _noisy_log_det(union, noise, work)
        if 0.5 * (total * united - weight[i] * log_det[i] - weight[j] * log_det[j]) > max_divergence:
            continue
        for a in range(dimension):
            mean[i, a] = mean[j, a] + fraction * (mean[i, a] - mean[j, a])
            for b in range(a + 1):
                cov[i, a, b] = union[a, b]
                cov[i, b, a] = union[a, b]
        weight[i] = total
        log_det[i] = united
        into[j] = i
        whole[node] = i
    for i in range(count):
        while into[into[i]] != into[i]:
            into[i] = into[into[i]]
    return into


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _tree(mean: Any, group: Any, scale: Any) -> Any:
    """Halve groups and then their boxes until each contains one component.

    Returns
    -------
    order : ndarray of int64, shape (n,)
    left, right : ndarray of int64, shape (2 n - 1,)
        Children of each node, which follow it; for a leaf -1 and its index in ``order``.
    size : int
        Number of nodes.
    """
    count, dimension = len(mean), len(scale)
    order = np.arange(count)
    most = 2 * count - 1
    first, stop = np.empty(most, np.int64), np.empty(most, np.int64)
    left, right = np.empty(most, np.int64), np.empty(most, np.int64)
    mixed = np.zeros(most, np.bool_)
    low, high = np.empty(dimension), np.empty(dimension)
    first[0], stop[0], mixed[0] = 0, count, True
    size = 1
    node = 0
    while node < size:
        begin, end = first[node], stop[node]
        if end - begin == 1:
            left[node], right[node] = -1, begin
            node += 1
            continue
        least = greatest = group[order[begin]]
        if mixed[node]:  # the halves of a box of one group have one group
            for n in range(begin, end):
                least, greatest = min(least, group[order[n]]), max(greatest, group[order[n]])
        mixed[node] = greatest > least
        if mixed[node]:
            i = _partition(order, begin, end, group, least + (greatest - least) // 2 + 1)
        else:
            for a in range(dimension):
                low[a], high[a] = np.inf, -np.inf
            for n in range(begin, end):
                component = order[n]
                for a in range(dimension):
                    low[a], high[a] = min(low[a], mean[component, a]), max(high[a], mean[component, a])
            longest, axis = -1.0, 0
            for a in range(dimension):
                if (high[a] - low[a]) / scale[a] > longest:
                    longest, axis = (high[a] - low[a]) / scale[a], a
            i = _partition(order, begin, end, mean[:, axis], 0.5 * (low[axis] + high[axis]))
        if i in (begin, end):  # all means are equal
            i = (begin + end) // 2
        left[node], right[node] = size, size + 1
        first[size], stop[size], mixed[size] = begin, i, mixed[node]
        first[size + 1], stop[size + 1], mixed[size + 1] = i, end, mixed[node]
        size += 2
        node += 1
    return order, left, right, size


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _partition(order: Any, begin: Any, end: Any, value: Any, limit: Any) -> Any:
    """Move the components of a part of ``order`` with values below a limit to its front; return where they end."""
    i, j = begin, end - 1
    while i <= j:
        component = order[i]
        if value[component] < limit:
            i += 1
        else:
            order[i], order[j] = order[j], component
            j -= 1
    return i


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _noisy_log_det(cov: Any, noise: Any, work: Any) -> Any:
    """Logarithm of the determinant of a covariance with noise; ``work`` has its shape."""
    dimension = len(noise)
    for a in range(dimension):
        for b in range(a + 1):
            work[a, b] = cov[a, b]
        work[a, a] += noise[a]
    product = 1.0
    for j in range(dimension):
        pivot = max(work[j, j], SMALLEST_PIVOT)
        product *= pivot
        for a in range(j + 1, dimension):
            factor = work[a, j] / pivot
            for b in range(j + 1, a + 1):
                work[a, b] -= factor * work[b, j]
    return np.log(product)
