"""Connected parts of the scene, tests whether a point is inside one, and the free space outside of solids."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from trimesh.triangles import closest_point

from rayfix_offline.scene.scene import Scene
from rayfix_offline.twin.mesh import Mesh
from rayfix_offline.twin.settings import TwinSettings
from rayfix_tables.freespace import FreeSpace


@dataclass(frozen=True, kw_only=True)
class Part:
    """A connected part of the scene's surface.

    Attributes
    ----------
    name : str
        Object of the scene file that most of it belongs to; numbered if an object has several parts.
    faces : ndarray of int64, shape (n,)
        Indices of its triangles.
    closed : bool
        Every edge belongs to an even number of triangles, so that the part has an inside.
    consistent : bool
        Every edge is traversed once in each direction: all triangles are oriented alike.
    manifold : bool
        No edge belongs to more than two triangles.
    volume : float, m3
        Signed: positive where the triangles face outwards, or most of them where they face different ways.
    middle : tuple of float, m
        Mean of its triangles' centres.
    """

    name: str
    faces: NDArray[np.int64]
    closed: bool
    consistent: bool
    manifold: bool
    volume: float
    middle: tuple[float, float, float]

    def moved(self, by: NDArray[np.float64]) -> "Part":
        """Return the part translated by a vector of shape (3,), m."""
        x, y, z = (np.asarray(self.middle) + by).tolist()
        return replace(self, middle=(x, y, z))


def split_parts(mesh: Mesh) -> tuple[Part, ...]:
    """Cut a mesh into connected parts, in the order of their first triangles.

    A closed component within an object is a part. All other triangles are connected across objects, because a room may
    be drawn as six sheets.
    """
    scene, topology = mesh.scene, mesh.topology
    label = topology.components(scene.face_objects)
    odd = (topology.uses_within(label)[0] % 2 == 1).any(axis=1)
    loose = np.flatnonzero((np.bincount(label, weights=odd) > 0)[label])
    label[loose] = label.max() + 1 + topology.components(np.zeros(len(scene.faces), np.int64), among=loose)
    _, first, label = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    label = rank[label.reshape(-1)]
    count = len(first)

    def total(values: NDArray[Any]) -> NDArray[np.float64]:
        return np.asarray(np.bincount(label, weights=values, minlength=count), np.float64)

    uses, balance = topology.uses_within(label)
    # About the part's own middle: far from the origin, the triangles' contributions would cancel.
    sizes = total(np.ones(len(label)))
    middle = np.stack([total(m) for m in scene.triangles.mean(axis=1).T], axis=1) / sizes[:, None]
    a, b, c = (scene.triangles[:, i] - middle[label] for i in range(3))
    shares = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    if (balance != 0).any():
        # Triangles of a part that face different ways would cancel each other.
        shares = np.where(topology.turned(label), -shares, shares)
    volume = total(shares)
    faces = np.split(np.argsort(label, kind="stable"), np.cumsum(sizes.astype(np.int64))[:-1])
    open_sides = total((uses % 2 == 1).sum(axis=1))
    crowded_sides = total((uses > 2).sum(axis=1))
    turned_sides = total((balance != 0).sum(axis=1))
    names = _names(scene, label, count)
    return tuple(
        Part(
            name=names[part],
            faces=faces[part],
            closed=open_sides[part] == 0,
            consistent=turned_sides[part] == 0,
            manifold=crowded_sides[part] == 0,
            volume=float(volume[part]),
            middle=(float(middle[part, 0]), float(middle[part, 1]), float(middle[part, 2])),
        )
        for part in range(count)
    )


def solid_faces(
    mesh: Mesh, parts: Sequence[Part], solids: Sequence[bool] | NDArray[np.bool_]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Find the solid that each triangle belongs to, and the triangles' normals.

    Parameters
    ----------
    solids : sequence of bool, length n_parts
        Which parts are solids.

    Returns
    -------
    solid : ndarray of int32, shape (n_faces,)
        Index of the part, -1 for sheets.
    outward : ndarray of shape (n_faces, 3)
        Unit normals, those of solids out of them.
    """
    a, b, c = (mesh.scene.triangles[:, i] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    label = np.empty(len(normals), np.int64)
    solid = np.full(len(normals), -1, np.int32)
    outwards = np.ones(len(normals))
    for n, part in enumerate(parts):
        label[part.faces] = n
        if solids[n]:
            solid[part.faces] = n
            outwards[part.faces] = 1.0 if part.volume > 0.0 else -1.0
    if any(is_solid and not part.consistent for part, is_solid in zip(parts, solids, strict=True)):
        outwards[mesh.topology.turned(label) & (solid >= 0)] *= -1.0
    return solid, normals * outwards[:, None]


def _names(scene: Scene, label: NDArray[np.int64], count: int) -> list[str]:
    """Names of parts: the object of most of their triangles, numbered if it has several parts."""
    pairs, uses = np.unique(label * len(scene.objects) + scene.face_objects, return_counts=True)
    part, named = pairs // len(scene.objects), pairs % len(scene.objects)
    order = np.lexsort((-uses, part))
    most = named[order[np.unique(part[order], return_index=True)[1]]]
    names = [scene.objects[k] for k in most]
    times = Counter(names)
    seen: Counter[str] = Counter()
    for n in range(count):
        if times[names[n]] > 1:
            seen[names[n]] += 1
            names[n] = f"{names[n]} #{seen[names[n]]}"
    return names


def is_inside(triangles: NDArray[np.float64], point: NDArray[np.float64]) -> bool:
    """Whether a point lies inside a closed surface, whatever the orientation of its triangles.

    The majority of three rays decides, by the parity of their crossings; no building has edges in their directions.

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


def touched(triangles: NDArray[np.float64], point: NDArray[np.float64], *, touch: float = TwinSettings.touch) -> int:
    """Triangle that a point lies on.

    Parameters
    ----------
    triangles : ndarray of shape (n, 3, 3), m
    point : ndarray of shape (3,), m
    touch : float, m
        A point nearer than this to a triangle lies on it.

    Returns
    -------
    int
        Index of the triangle, -1 for none.
    """
    near = np.flatnonzero(
        np.all((triangles.min(axis=1) <= point + touch) & (triangles.max(axis=1) >= point - touch), axis=1)
    )
    if not len(near):
        return -1
    closest = closest_point(triangles[near], np.broadcast_to(point, (len(near), 3)))
    distance = np.linalg.norm(closest - point, axis=1)
    nearest = int(distance.argmin())
    return int(near[nearest]) if distance[nearest] < touch else -1


def map_free_space(
    scene: Scene,
    *,
    solids: Sequence[Part],
    rooms: Sequence[Part],
    voxel_size: float,
    max_voxels: int = TwinSettings.max_voxels,
) -> FreeSpace:
    """Mark the voxels whose centres lie outside all solids and, if there are rooms, inside one.

    Parameters
    ----------
    solids, rooms : sequence of Part
        Closed parts.
    voxel_size : float, m
        Larger if the scene would take more than ``max_voxels``.
    max_voxels : int
    """
    low, high = scene.bounds
    extent = np.maximum(high - low, voxel_size)
    voxel_size = max(voxel_size, float((np.prod(extent) / max_voxels) ** (1.0 / 3.0)))
    # A flat scene may be thinner than a voxel, and still has one.
    while float(np.prod(np.ceil(extent / voxel_size))) > 2.0 * max_voxels:
        voxel_size *= 1.1
    shape = tuple(int(n) for n in np.ceil(extent / voxel_size - 1e-9))
    free = np.full(shape, not rooms)
    for part in (*rooms, *solids):
        triangles = scene.triangles[part.faces]
        reach = (np.stack([triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))]) - low) / voxel_size
        first, stop = np.floor(reach[0]).astype(np.int64), np.ceil(reach[1]).astype(np.int64) + 1
        block = tuple(slice(a, b) for a, b in zip(first, stop, strict=True))
        parity = np.zeros(free[block].shape, bool)
        _flip_above(triangles, low + first * voxel_size, voxel_size, parity)
        if any(part is room for room in rooms):
            free[block] |= parity
        else:
            free[block] &= ~parity
    return FreeSpace(origin=low, voxel_size=voxel_size, free=free)


def sealed_space(free_space: FreeSpace, stations: NDArray[np.float64]) -> FreeSpace | None:
    """Restrict the free space to what is connected with the stations, if solids such as walls enclose it.

    Returns
    -------
    FreeSpace or None
        None if free space connects a station with the border of the scene.
    """
    index = np.floor((stations - free_space.origin) / free_space.voxel_size).astype(np.int64)
    held = np.all((index >= 0) & (index < free_space.free.shape), axis=1)
    region, _ = ndimage.label(free_space.free)
    reached = np.setdiff1d(region[tuple(index[held].T)], 0)
    if not len(reached):
        return None
    border = [region.take(end, axis=axis) for axis in range(3) for end in (0, -1)]
    if any(np.isin(side, reached).any() for side in border):
        return None
    return FreeSpace(origin=free_space.origin, voxel_size=free_space.voxel_size, free=np.isin(region, reached))


@numba.njit(cache=True, nogil=True)
def _flip_above(
    triangles: Any,
    origin: Any,
    voxel: Any,
    parity: Any,
) -> None:
    """Flip the voxels whose centres lie above each triangle, so that those inside the part end up set."""
    nx, ny, nz = parity.shape
    # Columns are offset slightly from the voxels' centres, because edges of drawings often have round coordinates.
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
