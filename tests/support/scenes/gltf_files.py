"""glTF files written by hand, so that every way of storing a mesh can be tried."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class GltfFile:
    """A document and its buffer; meshes are added to it."""

    def __init__(self) -> None:
        self.binary = b""
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append an entry to one of the document's lists, and return its number."""
        self.document.setdefault(kind, []).append(entry)
        return len(self.document[kind]) - 1

    def view(self, data: bytes, **more: Any) -> int:
        """Append bytes to the buffer."""
        self.binary += bytes(-len(self.binary) % 4)
        start = len(self.binary)
        self.binary += data
        return self.add("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data), **more})

    def accessor(self, values: NDArray[Any], **more: Any) -> int:
        """Append an array, shape (n,) or (n, width)."""
        width = 1 if values.ndim == 1 else values.shape[1]
        form = {"componentType": COMPONENTS[values.dtype.name], "count": len(values), "type": KINDS[width]}
        return self.add("accessors", {"bufferView": self.view(values.tobytes()), **form, **more})

    def mesh(self, primitives: Sequence[dict[str, Any]], **more: Any) -> int:
        """Append a mesh."""
        return self.add("meshes", {"primitives": list(primitives), **more})

    def node(self, *, root: bool = True, **entry: Any) -> int:
        """Append a node, to the scene too unless it is another's child."""
        number = self.add("nodes", entry)
        if root:
            self.document["scenes"][0]["nodes"].append(number)
        return number

    def write(self, path: Path) -> Path:
        """Write a ``.glb``."""
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        body = self.binary + bytes(-len(self.binary) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def box_arrays(low: Sequence[float], high: Sequence[float]) -> tuple[NDArray[np.float32], NDArray[np.uint16]]:
    """Corners and triangles of a box that faces outwards."""
    ends = (np.asarray(low), np.asarray(high))
    points = np.array([[ends[(k >> axis) & 1][axis] for axis in range(3)] for k in range(8)], np.float32)
    rings = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = np.array([(r[0], r[k], r[k + 1]) for r in rings for k in (1, 2)], np.uint16)
    return points, faces
