"""Triangles of simple shapes, of shape (n, 3, 3), m."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def quad(*corners: ArrayLike) -> Array:
    """Return two triangles, of shape (2, 3, 3), m; their common diagonal joins corners 0 and 2."""
    a, b, c, d = np.array(corners, dtype=float)
    return np.array([[a, b, c], [a, c, d]])


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Array:
    """Return the twelve triangles of an axis-aligned box."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return np.concatenate(
        [
            quad((x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)),
            quad((x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)),
            quad((x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)),
            quad((x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1)),
            quad((x0, y0, z0), (x0, y1, z0), (x0, y1, z1), (x0, y0, z1)),
            quad((x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)),
        ]
    )
