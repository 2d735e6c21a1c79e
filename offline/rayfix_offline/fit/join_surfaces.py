"""Groups of a cell on the same curved surface are joined, with the moments of all their points."""

from typing import Any

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def join_groups(
    surface_sequence: Any,
    slices: Any,
    mass: Any,
    mean: Any,
    cov: Any,
    mirror: Any,
    num_walls: Any,
) -> Any:
    """Join the groups of the same surface sequence and slice.

    Parameters
    ----------
    surface_sequence, slices : ndarray of int64, shape (n,)
    mass : ndarray of shape (n,)
    mean : ndarray of shape (n, d)
    cov : ndarray of shape (n, d, d)
    mirror : ndarray of shape (n, 3, 3)
    num_walls : ndarray of int64, shape (n,)

    Returns
    -------
    surface_sequence : ndarray of int64, shape (m,)
    mass : ndarray of shape (m,)
    mean : ndarray of shape (m, d)
    cov : ndarray of shape (m, d, d)
        Sum of the covariances within the groups and of their means.
    mirror : ndarray of shape (m, 3, 3)
        Mean, weighted by mass: the effect of a small change of the launch direction on the position.
    num_walls : ndarray of int64, shape (m,)
        Of the first of the groups.
    """
    count, size = mean.shape
    order = np.argsort(surface_sequence * (slices.max() + 1) + slices, kind="mergesort") if count else np.arange(0)
    first = np.empty(count, np.int64)
    group = np.empty(count, np.int64)
    joined = 0
    for n in range(count):
        i = order[n]
        before = order[max(n - 1, 0)]
        if n == 0 or surface_sequence[i] != surface_sequence[before] or slices[i] != slices[before]:
            first[joined] = i
            joined += 1
        group[i] = joined - 1
    # In the order of the input, so that later sums do not depend on the numbering of sequences.
    ranks = np.empty(joined, np.int64)
    ranks[np.argsort(first[:joined])] = np.arange(joined)
    group = ranks[group]
    first = np.sort(first[:joined])
    out_mass = np.zeros(joined)
    out_mean = np.zeros((joined, size))
    out_cov = np.zeros((joined, size, size))
    out_mirror = np.zeros((joined, 3, 3))
    for i in range(count):
        out_mass[group[i]] += mass[i]
    for i in range(count):
        fraction = mass[i] / out_mass[group[i]]
        out_mean[group[i]] += fraction * mean[i]
        out_mirror[group[i]] += fraction * mirror[i]
    for i in range(count):
        g = group[i]
        fraction = mass[i] / out_mass[g]
        for a in range(size):
            for b in range(size):
                apart = (mean[i, a] - out_mean[g, a]) * (mean[i, b] - out_mean[g, b])
                out_cov[g, a, b] += fraction * (cov[i, a, b] + apart)
    return surface_sequence[first], out_mass, out_mean, out_cov, out_mirror, num_walls[first]
