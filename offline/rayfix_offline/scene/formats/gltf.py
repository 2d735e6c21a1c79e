"""glTF 2: nodes with meshes, and extensions that change geometry."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.formats.gltf_accessors import DRACO, MESHOPT, Accessors
from rayfix_offline.scene.formats.gltf_limits import json_of, refuse_hostile_gltf
from rayfix_offline.scene.formats.ply import strip_triangles
from rayfix_offline.scene.placed import MOST_TRIANGLES, Contents, Placed, Remark, counted
from rayfix_tables.errors import SceneError

INSTANCING = "EXT_mesh_gpu_instancing"

READ = (DRACO, *MESHOPT, INSTANCING, "KHR_mesh_quantization")
"""Extensions that change geometry: they are read, or refused where they occur."""

LOOKS = (
    "KHR_materials_",
    "KHR_texture_",
    "KHR_lights_",
    "EXT_texture_",
    "EXT_lights_",
    "KHR_xmp",
    "MSFT_texture_",
    "MSFT_lod",
)
"""Prefixes of extensions that change appearance only, not geometry."""

TRIANGLES, STRIP, FAN = 4, 5, 6


@dataclass(frozen=True, kw_only=True, eq=False)
class _Mesh:
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    materials: tuple[str, ...]
    face_materials: NDArray[np.int64]


def read_gltf(path: Path) -> Contents:
    """Read the meshes of a glTF file's scene, one object for each node and instance.

    Raises
    ------
    SceneError
        When the file cannot be read completely: it is damaged, or needs an unknown extension.
    """
    content = path.read_bytes()
    refuse_hostile_gltf(path, content)
    try:
        document = json.loads(json_of(content))
        if not isinstance(document, dict):
            raise ValueError("it is not an object")
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path} cannot be read as glTF ({str(error)[:80]}); export the scene again") from error
    reader = _Reader(path, document, _binary_chunk(path, content))
    try:
        return reader.contents()
    except (TypeError, AttributeError, KeyError, ValueError, OverflowError) as error:
        raise SceneError(
            f"{path} cannot be read as glTF (an entry is of a wrong type: {str(error)[:80]}); export the scene again"
        ) from error


def _binary_chunk(path: Path, content: bytes) -> bytes | None:
    if content[:4] != b"glTF":
        return None
    if int.from_bytes(content[8:12], "little") > len(content):
        raise SceneError(f"{path} cannot be read as glTF (it ends early); export the scene again")
    at = 20 + int.from_bytes(content[12:16], "little")
    while at + 8 <= len(content):
        length = int.from_bytes(content[at : at + 4], "little")
        if at + 8 + length > len(content):
            raise SceneError(f"{path} cannot be read as glTF (it ends within a chunk); export the scene again")
        if content[at + 4 : at + 8] == b"BIN\0":
            return content[at + 8 : at + 8 + length]
        at += 8 + length
    return None


class _Reader:
    def __init__(self, path: Path, document: dict[str, Any], binary: bytes | None) -> None:
        self.path = path
        self.document = document
        self.accessors = Accessors(path, document, binary)
        self.meshes: dict[tuple[int, tuple[float, ...] | None], _Mesh] = {}
        self.remarks: dict[tuple[str, str], int] = {}

    def contents(self) -> Contents:
        self.check_version()
        self.notice_extensions(self.document, "file")
        objects: list[Placed] = []
        num_triangles = 0
        placed = set()
        for number, transform in self.nodes():
            placed.add(number)
            node = self.document["nodes"][number]
            self.notice_extensions(node, "node")
            if "mesh" not in node:
                continue
            mesh = self.mesh(node)
            if "skin" in node:
                self.remark(
                    "a node is deformed by a skin: it is read in its rest pose", "apply the armature before the export"
                )
            name = str(node.get("name") or self.accessors.entry("meshes", node["mesh"]).get("name") or f"node {number}")
            places = self.instances(node)
            num_triangles += len(mesh.faces) * len(places)
            if num_triangles > MOST_TRIANGLES:
                raise SceneError(
                    f"{self.path} has more than {MOST_TRIANGLES:,} triangles up to the node '{name[:50]}'; leave out "
                    "what is small"
                )
            if not len(mesh.faces):
                continue
            for k, place in enumerate(places):
                objects.append(
                    Placed(
                        name=name if len(places) == 1 else f"{name} instance {k + 1}",
                        vertices=mesh.vertices,
                        faces=mesh.faces,
                        materials=mesh.materials,
                        face_materials=mesh.face_materials,
                        transform=transform @ place,
                    )
                )
        self.notice_unplaced(placed)
        remarks = [
            Remark(kind="left out", problem=problem if n == 1 else f"{problem} ({n:,} times)", remedy=remedy)
            for (problem, remedy), n in self.remarks.items()
        ]
        return Contents(objects=tuple(objects), remarks=tuple(remarks))

    def remark(self, problem: str, remedy: str) -> None:
        self.remarks[problem, remedy] = self.remarks.get((problem, remedy), 0) + 1

    def check_version(self) -> None:
        version = str(self.document.get("asset", {}).get("version", "2.0"))
        if not version.startswith("2."):
            self.accessors.refuse(f"it is of version {version[:10]}", "export the scene as glTF 2")
        unknown = [name for name in self.document.get("extensionsRequired", []) if not _known(name)]
        if unknown:
            named = ", ".join(str(name)[:60] for name in unknown)
            self.accessors.refuse(
                f"it needs the extension {named}, which is not supported",
                "export the scene without it, or convert it with gltf-transform",
            )

    def notice_extensions(self, entry: dict[str, Any], kind: str) -> None:
        for name in entry.get("extensions", {}):
            if not _known(name):
                self.remark(
                    f"a {kind} has the extension {str(name)[:60]}, which is unknown: its changes are not read",
                    "export the scene without it",
                )

    def notice_unplaced(self, placed: set[int]) -> None:
        nodes = self.document.get("nodes", [])
        beside = [n for n, node in enumerate(nodes) if "mesh" in node and n not in placed]
        if beside:
            name = str(nodes[beside[0]].get("name", beside[0]))[:50]
            number = counted(len(beside), "node")
            self.remark(
                f"{number} with a mesh left out, such as '{name}', which the file's scene does not contain",
                "add them to that scene if they belong to it",
            )
        used = {node.get("mesh") for node in nodes}
        unused = [n for n in range(len(self.document.get("meshes", []))) if n not in used]
        if unused:
            number = "a mesh" if len(unused) == 1 else f"{len(unused):,} meshes"
            self.remark(f"{number} left out that no node uses", "add nodes for them if they belong to the scene")

    def nodes(self) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Nodes of the scene with their transforms."""
        nodes = self.document.get("nodes", [])
        scenes = self.document.get("scenes", [])
        if scenes:
            roots = self.accessors.entry("scenes", self.document.get("scene", 0)).get("nodes", [])
        else:
            inner = {child for node in nodes for child in node.get("children", [])}
            roots = [n for n in range(len(nodes)) if n not in inner]
        stack = [(root, np.eye(4)) for root in reversed(roots)]
        seen = set()
        while stack:
            number, outer = stack.pop()
            node = self.accessors.entry("nodes", number)
            if number in seen:
                self.accessors.refuse(f"nodes[{number}] occurs twice")
            seen.add(number)
            transform = outer @ self.transform(node, number)
            yield number, transform
            stack += [(child, transform) for child in reversed(node.get("children", []))]

    def transform(self, node: dict[str, Any], number: int) -> NDArray[np.float64]:
        if "matrix" in node:
            return self.numbers(node, "matrix", 16, number).reshape(4, 4).T
        return _compose(
            self.numbers(node, "translation", 3, number),
            self.numbers(node, "rotation", 4, number),
            self.numbers(node, "scale", 3, number),
        )

    def numbers(self, node: dict[str, Any], key: str, count: int, number: int) -> NDArray[np.float64]:
        missing = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}.get(key)
        values = np.asarray(node.get(key, missing), np.float64)
        if values.shape != (count,):
            self.accessors.refuse(f"nodes[{number}].{key} does not have {count} numbers")
        return values

    def instances(self, node: dict[str, Any]) -> list[NDArray[np.float64]]:
        """Return the transforms of the instances of a node's mesh within the node."""
        extension = node.get("extensions", {}).get(INSTANCING)
        if extension is None:
            return [np.eye(4)]
        known = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}
        columns = {
            name: self.accessors.read(accessor, known[name])
            for name, accessor in extension.get("attributes", {}).items()
            if name in known
        }
        counts = {len(column) for column in columns.values()}
        if len(counts) != 1:
            self.accessors.refuse(
                f"the node '{str(node.get('name'))[:50]}' has {INSTANCING} with attributes of different counts"
            )
        count = counts.pop()
        shifts = columns.get("TRANSLATION", np.zeros((count, 3)))
        turns = columns.get("ROTATION", np.tile((0.0, 0.0, 0.0, 1.0), (count, 1)))
        scales = columns.get("SCALE", np.ones((count, 3)))
        return [_compose(*each) for each in zip(shifts, turns, scales, strict=True)]

    def mesh(self, node: dict[str, Any]) -> _Mesh:
        """Triangles of a node's mesh; a node with its own morph weights has its own triangles."""
        number = node["mesh"]
        mesh = self.accessors.entry("meshes", number)
        weights = node.get("weights", mesh.get("weights"))
        key = (number, tuple(float(w) for w in weights) if weights else None)
        if key not in self.meshes:
            self.meshes[key] = self.joined(mesh, number, key[1] or ())
        return self.meshes[key]

    def joined(self, mesh: dict[str, Any], number: int, weights: tuple[float, ...]) -> _Mesh:
        self.notice_extensions(mesh, "mesh")
        vertices, faces, face_materials = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
        names: list[str] = []
        count = 0
        for k, primitive in enumerate(mesh.get("primitives", [])):
            where = f"meshes[{number}].primitives[{k}]"
            self.notice_extensions(primitive, "mesh")
            mode = primitive.get("mode", TRIANGLES)
            if mode in (0, 1, 2, 3):
                self.remark("a mesh of points or lines has no area and is left out", "export surfaces only")
                continue
            points, corners = self.primitive(primitive, mode, where)
            for weight, target in zip(weights, primitive.get("targets", []), strict=False):
                if weight and "POSITION" in target:
                    points = points + weight * self.accessors.read(target["POSITION"], 3)
            name = ""
            if "material" in primitive:
                material = self.accessors.entry("materials", primitive["material"])
                name = str(material.get("name") or "")
            if name and name not in names:
                names.append(name)
            vertices.append(points)
            faces.append(corners + count)
            face_materials.append(np.full(len(corners), names.index(name) if name else -1))
            count += len(points)
        return _Mesh(
            vertices=np.concatenate(vertices),
            faces=np.concatenate(faces),
            materials=tuple(names),
            face_materials=np.concatenate(face_materials),
        )

    def primitive(
        self, primitive: dict[str, Any], mode: int, where: str
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Positions and triangles of a primitive."""
        position = primitive.get("attributes", {}).get("POSITION")
        if position is None:
            self.accessors.refuse(f"{where} has no positions")
        draco = primitive.get("extensions", {}).get(DRACO)
        indices = primitive.get("indices")
        plain = self.accessors.has_data(position) and (indices is None or self.accessors.has_data(indices))
        if draco is not None and not plain:
            count = self.accessors.whole(self.accessors.entry("accessors", position), "count", where)
            points, faces = self.accessors.draco(draco, count)
            said = self.accessors.entry("accessors", indices).get("count") if indices is not None else None
            if said is not None and mode == TRIANGLES and said != 3 * len(faces):
                self.accessors.refuse(f"{where} has {len(faces):,} triangles in Draco, and {said:,} indices")
        else:
            points = self.accessors.read(position, 3)
            corners = np.arange(len(points)) if indices is None else self.accessors.indices(indices)
            if mode == TRIANGLES and len(corners) % 3:
                self.accessors.refuse(f"{where} has {len(corners):,} indices, not a multiple of 3")
            if mode == TRIANGLES:
                faces = corners.reshape(-1, 3)
            elif mode == STRIP:
                faces = strip_triangles(corners)
            elif mode == FAN:
                inner = (
                    np.stack([corners[1:-1], corners[2:]], axis=1) if len(corners) > 2 else np.zeros((0, 2), np.int64)
                )
                faces = np.concatenate([np.broadcast_to(corners[:1], (len(inner), 1)), inner], axis=1)
            else:
                self.accessors.refuse(f"{where} is of the mode {str(mode)[:20]}, which glTF does not have")
        if len(faces) and not (faces.min() >= 0 and faces.max() < len(points)):
            self.accessors.refuse(f"{where} has the index {faces.max():,}, beyond its {len(points):,} positions")
        return points, faces


def _compose(
    translation: NDArray[np.float64], rotation: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Matrix of a scale, then a rotation by a quaternion (x, y, z, w), then a translation."""
    length = np.linalg.norm(rotation)
    x, y, z, w = rotation / length if length > 0.0 else (0.0, 0.0, 0.0, 1.0)
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, :3] *= scale
    out[:3, 3] = translation
    return out


def _known(extension: Any) -> bool:
    return extension in READ or str(extension).startswith(LOOKS)
