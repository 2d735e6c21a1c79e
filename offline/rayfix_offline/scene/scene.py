"""The scene: a mesh file as triangles in metres, z up, with the objects and materials they belong to."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.formats.collada import read_collada
from rayfix_offline.scene.formats.gltf import read_gltf
from rayfix_offline.scene.formats.ifc import read_ifc
from rayfix_offline.scene.formats.mitsuba import read_mitsuba
from rayfix_offline.scene.formats.obj import read_obj
from rayfix_offline.scene.formats.ply import read_ply
from rayfix_offline.scene.formats.stl import read_stl
from rayfix_offline.scene.placed import MOST_TRIANGLES, Contents, Placed, Remark, counted
from rayfix_offline.site import LARGEST_COORDINATE
from rayfix_tables.errors import SceneError

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}

READERS: dict[str, Callable[[Path], Contents]] = {
    "glb": read_gltf,
    "gltf": read_gltf,
    "obj": read_obj,
    "ply": read_ply,
    "stl": read_stl,
    "dae": read_collada,
    "xml": read_mitsuba,
    "ifc": read_ifc,
}
FILE_TYPES = tuple(READERS)

UPRIGHT = {
    "x": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
"""Rotation that turns a file's upward axis to z."""

SINGLE_PRECISION = ("glb", "gltf", "ply", "stl")
"""File types with coordinates in single precision, always or sometimes."""

COARSE = 0.005
"""Step of coordinates [m] above which walls are notably displaced."""

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
        Whether the file itself states the upward axis.
    remarks : tuple of Remark
        What the file's reader left out or changed.
    face_thickness : ndarray of shape (n_faces,), optional, m
        Thickness of the material of each triangle, NaN where the file does not state it; None if it states none.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    face_materials: NDArray[np.int16]
    materials: tuple[str, ...]
    face_objects: NDArray[np.int32]
    objects: tuple[str, ...]
    num_degenerate: int = 0
    says_up: bool = False
    remarks: tuple[Remark, ...] = ()
    face_thickness: NDArray[np.float64] | None = None

    @cached_property
    def triangles(self) -> NDArray[np.float64]:
        """Corners of the triangles, shape (n_faces, 3, 3), m."""
        return self.vertices[self.faces]

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Low and high corner, shape (2, 3), m."""
        used = self.vertices[np.unique(self.faces)]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    def only(self, faces: NDArray[np.bool_]) -> "Scene":
        """Return the scene with some of its triangles, given by a mask of shape (n_faces,)."""
        return replace(
            self,
            faces=self.faces[faces],
            face_materials=self.face_materials[faces],
            face_objects=self.face_objects[faces],
            face_thickness=None if self.face_thickness is None else self.face_thickness[faces],
        )

    def moved(self, by: NDArray[np.float64]) -> "Scene":
        """Return the scene translated by a vector of shape (3,), m."""
        return replace(self, vertices=self.vertices + by) if np.any(by) else self

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
        Unit of the coordinates, unless the file itself states it (COLLADA and IFC do).
    up : {"z", "y"}
        Axis of the file that points up, unless the file itself states it (COLLADA and IFC do).

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
    try:
        contents = READERS[kind](path)
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}); correct its permissions") from error
    objects = [each for each in contents.objects if len(each.faces)]
    if not objects:
        first = "".join(f" ({remark.problem})" for remark in contents.remarks[:1])
        raise SceneError(f"{path} holds no triangles{first}; export the scene as a triangle mesh")
    scale = METRES_PER_UNIT[unit] if contents.metres is None else contents.metres
    if not all(np.isfinite(each.vertices).all() and np.isfinite(each.transform).all() for each in objects):
        raise SceneError(f"{path} has coordinates that are not finite; export the scene again")
    num_triangles = sum(len(each.faces) for each in objects)
    if num_triangles > MOST_TRIANGLES:
        raise SceneError(
            f"{path} has {num_triangles:,} triangles, more than {MOST_TRIANGLES:,}; leave out small objects"
        )
    _refuse_far(path, objects, scale)
    if kind in SINGLE_PRECISION:
        contents = replace(contents, remarks=(*contents.remarks, *_coarse_coordinates(objects, scale)))
    scene = _gather(path, objects, contents, scale=scale, up=contents.up or up)
    if not len(scene.faces):
        raise SceneError(f"{path} has only triangles without an area; export the scene again")
    return scene


def scene_of(source: Path, objects: list[Placed]) -> Scene:
    """Make the scene of objects in metres whose z axis points up.

    Parameters
    ----------
    source : Path
        Where they come from, for messages.
    objects : list of Placed
    """
    return _gather(source, objects, Contents(objects=tuple(objects), metres=1.0, up="z"), scale=1.0, up="z")


def _refuse_far(path: Path, objects: list[Placed], scale: float) -> None:
    """Refuse coordinates that are too large for a building: their squares and numbers of voxels overflow."""
    for each in objects:
        with np.errstate(all="ignore"):
            reach = np.abs(_points(each) * scale).max(initial=0.0)
        if not reach <= LARGEST_COORDINATE:
            raise SceneError(
                f"{path}: the object '{each.name}' has a coordinate of {reach:.6g} m, beyond {LARGEST_COORDINATE:g} m; "
                "correct the mesh, or scene_unit in the site file"
            )


def _coarse_coordinates(objects: list[Placed], scale: float) -> Iterator[Remark]:
    """Warn of map coordinates in single precision. Transforms of nodes are in double precision and lose nothing."""
    steps = [float(np.spacing(np.float32(np.abs(each.vertices).max(initial=0.0)))) * scale for each in objects]
    coarse = [
        (each.name, step)
        for each, step in zip(objects, steps, strict=True)
        if step > COARSE and np.array_equal(each.vertices, each.vertices.astype(np.float32))
    ]
    if coarse:
        name, step = max(coarse, key=lambda found: found[1])
        yield Remark(
            kind="precision",
            problem=f"the file holds the coordinates of {counted(len(coarse), 'object')} in single precision, so far "
            f"from the origin that they have steps of up to {step:.3g} m ('{name}'): walls can be off by half of that",
            remedy="move the objects next to the origin before the export, and the stations with them",
        )


def _points(placed: Placed) -> NDArray[np.float64]:
    """Vertices of an object in the scene's frame."""
    return placed.vertices @ placed.transform[:3, :3].T + placed.transform[:3, 3]


