"""Triangles of simple shapes, each an ndarray of shape (n, 3, 3), m."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def random_rotation(rng: np.random.Generator) -> Rotation:
    """Draw a rotation, all equally likely."""
    return Rotation.from_quat(rng.standard_normal(4))


def quad(*corners: ArrayLike) -> Array:
    """Return two triangles; their common diagonal joins corners 0 and 2."""
    a, b, c, d = np.array(corners, dtype=float)
    return np.array([[a, b, c], [a, c, d]])


def box(low: ArrayLike, high: ArrayLike) -> Array:
    """Return the triangles of an axis-aligned box, which face outwards: two for each side, -z, z, -y, y, -x, x."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, np.float64), np.asarray(high, np.float64)
    return np.concatenate(
        [
            quad((x0, y0, z0), (x0, y1, z0), (x1, y1, z0), (x1, y0, z0)),
            quad((x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)),
            quad((x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)),
            quad((x0, y1, z0), (x0, y1, z1), (x1, y1, z1), (x1, y1, z0)),
            quad((x0, y0, z0), (x0, y0, z1), (x0, y1, z1), (x0, y1, z0)),
            quad((x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)),
        ]
    )


def cut_in_three(triangles: Array) -> Array:
    """Cut every triangle into three at a point inside."""
    middle = (triangles * np.array([0.5, 0.3, 0.2])[:, None]).sum(axis=1)
    a, b, c = (triangles[:, i] for i in range(3))
    return np.concatenate([np.stack(t, axis=1) for t in ((a, b, middle), (b, c, middle), (c, a, middle))])
