"""The table's scene as binary glTF, without a mesh library.

glTF 2.0, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. In glTF the y axis points up, in the scene frame
the z axis. The root node, named after the site, rotates the scene upright. Vertices are relative to the middle of the
scene, to which a second node translates them. This keeps single precision exact to a fraction of a millimetre in sites
far from their origin. ``origin_m`` in the asset's extras is that middle in the scene frame: programs that store
translations of nodes in single precision draw relative to it.
"""

import json
import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.scene import Scene

MEDIA_TYPE = "model/gltf-binary"

NO_MATERIAL = "unnamed"
"""Material name for faces without a material."""

_FLOAT, _UNSIGNED_INT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963

_Z_UP_TO_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Quaternion of a quarter turn about x, which takes z to y."""

_COLOURS = {
    "concrete": (0.62, 0.63, 0.65),
    "brick": (0.62, 0.42, 0.36),
    "plasterboard": (0.78, 0.77, 0.74),
    "wood": (0.63, 0.49, 0.35),
    "glass": (0.62, 0.76, 0.82),
    "metal": (0.52, 0.57, 0.64),
    "marble": (0.76, 0.75, 0.78),
    "floorboard": (0.58, 0.47, 0.36),
    "chipboard": (0.66, 0.56, 0.44),
    "ceiling_board": (0.80, 0.80, 0.78),
}
"""Base colours by a part of the material's name; the names are those of ITU-R P.2040."""

_GREY = (0.64, 0.66, 0.69)


def write_glb(scene: Scene, name: str) -> bytes:
    """Write a scene as binary glTF.

    Parameters
    ----------
    scene : Scene
    name : str
        Name of the root node.

    Returns
    -------
    bytes
        One mesh with a primitive for each material; faces are double-sided.
    """
    low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
    middle = np.round(0.5 * (low + high), 3)
    vertices = np.ascontiguousarray(scene.vertices - middle, dtype="<f4")
    groups = [
        (number, np.ascontiguousarray(scene.faces[scene.face_materials == number], dtype="<u4"))
        for number in np.unique(scene.face_materials)
    ]
    accessors: list[dict[str, Any]] = [
        {
            "bufferView": 0,
            "componentType": _FLOAT,
            "count": len(vertices),
            "type": "VEC3",
            "min": vertices.min(axis=0).tolist(),
            "max": vertices.max(axis=0).tolist(),
        }
    ]
    views: list[dict[str, Any]] = [{"buffer": 0, "byteOffset": 0, "byteLength": vertices.nbytes, "target": _VERTICES}]
    materials, primitives = [], []
    for number, faces in groups:
        materials.append(_material(scene.materials[number] if number >= 0 else NO_MATERIAL))
        primitives.append(
            {"attributes": {"POSITION": 0}, "indices": len(accessors), "material": len(materials) - 1, "mode": 4}
        )
        accessors.append(
            {"bufferView": len(views), "componentType": _UNSIGNED_INT, "count": faces.size, "type": "SCALAR"}
        )
        offset = views[-1]["byteOffset"] + views[-1]["byteLength"]
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": faces.nbytes, "target": _INDICES})
    document = {
        "asset": {"version": "2.0", "generator": "rayfix", "extras": {"origin_m": middle.tolist()}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": name, "rotation": _Z_UP_TO_Y_UP, "children": [1]},
            {"name": f"{name}, scene frame", "translation": middle.tolist(), "mesh": 0},
        ],
        "meshes": [{"name": name, "primitives": primitives}],
        "materials": materials,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": views[-1]["byteOffset"] + views[-1]["byteLength"]}],
    }
    return _container(document, [vertices, *(faces for _, faces in groups)])


def _material(name: str) -> dict[str, Any]:
    colour = next((c for part, c in _COLOURS.items() if part in name.lower()), _GREY)
    return {
        "name": name,
        "doubleSided": True,
        "pbrMetallicRoughness": {"baseColorFactor": [*colour, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.9},
    }


def _container(document: dict[str, Any], arrays: list[NDArray[Any]]) -> bytes:
    """Pack the two chunks; each is padded to four bytes."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(array.tobytes() for array in arrays)  # all numbers have four bytes: no padding
    length = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, length),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(binary), b"BIN\0"),
            binary,
        ]
    )
