"""Duplicate triangles, which would turn a solid inside out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.scene import Scene
from rayfix_offline.twin.mesh import Mesh


@dataclass(frozen=True, kw_only=True)
class Duplicates:
    """Triangles that have all three corners in common with another one.

    Attributes
    ----------
    redundant : ndarray of bool, shape (n_faces,)
        Copies within an object, and back faces of objects that are double-sided throughout.
    num_copies, num_backs : int
        Redundant triangles of the same orientation as their originals, and of the opposite one.
    coinciding : tuple of (str, str)
        Pairs of objects that share a triangle of the same orientation.
    """

    redundant: NDArray[np.bool_]
    num_copies: int
    num_backs: int
    coinciding: tuple[tuple[str, str], ...]


def find_duplicates(mesh: Mesh) -> Duplicates:
    """Find duplicate triangles; :meth:`Mesh.without` removes the redundant ones.

    A pair of triangles back to back within an object remains where other triangles of the part have no back face:
    touching boxes are drawn like this.
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
    # A double-sided sheet is a closed part without volume, a single-sided one is open. Neither is a solid.
    backs = np.zeros(count, bool)
    backs[left] = _later(alike[left])
    backs &= doubled
    return Duplicates(
        redundant=copies | backs,
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