def _gather(path: Path, objects: list[Placed], contents: Contents, *, scale: float, up: str) -> Scene:
    turn = UPRIGHT[up]
    vertices, faces, face_materials, face_objects = [], [], [], []
    numbers: dict[str, int] = {}
    count = 0
    for index, each in enumerate(objects):
        vertices.append(_points(each) @ turn.T * scale)
        # A mirrored object keeps its orientation.
        faces.append((each.faces if np.linalg.det(each.transform[:3, :3]) >= 0.0 else each.faces[:, ::-1]) + count)
        count += len(each.vertices)
        used = np.unique(each.face_materials[each.face_materials >= 0])
        table = np.full(len(each.materials) + 1, -1)
        for number in used:
            table[number] = numbers.setdefault(each.materials[number], len(numbers))
        face_materials.append(table[each.face_materials])
        face_objects.append(np.full(len(each.faces), index))
    if len(numbers) > _MOST_MATERIALS:
        raise SceneError(
            f"{path} has {len(numbers):,} materials, a table holds {_MOST_MATERIALS:,} at most; give objects of one "
            "building material the same material"
        )
    all_vertices = np.concatenate(vertices)
    all_faces = np.concatenate(faces)
    a, b, c = (all_vertices[all_faces[:, i]] for i in range(3))
    keep = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 2.0 * _MIN_AREA
    thickness = np.repeat([each.thickness for each in objects], [len(each.faces) for each in objects])[keep]
    return Scene(
        vertices=all_vertices,
        faces=all_faces[keep].astype(np.int32),
        face_materials=np.concatenate(face_materials)[keep].astype(np.int16),
        materials=tuple(numbers),
        face_objects=np.concatenate(face_objects)[keep].astype(np.int32),
        objects=tuple(each.name for each in objects),
        num_degenerate=int(np.count_nonzero(~keep)),
        says_up=contents.up is not None,
        remarks=contents.remarks,
        face_thickness=thickness if np.isfinite(thickness).any() else None,
    )
