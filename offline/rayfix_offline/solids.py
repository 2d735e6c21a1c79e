"""Closed parts of the scene: solids, in which nothing can be, and enclosures, outside of which nothing can be."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from trimesh.triangles import closest_point

from rayfix_offline.scene import Scene
from rayfix_offline.topology import Topology
from rayfix_tables.freespace import FreeSpace

MAX_VOXELS = 20_000_000
"""The free space of a large building is cut more coarsely rather than into more voxels than this."""

TOUCH = 1e-3
"""Whatever is nearer to a surface lies on it, m."""

_ENCLOSURE_SHARE = 0.05


@dataclass(frozen=True, kw_only=True)
class Part:
    """A connected part of the scene's surface.

    Attributes
    ----------
    name : str
        Object of the scene file that it (mostly) belongs to.
    faces : ndarray of int64, shape (n,)
        Its triangles in the scene.
    closed : bool
        Every edge belongs to an even number of triangles, so that it has an inside.
    consistent : bool
        Every edge is run through once in each direction, so that all triangles face the same way.
    volume : float, m3
        Signed: positive where the triangles face outwards.
    """

    name: str
    faces: NDArray[np.int64]
    closed: bool
    consistent: bool
    volume: float


def split_parts(scene: Scene, topology: Topology) -> tuple[Part, ...]:
    """Cut the scene into connected parts."""
    label = topology.components()
    count = int(label.max()) + 1
    order = np.argsort(label, kind="stable")
    sizes = np.bincount(label, minlength=count)
    offsets = np.concatenate([[0], np.cumsum(sizes)])

    def all_of(condition: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.asarray(np.bincount(label, weights=~condition, minlength=count) == 0)

    closed = all_of((topology.edge_uses % 2 == 0)[topology.edges].all(axis=1))
    consistent = all_of((topology.edge_balance == 0)[topology.edges].all(axis=1))
    # About the part's own middle: far from the origin, the triangles' shares would cancel.
    middle = np.stack([np.bincount(label, weights=m) for m in scene.triangles.mean(axis=1).T], axis=1) / sizes[:, None]
    a, b, c = (scene.triangles[:, i] - middle[label] for i in range(3))
    volume = np.bincount(label, weights=np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0, minlength=count)
    # The object that most triangles of the part belong to.
    pairs, uses = np.unique(label * len(scene.objects) + scene.face_objects, return_counts=True)
    best = pairs[np.lexsort((-uses, pairs // len(scene.objects)))]
    names = best[np.unique(best // len(scene.objects), return_index=True)[1]] % len(scene.objects)
    return tuple(
        Part(
            name=scene.objects[names[part]],
            faces=order[offsets[part] : offsets[part + 1]],
            closed=bool(closed[part]),
            consistent=bool(consistent[part]),
            volume=float(volume[part]),
        )
        for part in range(count)
    )


def is_inside(triangles: NDArray[np.float64], point: NDArray[np.float64]) -> bool:
    """Whether a point lies inside a closed surface, however its triangles face.

    Counts the crossings of three rays in directions that no building has, and takes the majority.

    Parameters
    ----------
    triangles : ndarray of shape (n, 3, 3), m
    point : ndarray of shape (3,), m
    """
    a = triangles[:, 0]
    ab, ac = triangles[:, 1] - a, triangles[:, 2] - a
    votes = 0
    for heading in ((0.5257, 0.3113, 0.7917), (-0.6121, 0.7034, 0.3613), (0.2731, -0.8467, -0.4566)):
        ray = np.asarray(heading)
        across = np.cross(ray, ac)
        det = np.einsum("ij,ij->i", ab, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("ij,ij->i", point - a, across) / det
            turned = np.cross(point - a, ab)
            v = turned @ ray / det
            reach = np.einsum("ij,ij->i", ac, turned) / det
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (reach > 0)
        votes += int(np.count_nonzero(hit) % 2)
    return votes >= 2


def touched(triangles: NDArray[np.float64], point: NDArray[np.float64]) -> int:
    """Triangle that a point lies on, on neither side of it.

    Parameters
    ----------
    triangles : ndarray of shape (n, 3, 3), m
    point : ndarray of shape (3,), m

    Returns
    -------
    int
        Index of the triangle, -1 for none.
    """
    distance = np.linalg.norm(closest_point(triangles, np.broadcast_to(point, (len(triangles), 3))) - point, axis=1)
    nearest = int(distance.argmin())
    return nearest if distance[nearest] < TOUCH else -1


def find_enclosures(
    scene: Scene, parts: Sequence[Part], stations: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Tell which closed parts enclose the site, and which stations lie in which parts.

    A part that holds more than half of the stations and a good share of the scene's volume is the building itself (or
    the inner or outer face of its walls); every other closed part is a solid.

    Parameters
    ----------
    stations : ndarray of shape (n_stations, 3), m

    Returns
    -------
    enclosing : ndarray of bool, shape (n_parts,)
    inside : ndarray of bool, shape (n_parts, n_stations)
        Or on the part's surface.
    """
    scene_volume = float(np.prod(np.maximum(scene.bounds[1] - scene.bounds[0], 1e-9)))
    inside = np.zeros((len(parts), len(stations)), bool)
    enclosing = np.zeros(len(parts), bool)
    for i, part in enumerate(parts):
        if not part.closed:
            continue
        triangles = scene.triangles[part.faces]
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        for s in np.flatnonzero(np.all((stations >= low - TOUCH) & (stations <= high + TOUCH), axis=1)):
            inside[i, s] = is_inside(triangles, stations[s]) or touched(triangles, stations[s]) >= 0
        enclosing[i] = inside[i].mean() > 0.5 and abs(part.volume) > _ENCLOSURE_SHARE * scene_volume
    return enclosing, inside


