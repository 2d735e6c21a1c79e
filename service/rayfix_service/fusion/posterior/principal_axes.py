"""Principal axes of an ellipsoid, compiled: LAPACK's driver takes longer to prepare than three dimensions to solve."""

import math
from typing import Any

import numba
import numpy as np

_MOST_SWEEPS = 30
"""Convergence is quadratic; three or four sweeps will do."""


@numba.njit(cache=True, nogil=True)
def semi_axes(shape: Any) -> Any:
    """Vectors from the centre of an ellipsoid to the ends of its axes.

    Parameters
    ----------
    shape : ndarray of shape (3, 3), m2
        Symmetric; the ellipsoid is all x with ``x . shape^-1 x <= 1``.

    Returns
    -------
    ndarray of shape (3, 3), m
        Longest first, as rows.

    Notes
    -----
    Jacobi's rotations, each of which makes one element beside the diagonal zero: G. H. Golub and C. F. Van Loan,
    Matrix Computations, 4th edition, section 8.5.
    """
    a, rows = shape.copy(), np.eye(3)
    for _ in range(_MOST_SWEEPS):
        beside = abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2])
        if beside <= 1e-30 * (abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])):
            break
        _rotate(a, rows, 0, 1, 2)
        _rotate(a, rows, 0, 2, 1)
        _rotate(a, rows, 1, 2, 0)
    order = np.argsort(np.array([-a[0, 0], -a[1, 1], -a[2, 2]]))
    axes = np.empty((3, 3))
    for n in range(3):
        length = math.sqrt(max(a[order[n], order[n]], 0.0))
        for i in range(3):
            axes[n, i] = length * rows[order[n], i]
    return axes


@numba.njit(cache=True, nogil=True)
def _rotate(a: Any, rows: Any, p: Any, q: Any, r: Any) -> None:
    """Rotate axes ``p`` and ``q`` until ``a[p, q]`` is zero; ``r`` is the third."""
    if a[p, q] == 0.0:
        return
    half = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
    tangent = math.copysign(1.0, half) / (abs(half) + math.hypot(1.0, half))
    cosine = 1.0 / math.hypot(1.0, tangent)
    sine = tangent * cosine
    a[p, p] -= tangent * a[p, q]
    a[q, q] += tangent * a[p, q]
    a[p, q] = a[q, p] = 0.0
    at_p, at_q = a[p, r], a[q, r]
    a[p, r] = a[r, p] = cosine * at_p - sine * at_q
    a[q, r] = a[r, q] = sine * at_p + cosine * at_q
    for i in range(3):
        x, y = rows[p, i], rows[q, i]
        rows[p, i] = cosine * x - sine * y
        rows[q, i] = sine * x + cosine * y
