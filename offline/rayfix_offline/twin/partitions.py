"""Thin partitions: walls that signals penetrate, and rays only where material and thickness are known.

Samples of upright triangles are thin where there is free space on both sides. Those from floor to ceiling are walls in
a map of the floor. They are partitions if the map has more rooms with them than without them, after closing gaps as
wide as doors.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from rayfix_offline.scene.materials import itu_name
from rayfix_offline.scene.scene import Scene
from rayfix_tables.freespace import FreeSpace

HEAVY = frozenset({"metal", "concrete", "brick", "marble"})
"""Materials of ITU-R P.2040 of which even thin walls attenuate strongly."""

THICKNESS = 0.2
"""Walls up to this thickness are thin, m."""

UPRIGHT = 0.1
"""Largest vertical component of a wall's normal."""

CELL = 0.2
"""Side of the cells of the map, m."""

FULL_HEIGHT = 0.7
"""Smallest fraction of the free height that a wall takes up."""

HALF_DOOR = 0.6
"""Gaps up to twice this width are doors, m."""

ROOM_AREA = 2.0
"""Smallest area of a room, m2, without a margin of half a door's width along its walls."""

LEAST_LENGTH = 2.0
"""Smallest length of partitions per room that they make, m."""

MOST_SAMPLES = 2_000_000
"""Largest number of samples of a scene's triangles; samples of larger scenes are farther apart."""


@dataclass(frozen=True, kw_only=True)
class Partitions:
    """Thin walls that divide the free space.

    Attributes
    ----------
    faces : ndarray of bool, shape (n_faces,)
        Triangles of thin walls; none where there are no partitions.
    rooms : int
        Number of rooms that they make.
    """

    faces: NDArray[np.bool_]
    rooms: int


def find_partitions(scene: Scene, free_space: FreeSpace, *, closed: bool) -> Partitions:
    """Find the thin walls that divide the free space into rooms; none where the voxels are wider than half a door.

    Parameters
    ----------
    closed : bool
        Whether all of the free space lies inside the building; otherwise regions at the border are outdoors.
    """
    none = Partitions(faces=np.zeros(len(scene.faces), bool), rooms=0)
    if free_space.voxel_size > HALF_DOOR:  # a map this coarse shows neither thin walls nor doors
        return none
    face, point, normal = _samples(scene)
    if not len(face) or not free_space.free.any():
        return none
    beyond = THICKNESS + 0.5 * free_space.voxel_size
    thin = free_space.contains(point + beyond * normal) & free_space.contains(point - beyond * normal)
    face, point = face[thin], point[thin]
    cell = max(CELL, free_space.voxel_size, 1.5 * _spacing(scene))
    height = _free_height(free_space, cell)
    shape = height.shape
    columns = _cells(point, free_space, cell)
    inside = np.all((columns >= 0) & (columns < (*shape, np.iinfo(np.int64).max)), axis=1)
    face, columns = face[inside], columns[inside]
    filled = np.unique(columns, axis=0)
    walls = np.zeros(shape)
    np.add.at(walls, (filled[:, 0], filled[:, 1]), cell)
    around = ndimage.maximum_filter(height, size=2 * int(np.ceil(0.5 / cell)) + 1)
    standing = (walls >= FULL_HEIGHT * around) & (around > 0.0)
    open_floor = (height >= FULL_HEIGHT * around) & (height > 0.0)
    # Voxels of slabs are not free; without the slabs they would be floor.
    without = _count_rooms(open_floor | ndimage.binary_dilation(standing), cell, closed=closed)
    rooms = _count_rooms(open_floor & ~standing, cell, closed=closed)
    length = cell * float(np.count_nonzero(standing))
    if rooms < 2 or rooms <= without or length < LEAST_LENGTH * (rooms - without):
        return none
    faces = np.zeros(len(scene.faces), bool)
    faces[face[standing[columns[:, 0], columns[:, 1]]]] = True
    return Partitions(faces=faces, rooms=rooms)


