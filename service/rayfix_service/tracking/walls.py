"""What a target cannot pass: the surfaces of the scene, and whatever is not free space.

The scene's triangles are sorted into the cells of a grid, each into all cells that its box touches. A straight way is
tested against the triangles of the cells that its own box touches; ways are short.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_tables.freespace import FreeSpace
from rayfix_tables.scene import Scene

_CELL = 0.5
"""Side of a cell, m: about as far as a target goes between two reports."""

_MOST_CELLS = 4_000_000
"""The cells of a large scene are larger rather than more than this."""

Array = NDArray[np.float64]


class TriangleGrid(NamedTuple):
    """Triangles by cell.

    Attributes
    ----------
    corners : ndarray of shape (n_triangles, 3, 3), m
    origin : ndarray of shape (3,), m
        Low corner of the grid.
    cell : float, m
    shape : ndarray of int64, shape (3,)
        Cells along each axis.
    offsets : ndarray of int64, shape (n_cells + 1,)
        Where each cell's part of ``members`` begins.
    members : ndarray of int64
        Triangles of the cells.
    """

    corners: Array
    origin: Array
    cell: float
    shape: NDArray[np.int64]
    offsets: NDArray[np.int64]
    members: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Walls:
    """What targets cannot pass; make it with :func:`walls_of`.

    Attributes
    ----------
    free_space : FreeSpace
    triangles : TriangleGrid
    """

    free_space: FreeSpace
    triangles: TriangleGrid

    def passable(self, begin: Array, end: Array) -> NDArray[np.bool_]:
        """Whether straight ways cross no surface and end in free space.

        Parameters
        ----------
        begin, end : ndarray of shape (n, 3), m

        Returns
        -------
        ndarray of bool, shape (n,)
        """
        out = self.free_space.contains(end)
        cut_ways(begin, end, self.triangles, out)
        return out


def walls_of(scene: Scene) -> Walls:
    """Sort the triangles of a table's scene."""
    corners = np.ascontiguousarray(np.asarray(scene.vertices, np.float64)[np.asarray(scene.faces)])
    low, high = (corners.min(axis=(0, 1)), corners.max(axis=(0, 1))) if len(corners) else (np.zeros(3), np.zeros(3))
    cell = max(_CELL, float(np.prod(np.maximum(high - low, _CELL)) / _MOST_CELLS) ** (1.0 / 3.0))
    shape = np.floor((high - low) / cell).astype(np.int64) + 1
    counts = np.zeros(int(np.prod(shape)) + 1, np.int64)
    sort_triangles(corners, low, cell, shape, counts, np.empty(0, np.int64))
    offsets = np.cumsum(counts)
    members = np.empty(int(offsets[-1]), np.int64)
    # Each cell's counter runs from the begin of its part to that of the next one's.
    sort_triangles(corners, low, cell, shape, offsets[:-1].copy(), members)
    triangles = TriangleGrid(corners=corners, origin=low, cell=cell, shape=shape, offsets=offsets, members=members)
    return Walls(free_space=scene.free_space, triangles=triangles)


@numba.njit(cache=True, nogil=True)
def _cell_range(low: Any, high: Any, origin: Any, cell: Any, count: Any) -> Any:
    """First and last cell along an axis between two coordinates."""
    first = int(np.floor((low - origin) / cell))
    last = int(np.floor((high - origin) / cell))
    return max(first, 0), min(last, count - 1)


@numba.njit(cache=True, nogil=True)
def sort_triangles(corners: Any, origin: Any, cell: Any, shape: Any, counters: Any, members: Any) -> None:
    """Count the triangles of each cell (at its number plus one), or, where there is room, put them there."""
    counting = len(members) == 0
    for n in range(len(corners)):
        x0, x1 = _cell_range(corners[n, :, 0].min(), corners[n, :, 0].max(), origin[0], cell, shape[0])
        y0, y1 = _cell_range(corners[n, :, 1].min(), corners[n, :, 1].max(), origin[1], cell, shape[1])
        z0, z1 = _cell_range(corners[n, :, 2].min(), corners[n, :, 2].max(), origin[2], cell, shape[2])
        for x in range(x0, x1 + 1):
            for y in range(y0, y1 + 1):
                for z in range(z0, z1 + 1):
                    number = (x * shape[1] + y) * shape[2] + z
                    if counting:
                        counters[number + 1] += 1
                    else:
                        members[counters[number]] = n
                        counters[number] += 1


@numba.njit(cache=True, nogil=True)
def cut_ways(begin: Any, end: Any, triangles: Any, out: Any) -> None:
    """Set ``out`` to False where a triangle crosses the straight way, ends included.

    T. Moller, B. Trumbore, "Fast, minimum storage ray/triangle intersection", J. Graphics Tools 2 (1), 1997.
    """
    corners, origin, cell, shape, offsets, members = triangles
    for n in range(len(begin)):
        if not out[n]:
            continue
        ax, ay, az = begin[n]
        bx, by, bz = end[n]
        x0, x1 = _cell_range(min(ax, bx), max(ax, bx), origin[0], cell, shape[0])
        y0, y1 = _cell_range(min(ay, by), max(ay, by), origin[1], cell, shape[1])
        z0, z1 = _cell_range(min(az, bz), max(az, bz), origin[2], cell, shape[2])
        for x in range(x0, x1 + 1):
            for y in range(y0, y1 + 1):
                for z in range(z0, z1 + 1):
                    number = (x * shape[1] + y) * shape[2] + z
                    for k in range(offsets[number], offsets[number + 1]):
                        if out[n] and _crosses(ax, ay, az, bx - ax, by - ay, bz - az, corners[members[k]]):
                            out[n] = False


@numba.njit(cache=True, nogil=True)
def _crosses(ax: Any, ay: Any, az: Any, dx: Any, dy: Any, dz: Any, corner: Any) -> Any:
    """Whether the way from a by d meets the triangle."""
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    determinant = ux * px + uy * py + uz * pz
    if determinant == 0.0:  # along the plane
        return False
    tx, ty, tz = ax - corner[0, 0], ay - corner[0, 1], az - corner[0, 2]
    u = (tx * px + ty * py + tz * pz) / determinant
    if u < 0.0 or u > 1.0:
        return False
    qx, qy, qz = ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux
    v = (dx * qx + dy * qy + dz * qz) / determinant
    if v < 0.0 or u + v > 1.0:
        return False
    t = (vx * qx + vy * qy + vz * qz) / determinant
    return 0.0 <= t <= 1.0
