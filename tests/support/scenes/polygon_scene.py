"""A hall with a partition and a doorway in it, as polygons, and its volumes in closed form.

::

    y 6 +----------+-+----------+      hall 10 x 6 x 3 m; partition 0.2 m thick at x = 4.9,
        |          | |          |      its doorway from y = 2.5 to 3.5, 2.1 m high
    3.5 |          +-+          |
    2.5 |          +-+          |      partition: 0.2 (6 x 3 - 1 x 2.1) = 3.18 m3
        |          | |          |      free: 180 - 3.18 = 176.82 m3
      0 +----------+-+----------+ x
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Polygon = NDArray[np.float64]
"""Corners, shape (n, 3), m."""

PARTITION_VOLUME = 0.2 * (6.0 * 3.0 - 1.0 * 2.1)
FREE_VOLUME = 10.0 * 6.0 * 3.0 - PARTITION_VOLUME


def hall() -> list[Polygon]:
    """Six quadrilaterals that face inwards."""
    low, high = np.zeros(3), np.array((10.0, 6.0, 3.0))
    corners = np.array([[(low, high)[(k >> axis) & 1][axis] for axis in range(3)] for k in range(8)])
    rings = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return [corners[list(ring)] for ring in rings]


def partition(*, first: int = 0) -> list[Polygon]:
    """Two faces of eight corners around the doorway, and eight quadrilaterals between them, facing outwards.

    Parameters
    ----------
    first : int
        Corner that the two faces begin at.
    """
    outline = np.array([(0, 0), (2.5, 0), (2.5, 2.1), (3.5, 2.1), (3.5, 0), (6, 0), (6, 3), (0, 3)], float)
    front, back = (np.insert(outline, 0, x, axis=1) for x in (4.9, 5.1))
    sides = [np.array([front[k], front[k - 7], back[k - 7], back[k]]) for k in range(8)]
    return [np.roll(front[::-1], first, axis=0), np.roll(back, first, axis=0), *sides]


def volume(polygons: Sequence[Polygon]) -> float:
    """Volume that flat polygons enclose, m3, by the divergence theorem, without cutting them."""
    total = 0.0
    for ring in polygons:
        area = 0.5 * np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)
        total += float(ring[0] @ area) / 3.0
    return total


def indexed(polygons: Sequence[Polygon]) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Points without repeats, and each polygon's corners among them."""
    points, places = np.unique(np.concatenate(polygons), axis=0, return_inverse=True)
    ends = np.cumsum([len(ring) for ring in polygons])[:-1]
    return points, [[int(k) for k in ring] for ring in np.split(places.reshape(-1), ends)]