def _spacing(scene: Scene) -> float:
    """Distance of the samples, m."""
    a, b, c = (scene.triangles[:, i] for i in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return max(0.5 * CELL, float(np.sqrt(area / MOST_SAMPLES)))


def _samples(scene: Scene) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Points on the upright triangles that are not of heavy materials: face, point (n, 3) and unit normal (n, 3)."""
    heavy = np.array([itu_name(name) in HEAVY for name in scene.materials] + [False])  # the last is no material
    a, b, c = (scene.triangles[:, i] for i in range(3))
    across = np.cross(b - a, c - a)
    length = np.linalg.norm(across, axis=1)
    upright = np.abs(across[:, 2]) <= UPRIGHT * length
    chosen = np.flatnonzero(upright & ~heavy[scene.face_materials])
    spacing = _spacing(scene)
    longest = np.stack([np.linalg.norm(p[chosen] - q[chosen], axis=1) for p, q in ((a, b), (b, c), (c, a))]).max(axis=0)
    # A sliver, however long, has no more samples than a triangle of its area and of good proportions has, times 16.
    most = 8.0 + 4.0 * np.sqrt(length[chosen]) / spacing
    parts = np.clip(np.ceil(longest / spacing), 1.0, np.ceil(most)).astype(np.int64)
    face, point = [], []
    for count in np.unique(parts):
        mine = chosen[parts == count]
        i, j = np.divmod(np.arange(count * count), count)
        u, v = (i + 1.0 / 3.0) / count, (j + 1.0 / 3.0) / count
        lower = u + v < 1.0
        u, v = u[lower], v[lower]
        step = max(1, MOST_SAMPLES // max(len(u), 1))
        for begin in range(0, len(mine), step):
            some = mine[begin : begin + step]
            weights = np.stack([1.0 - u - v, u, v])
            point.append(np.einsum("kn,fkd->fnd", weights, scene.triangles[some]).reshape(-1, 3))
            face.append(np.repeat(some, len(u)))
    if not face:
        return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3))
    faces = np.concatenate(face)
    return faces, np.concatenate(point), across[faces] / length[faces, None]


def _cells(points: NDArray[np.float64], free_space: FreeSpace, cell: float) -> NDArray[np.int64]:
    return np.floor((points - free_space.origin) / cell).astype(np.int64)


def _free_height(free_space: FreeSpace, cell: float) -> NDArray[np.float64]:
    """Height of the free space over each cell of the map, m: the mean over the cell's columns of voxels."""
    columns = np.count_nonzero(free_space.free, axis=2) * free_space.voxel_size
    index = [((np.arange(n) + 0.5) * free_space.voxel_size / cell).astype(np.int64) for n in columns.shape]
    shape = tuple(int(i[-1]) + 1 for i in index)
    place = np.ravel_multi_index(np.meshgrid(*index, indexing="ij"), shape).reshape(-1)
    count = np.bincount(place, minlength=shape[0] * shape[1])
    total = np.bincount(place, weights=columns.reshape(-1), minlength=shape[0] * shape[1])
    return np.asarray(total / np.maximum(count, 1)).reshape(shape)


def _count_rooms(open_floor: NDArray[np.bool_], cell: float, *, closed: bool) -> int:
    """Count the regions of a map that are rooms, with doors closed."""
    padded = np.pad(open_floor, 1, constant_values=not closed)
    wide = ndimage.distance_transform_edt(padded, sampling=cell)[1:-1, 1:-1] > HALF_DOOR
    region, count = ndimage.label(wide)
    if not count:
        return 0
    area = np.bincount(region.reshape(-1))[1:] * cell**2
    outdoors = np.zeros(count, bool)
    if not closed:
        border = np.concatenate([region[0], region[-1], region[:, 0], region[:, -1]])
        outdoors[border[border > 0] - 1] = True
    return int(np.count_nonzero((area >= ROOM_AREA) & ~outdoors))
