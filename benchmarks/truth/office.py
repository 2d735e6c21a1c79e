"""An office of sheets for comparisons with Sionna RT: ten rooms along a corridor, with doors, glass and furniture.

Every wall is one sheet with the thickness of its material, because Sionna RT takes every face for a slab. No two sheets
lie on each other, where the two solvers would differ.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OFFICE_SIZE = (20.0, 14.0, 3.0)
"""Length along x, y and z, m."""

THICKNESS = {"concrete": 0.2, "plasterboard": 0.1, "glass": 0.012, "wood": 0.04, "chipboard": 0.03, "metal": 0.01}
"""Thickness of the sheets of each material, m."""

STATIONS = np.array([[0.3, 0.3, 2.7], [19.7, 0.4, 2.6], [19.6, 13.7, 2.7], [0.4, 13.6, 2.6], [10.1, 7.1, 2.8]])
"""Positions of five stations, shape (5, 3), m."""

_DOOR = (0.9, 2.1)  # width and height, m
_CORRIDOR = (6.0, 8.0)  # of y, m
_ROOMS = (0.0, 3.7, 7.95, 11.8, 16.2, 20.0)  # of x, m; rooms of one width would have different paths of one length


@dataclass(frozen=True, kw_only=True)
class Sheets:
    """Triangles by material.

    Attributes
    ----------
    vertices : ndarray of shape (n_vertices, 3), m
    faces : ndarray of int of shape (n_faces, 3)
    materials : tuple of str
        Material of each face, by its name in ITU-R P.2040.
    """

    vertices: Array
    faces: NDArray[np.int64]
    materials: tuple[str, ...]


class _Builder:
    """Collects rectangles."""

    def __init__(self) -> None:
        self.corners: list[Array] = []
        self.materials: list[str] = []

    def rectangle(self, axis: int, at: float, low: tuple[float, float], high: tuple[float, float], name: str) -> None:
        """Add a rectangle across an axis; the corners are those of the other two axes in their order."""
        others = [k for k in range(3) if k != axis]
        corners = np.full((4, 3), at)
        corners[:, others[0]] = [low[0], high[0], high[0], low[0]]
        corners[:, others[1]] = [low[1], low[1], high[1], high[1]]
        self.corners.append(corners)
        self.materials.append(name)

    def box(self, low: tuple[float, float, float], high: tuple[float, float, float], name: str) -> None:
        """Add the six sides of a box."""
        for axis in range(3):
            a, b = (k for k in range(3) if k != axis)
            for at in (low[axis], high[axis]):
                self.rectangle(axis, at, (low[a], low[b]), (high[a], high[b]), name)

    def sheets(self) -> Sheets:
        """Split every rectangle into two triangles."""
        count = len(self.corners)
        quads = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
        return Sheets(
            vertices=np.concatenate(self.corners),
            faces=quads.reshape(-1, 3).astype(np.int64),
            materials=tuple(name for name in self.materials for _ in range(2)),
        )


def office_sheets() -> Sheets:
    """Make the office."""
    _, y, z = OFFICE_SIZE
    office = _Builder()
    office.box((0.0, 0.0, 0.0), OFFICE_SIZE, "concrete")
    width, top = _DOOR
    for side, (front, back) in enumerate(((_CORRIDOR[0], 0.0), (_CORRIDOR[1], y))):
        low, high = min(front, back), max(front, back)
        for k in range(5):
            left, right = _ROOMS[k], _ROOMS[k + 1]
            if k:
                office.rectangle(0, left, (low, 0.0), (high, z), "plasterboard")
            wall = "glass" if (k + side) % 3 == 1 else "plasterboard"
            door = left + 0.8 + 0.3 * k
            office.rectangle(1, front, (left, 0.0), (door, z), wall)
            office.rectangle(1, front, (door, top), (door + width, z), wall)
            office.rectangle(1, front, (door + width, 0.0), (right, z), wall)
            # Every other door is closed; the others stand open and are left out.
            if (k + side) % 2:
                office.rectangle(1, front, (door, 0.0), (door + width, top), "wood")
            _furnish(office, left, low, 5 * side + k)
    return office.sheets()


def _furnish(office: _Builder, left: float, low: float, number: int) -> None:
    """Put two tables, a shelf and a cabinet into a room; no two rooms have them at the same places."""
    shift = 0.03 * number
    for y in (1.3, 3.6):
        height = 0.72 + 0.004 * number + 0.01 * y
        office.rectangle(2, height, (left + 0.7 + shift, low + y), (left + 2.3 + shift, low + y + 0.8), "wood")
        office.rectangle(1, low + y + 0.1 + shift, (left + 0.8 + shift, 0.1), (left + 2.2 + shift, 0.65), "chipboard")
    office.box(
        (left + 2.9, low + 1.1 + shift, 0.02), (left + 3.5 - 0.5 * shift, low + 2.0 + shift, 1.5 + shift), "metal"
    )
    for level in range(3):
        office.rectangle(
            2,
            0.4 * level + 0.35 + 0.003 * number,
            (left + 2.9 + shift, low + 4.2),
            (left + 3.4, low + 5.3 - shift),
            "chipboard",
        )