def map_free_space(
    scene: Scene, parts: Sequence[Part], enclosing: NDArray[np.bool_], *, voxel_size: float
) -> FreeSpace:
    """Mark the voxels whose centres lie inside all enclosures and outside all solids.

    Parameters
    ----------
    voxel_size : float, m
        Grows when the scene would take more than MAX_VOXELS.
    """
    low, high = scene.bounds
    extent = np.maximum(high - low, voxel_size)
    voxel_size = max(voxel_size, float((np.prod(extent) / MAX_VOXELS) ** (1.0 / 3.0)))
    shape = tuple(int(n) for n in np.ceil(extent / voxel_size - 1e-9))
    free = np.ones(shape, bool)
    for part, encloses in zip(parts, enclosing, strict=True):
        if part.closed:
            triangles = scene.triangles[part.faces]
            reach = (np.stack([triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))]) - low) / voxel_size
            first, stop = np.floor(reach[0]).astype(np.int64), np.ceil(reach[1]).astype(np.int64) + 1
            block = tuple(slice(a, b) for a, b in zip(first, stop, strict=True))
            parity = np.zeros(free[block].shape, bool)
            _flip_above(triangles, low + first * voxel_size, voxel_size, parity)
            if encloses:
                inside = np.zeros(shape, bool)
                inside[block] = parity
                free &= inside
            else:
                free[block] &= ~parity
    return FreeSpace(origin=low, voxel_size=voxel_size, free=free)


@numba.njit(cache=True, nogil=True)
def _flip_above(
    triangles: Any,
    origin: Any,
    voxel: Any,
    parity: Any,
) -> None:
    """Flip the voxels whose centres lie above each triangle: at the end those inside are set."""
    nx, ny, nz = parity.shape
    # Columns a hair off the voxels' centres, so that they meet no edge of a drawing on round coordinates.
    shift_x, shift_y = 0.5 + 1.37e-5, 0.5 + 2.71e-5
    for t in range(len(triangles)):
        ax, ay, az = triangles[t, 0]
        bx, by, bz = triangles[t, 1]
        cx, cy, cz = triangles[t, 2]
        det = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if det == 0.0:
            continue
        first_x = max(0, int(np.floor((min(ax, bx, cx) - origin[0]) / voxel - shift_x)))
        last_x = min(nx - 1, int(np.ceil((max(ax, bx, cx) - origin[0]) / voxel - shift_x)))
        first_y = max(0, int(np.floor((min(ay, by, cy) - origin[1]) / voxel - shift_y)))
        last_y = min(ny - 1, int(np.ceil((max(ay, by, cy) - origin[1]) / voxel - shift_y)))
        for ix in range(first_x, last_x + 1):
            x = origin[0] + (ix + shift_x) * voxel
            for iy in range(first_y, last_y + 1):
                y = origin[1] + (iy + shift_y) * voxel
                u = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / det
                v = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / det
                if u < 0.0 or v < 0.0 or u + v > 1.0:
                    continue
                z = az + u * (bz - az) + v * (cz - az)
                start = max(0, int(np.ceil((z - origin[2]) / voxel - 0.5)))
                for iz in range(start, nz):
                    parity[ix, iy, iz] = not parity[ix, iy, iz]
