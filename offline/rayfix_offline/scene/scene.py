"""The scene: a mesh file as triangles in metres, z up, with the objects and materials they belong to."""

import contextlib
import hashlib
import io
import logging
import re
import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.units import unit_conversion

from rayfix_offline.scene.ifc import read_ifc
from rayfix_offline.scene.mitsuba import read_mitsuba
from rayfix_offline.scene.placed import Placed
from rayfix_tables.errors import SceneError

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
FILE_TYPES = ("glb", "gltf", "obj", "ply", "stl", "dae", "xml", "ifc")

UPRIGHT = {
    "x": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
"""Rotation that turns a file's upward axis to z."""

_MIN_AREA = 1e-12

_MOST_MATERIALS = int(np.iinfo(np.int16).max) + 1
"""Indices of materials have two bytes in a table."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Triangles of the digital twin.

    Attributes
    ----------
    vertices : ndarray of shape (n_vertices, 3), m
    faces : ndarray of int32, shape (n_faces, 3)
        Degenerate triangles are already left out.
    face_materials : ndarray of int16, shape (n_faces,)
        Index into ``materials``; -1 for none.
    face_objects : ndarray of int32, shape (n_faces,)
        Index into ``objects``, the names of the file's meshes.
    num_degenerate : int
        Triangles without an area, left out.
    says_up : bool
        The file itself said which axis points up.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    face_materials: NDArray[np.int16]
    materials: tuple[str, ...]
    face_objects: NDArray[np.int32]
    objects: tuple[str, ...]
    num_degenerate: int = 0
    says_up: bool = False

    @cached_property
    def triangles(self) -> NDArray[np.float64]:
        """Corners of the triangles, shape (n_faces, 3, 3), m."""
        return self.vertices[self.faces]

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Low and high corner, shape (2, 3), m."""
        used = self.vertices[np.unique(self.faces)]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    @property
    def sha256(self) -> str:
        """Checksum of the geometry and its materials."""
        digest = hashlib.sha256("\0".join(self.materials).encode())
        for array in (self.vertices, self.faces, self.face_materials):
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def load_scene(path: str | Path, *, unit: str = "m", up: str = "z") -> Scene:
    """Read a mesh file.

    Parameters
    ----------
    unit : {"m", "cm", "mm", "in", "ft"}
        Unit of the coordinates, unless the file itself says it (COLLADA and IFC do).
    up : {"z", "y"}
        Which axis of the file points up, unless the file itself says it (COLLADA and IFC do).

    Raises
    ------
    SceneError
        When the file is missing, cannot be read, or holds no triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"there is no scene at {path}; correct 'scene' in the site file (it is relative to that file)")
    kind = path.suffix.lower().lstrip(".")
    if kind not in FILE_TYPES:
        raise SceneError(f"{path} is of unknown type '{kind}'; give one of {', '.join(FILE_TYPES)}")
    scale, said_up = METRES_PER_UNIT[unit], None
    if kind == "xml":
        meshes = read_mitsuba(path, _load_quietly)
    elif kind == "ifc":
        meshes, scale, said_up = read_ifc(path), 1.0, "z"
    else:
        loaded = _load_quietly(path)
        meshes = _placed_meshes(loaded)
        if kind == "dae":
            # trimesh reads the unit of a COLLADA file (as "0.01 * meters"), but does not apply it.
            scale = float(unit_conversion(loaded.units, "meters"))
            said_up = _collada_up(path)
    if not meshes:
        raise SceneError(f"{path} holds no triangles; export the scene as a triangle mesh")
    if not all(np.isfinite(mesh.vertices).all() and np.isfinite(transform).all() for _, mesh, transform in meshes):
        raise SceneError(f"{path} has coordinates that are not finite; export the scene again")
    scene = replace(_gather(path, meshes, scale=scale, up=said_up or up), says_up=said_up is not None)
    if not len(scene.faces):
        raise SceneError(f"{path} has only triangles without an area; export the scene again")
    return scene


def _collada_up(path: Path) -> str | None:
    """Upward axis that a COLLADA file names; trimesh does not turn it."""
    found = re.search(rb"<up_axis>\s*([XYZ])_UP\s*</up_axis>", path.read_bytes())
    return found[1].decode().lower() if found else None


def _load_quietly(path: Path) -> Any:
    """Read with trimesh, whose readers print, log and warn about what the result shows anyway."""
    previous = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            return trimesh.load_scene(path, process=False)
    except Exception as error:  # the readers raise whatever their formats make of a damaged file
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SceneError(f"{path} cannot be read as a mesh ({reason}); export the scene again") from error
    finally:
        logging.disable(previous)


def _placed_meshes(loaded: Any) -> list[Placed]:
    """Triangle meshes of all nodes of a trimesh scene."""
    meshes = []
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        geometry = loaded.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            meshes.append((str(node), geometry, transform))
    return meshes


def _gather(path: Path, meshes: list[Placed], *, scale: float, up: str) -> Scene:
    turn = UPRIGHT[up]
    vertices, faces, face_materials, face_objects = [], [], [], []
    materials: dict[str, int] = {}
    count = 0
    for index, (_, mesh, transform) in enumerate(meshes):
        points = trimesh.transformations.transform_points(np.asarray(mesh.vertices, np.float64), transform)
        vertices.append(points @ turn.T * scale)
        faces.append(np.asarray(mesh.faces, np.int64) + count)
        count += len(points)
        material = getattr(getattr(mesh.visual, "material", None), "name", None)
        number = materials.setdefault(material, len(materials)) if material else -1
        face_materials.append(np.full(len(mesh.faces), number))
        face_objects.append(np.full(len(mesh.faces), index))
    if len(materials) > _MOST_MATERIALS:
        raise SceneError(
            f"{path} has {len(materials):,} materials, a table holds {_MOST_MATERIALS:,} at most; give objects of one "
            "building material the same material"
        )
    all_vertices = np.concatenate(vertices)
    all_faces = np.concatenate(faces)
    a, b, c = (all_vertices[all_faces[:, i]] for i in range(3))
    keep = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 2.0 * _MIN_AREA
    return Scene(
        vertices=all_vertices,
        faces=all_faces[keep].astype(np.int32),
        face_materials=np.concatenate(face_materials)[keep].astype(np.int16),
        materials=tuple(materials),
        face_objects=np.concatenate(face_objects)[keep].astype(np.int32),
        objects=tuple(name for name, _, _ in meshes),
        num_degenerate=int(np.count_nonzero(~keep)),
    )
