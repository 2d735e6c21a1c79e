"""Triangles of symmetric matrices, packed row by row: the upper one in a table's file, the lower one in kernels."""

from typing import Any

import numba


@numba.njit(cache=True, nogil=True)
def triangle(size: Any) -> Any:
    """Return the number of entries of a triangle of a matrix of ``size`` rows."""
    return size * (size + 1) // 2


@numba.njit(cache=True, nogil=True)
def unpack_upper(packed: Any, n: Any, matrix: Any, first: Any) -> None:
    """Unpack one of many symmetric matrices; the compiled twin of :func:`rayfix_tables.mixture.unpack`.

    Parameters
    ----------
    packed : ndarray of shape (k, 6)
        Upper triangles.
    n : int
        Row.
    matrix : ndarray of shape (d, d)
        Filled from its row and column ``first`` on; slicing each matrix would be much slower.
    first : int
    """
    entry = 0
    for i in range(3):
        for j in range(i, 3):
            matrix[first + i, first + j] = packed[n, entry]
            matrix[first + j, first + i] = packed[n, entry]
            entry += 1


@numba.njit(cache=True, nogil=True)
def pack_lower(matrix: Any, columns: Any, n: Any) -> None:
    """Pack the lower triangle of a matrix into one of many columns.

    Parameters
    ----------
    matrix : ndarray of shape (d, d)
    columns : ndarray of shape (d (d + 1) / 2, k)
    n : int
        Column.
    """
    for i in range(len(matrix)):
        for j in range(i + 1):
            columns[triangle(i) + j, n] = matrix[i, j]


@numba.njit(cache=True, nogil=True)
def unpack_lower(columns: Any, n: Any, matrix: Any) -> None:
    """Unpack a column of :func:`pack_lower` into a symmetric matrix."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            matrix[i, j] = columns[triangle(i) + j, n]
            matrix[j, i] = columns[triangle(i) + j, n]
