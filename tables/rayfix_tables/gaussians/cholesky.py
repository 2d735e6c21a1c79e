"""Compiled kernels on one Gaussian at a time."""

from typing import Any

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def log_sum(values: Any) -> Any:
    """Logarithm of the sum of numbers that are given by their logarithms."""
    top = values.max()
    if top == -np.inf:
        return top
    total = 0.0
    for n in range(len(values)):
        total += np.exp(values[n] - top)
    return top + np.log(total)


@numba.njit(cache=True, nogil=True)
def cholesky(matrix: Any, lower: Any) -> Any:
    """Cholesky factor into ``lower``; False when the matrix is not positive definite or not finite."""
    size = len(matrix)
    for j in range(size):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= lower[j, k] * lower[j, k]
        if not 0.0 < pivot < np.inf:
            return False
        root = np.sqrt(pivot)
        lower[j, j] = root
        for i in range(j + 1, size):
            value = matrix[i, j]
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            lower[i, j] = value / root
    return True


@numba.njit(cache=True, nogil=True)
def solve(lower: Any, vector: Any, solution: Any) -> None:
    """Solve ``matrix solution = vector`` for a matrix given by its Cholesky factor, into ``solution``."""
    size = len(lower)
    for i in range(size):
        value = vector[i]
        for k in range(i):
            value -= lower[i, k] * solution[k]
        solution[i] = value / lower[i, i]
    for i in range(size - 1, -1, -1):
        value = solution[i]
        for k in range(i + 1, size):
            value -= lower[k, i] * solution[k]
        solution[i] = value / lower[i, i]


@numba.njit(cache=True, nogil=True)
def invert(lower: Any, inverse: Any) -> None:
    """Inverse of a matrix from its Cholesky factor, into ``inverse``."""
    size = len(lower)
    unit, column = np.zeros(size), np.empty(size)
    for c in range(size):
        unit[c] = 1.0
        solve(lower, unit, column)
        unit[c] = 0.0
        inverse[:, c] = column
