"""Triangles that are in a mesh twice: they would make the inside of a solid its outside."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.scene import Scene
from rayfix_offline.twin.mesh import Mesh


@dataclass(frozen=True, kw_only=True)
class Repeats:
    """Triangles with the same three corners.

    Attributes
    ----------
    needless : ndarray of bool, shape (n_faces,)
        Copies within an object, and the back sides of objects that are drawn from both sides throughout.
    num_copies, num_backs : int
        Of the needless triangles, those that face as their originals do, and those that do not.
    coinciding : tuple of (str, str)
        Objects that share a triangle which faces the same way in both.
    """

    needless: NDArray[np.bool_]
    num_copies: int
    num_backs: int
    coinciding: tuple[tuple[str, str], ...]


def find_repeats(mesh: Mesh) -> Repeats:
    """Find the triangles that are in a mesh more than once; :meth:`Mesh.without` leaves the needless ones out.

    Two triangles back to back within an object stay, where others of the part have none: boxes that touch are drawn
    like that.
    """
    scene, topology = mesh.scene, mesh.topology
    count = len(scene.faces)
    # Two edges of a triangle determine it.
    low, high = topology.edges.min(axis=1), topology.edges.max(axis=1)
    corners = _numbered(low * (int(high.max()) + 1) + high)
    ordered = np.sort(topology.points, axis=1)
    start = np.argmin(topology.points, axis=1)
    turned = topology.points[np.arange(count), (start + 1) % 3] != ordered[:, 1]
    sided = corners * 2 + turned

    objects = len(scene.objects)
    copies = _later(_numbered(sided * objects + scene.face_objects))
    part = topology.components(scene.face_objects)
    alike = _numbered(corners * objects + scene.face_objects)
    left = ~copies
    single = np.bincount(alike[left], minlength=count)[alike] == 1
    doubled = np.bincount(part, weights=single & left)[part] == 0
    # A flat sheet with a back is a closed part of no volume; without it, it is an open one. Neither is a solid.
    backs = np.zeros(count, bool)
    backs[left] = _later(alike[left])
    backs &= doubled
    return Repeats(
        needless=copies | backs,
        num_copies=int(np.count_nonzero(copies)),
        num_backs=int(np.count_nonzero(backs)),
        coinciding=_coinciding(scene, sided[left], scene.face_objects[left]),
    )


def _numbered(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.unique(keys, return_inverse=True)[1].reshape(-1)


def _later(keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark all but the first of equal keys."""
    later = np.ones(len(keys), bool)
    later[np.unique(keys, return_index=True)[1]] = False
    return later


def _coinciding(scene: Scene, sided: NDArray[np.int64], objects: NDArray[np.int32]) -> tuple[tuple[str, str], ...]:
    order = np.lexsort((objects, sided))
    same = sided[order][1:] == sided[order][:-1]
    pairs = np.unique(np.stack([objects[order][:-1][same], objects[order][1:][same]], axis=1), axis=0)
    return tuple((scene.objects[a], scene.objects[b]) for a, b in pairs)
