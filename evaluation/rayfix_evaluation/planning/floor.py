"""Floor plans: the intersection of a scene with a horizontal plane."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def slice_mesh(vertices: ArrayLike, faces: ArrayLike, height: float) -> NDArray[np.float64]:
    """Cut a mesh with a horizontal plane.

    Parameters
    ----------
    vertices : ndarray of shape (n_vertices, 3), m
    faces : ndarray of int of shape (n_faces, 3)
    height : float, m
        z of the plane. A vertex on it counts as above.

    Returns
    -------
    ndarray of shape (n_segments, 2, 2), m
        Ends of the cuts, x and y.
    """
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces, dtype=np.int64)]
    above = corners[..., 2] >= height
    corners, above = corners[above.any(axis=1) & ~above.all(axis=1)], above[above.any(axis=1) & ~above.all(axis=1)]
    # One corner is alone on its side; the two edges from it cross the plane.
    alone = np.argmax(above == (above.sum(axis=1) == 1)[:, None], axis=1)
    row = np.arange(len(corners))
    tip = corners[row, alone]
    ends = []
    for step in (1, 2):
        other = corners[row, (alone + step) % 3]
        share = (height - tip[:, 2]) / (other[:, 2] - tip[:, 2])
        ends.append(tip[:, :2] + share[:, None] * (other - tip)[:, :2])
    return np.stack(ends, axis=1)
