"""Gaussians over the state in information form, one in each column, and kernels that treat all columns at once.

The state is ``z = (x, clock offsets)``, of dimension d. A column holds one function

    exp(log_scale + eta . z - z . information . z / 2)

as the lower triangle of ``information`` row by row, then ``eta``, then ``log_scale``. Two such functions are multiplied
by adding their columns. Columns stand side by side, so that a kernel's innermost loop runs over them: compiled, it does
several columns with each instruction, whatever d is.

A function that does not constrain the position is constant over the whole free space, and does not constrain the clocks
either; one that does not constrain a clock is constant over the clock's range. The diagonal of ``information`` is zero
there.
"""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_tables.gaussians.constants import LOG_2PI
from rayfix_tables.gaussians.triangles import triangle

Array = NDArray[np.float64]


def pack(information: Array, eta: Array, log_scale: Array) -> Array:
    """Columns of functions.

    Parameters
    ----------
    information : ndarray of shape (n, d, d)
    eta : ndarray of shape (n, d)
    log_scale : ndarray of shape (n,)

    Returns
    -------
    ndarray of shape (rows, n)
    """
    lower = np.tril_indices(eta.shape[1])
    return np.concatenate([information[:, lower[0], lower[1]].T, eta.T, log_scale[None]])


def unpack(columns: Array) -> tuple[Array, Array, Array]:
    """Turn columns into ``information``, ``eta`` and ``log_scale``, as :func:`pack` takes them."""
    dimension = dimension_of(columns)
    first = triangle(dimension)
    i, j = np.tril_indices(dimension)
    information = np.empty((columns.shape[1], dimension, dimension))
    information[:, i, j] = information[:, j, i] = columns[:first].T
    return information, columns[first:-1].T.copy(), columns[-1].copy()


@numba.njit(cache=True, nogil=True)
def dimension_of(columns: Any) -> Any:
    """Return the dimension of the state of columns."""
    dimension = 3
    while triangle(dimension) + dimension + 1 < len(columns):
        dimension += 1
    return dimension


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add(columns: Any, which: Any, others: Any, out: Any) -> None:
    """Multiply all of the functions ``others`` by one of ``columns``, into ``out``."""
    for row in range(len(others)):
        value, other, target = columns[row, which], others[row], out[row]
        for n in range(len(other)):
            target[n] = value + other[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def integrate_last(columns: Any, size: Any, log_range: Any, det: Any, inverse: Any) -> None:
    """Integrate the last of ``size`` variables out, in place; its rows are not valid afterwards.

    Parameters
    ----------
    columns : ndarray of shape (rows, n)
    size : int
        Variables of the state that are left, this one included.
    log_range : float
        Natural logarithm of the range of the variable where nothing constrains it.
    det : ndarray of shape (n,)
        Multiplied by the pivot, the square root of which the integral is still to be divided by.
    inverse : ndarray of shape (n,)
        Scratch.
    """
    first = triangle(dimension_of(columns))
    last = size - 1
    row = triangle(last)
    pivot, linear, log_scale = columns[row + last], columns[first + last], columns[-1]
    for n in range(len(det)):
        known = pivot[n] > 0.0
        inverse[n] = 1.0 / pivot[n] if known else 0.0
        det[n] *= pivot[n] if known else 1.0
        log_scale[n] += 0.5 * linear[n] * linear[n] * inverse[n] + (0.5 * LOG_2PI if known else log_range)
    for i in range(last):
        left, target = columns[row + i], columns[first + i]
        for n in range(len(det)):
            target[n] -= left[n] * linear[n] * inverse[n]
        for j in range(i + 1):
            right, target = columns[row + j], columns[triangle(i) + j]
            for n in range(len(det)):
                target[n] -= left[n] * right[n] * inverse[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_integrals(columns: Any, log_volume: Any, log_range: Any, det: Any, out: Any) -> None:
    """Logarithms of the integrals over the state; -inf where there is none.

    Parameters
    ----------
    columns : ndarray of shape (rows, n)
        Overwritten.
    log_volume : float
        Natural logarithm of the free space's volume [m3], which stands for a position that nothing constrains.
    log_range : float
        Natural logarithm of the range [m] of a clock that nothing constrains.
    det : ndarray of shape (n,)
        Scratch.
    out : ndarray of shape (n,)
    """
    dimension = dimension_of(columns)
    first = triangle(dimension)
    for n in range(len(det)):
        det[n] = 1.0
    for size in range(dimension, 3, -1):
        integrate_last(columns, size, log_range, det, out)
    xx, yx, yy, zx, zy, zz = columns[0], columns[1], columns[2], columns[3], columns[4], columns[5]
    x, y, z, log_scale = columns[first], columns[first + 1], columns[first + 2], columns[-1]
    for n in range(len(out)):
        # L D L' of the position, which any function constrains in all three coordinates or not at all.
        p0 = xx[n]
        l10, l20 = yx[n] / p0, zx[n] / p0
        p1 = yy[n] - l10 * yx[n]
        rest = zy[n] - l20 * yx[n]
        l21 = rest / p1
        p2 = zz[n] - l20 * zx[n] - l21 * rest
        s0 = x[n]
        s1 = y[n] - l10 * s0
        s2 = z[n] - l20 * s0 - l21 * s1
        proper = (p0 > 0.0) & (p1 > 0.0) & (p2 > 0.0)
        peak = 1.5 * LOG_2PI + 0.5 * (s0 * s0 / p0 + s1 * s1 / p1 + s2 * s2 / p2)
        out[n] = log_scale[n] + (peak if proper else (-np.inf if p0 > 0.0 else log_volume))
        det[n] *= p0 * p1 * p2 if proper else 1.0
    for n in range(len(out)):
        out[n] -= 0.5 * np.log(det[n])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def invert_all(matrices: Any, size: Any, det: Any) -> None:
    """Inverses of symmetric matrices, in place, and their determinants; 0 for one that is not positive definite.

    Parameters
    ----------
    matrices : ndarray of shape (rows, n)
        Lower triangles, row by row, in the first rows.
    size : int
        Of the matrices.
    det : ndarray of shape (n,)
    """
    inverse = np.empty(len(det))
    for n in range(len(det)):
        det[n] = 1.0
    # The sweep operator: J. H. Goodnight, "A tutorial on the SWEEP operator", The American Statistician 33 (3), 1979.
    for p in range(size):
        pivot = matrices[triangle(p) + p]
        for n in range(len(det)):
            det[n] *= pivot[n] if pivot[n] > 0.0 else 0.0
            inverse[n] = 1.0 / pivot[n]
        for i in range(size):
            left = matrices[triangle(max(i, p)) + min(i, p)]
            for j in range(i + 1):
                if p in (i, j):
                    continue
                right, target = matrices[triangle(max(j, p)) + min(j, p)], matrices[triangle(i) + j]
                for n in range(len(det)):
                    target[n] -= left[n] * right[n] * inverse[n]
        for i in range(size):
            if i != p:
                target = matrices[triangle(max(i, p)) + min(i, p)]
                for n in range(len(det)):
                    target[n] *= inverse[n]
        for n in range(len(det)):
            pivot[n] = -inverse[n]
    for row in range(triangle(size)):
        target = matrices[row]
        for n in range(len(det)):
            target[n] = -target[n]
