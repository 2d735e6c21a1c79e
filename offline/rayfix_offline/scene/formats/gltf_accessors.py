"""Arrays in glTF buffers: plain, with a stride, normalised, sparse, or compressed with Draco."""

import base64
import binascii
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.scene_folder import SceneFolder, outside_error
from rayfix_tables.errors import SceneError

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}

DRACO = "KHR_draco_mesh_compression"
MESHOPT = {
    "EXT_meshopt_compression": "gltf-transform copy in.glb out.glb",
    "KHR_meshopt_compression": "gltfpack -noq -kn -km -i in.glb -o out.glb",
}
"""Unsupported compressions, each with a command that removes it; gltf-transform does not support the newer one."""

_MOST = 200_000_000
"""Largest number of values of a sparse accessor without data in the file."""


class Accessors:
    """Reads the arrays of a glTF file.

    Parameters
    ----------
    path : Path
        The file.
    document : dict
        Its JSON.
    binary : bytes, optional
        The binary chunk of a ``.glb``.
    """

    def __init__(self, path: Path, document: dict[str, Any], binary: bytes | None) -> None:
        self.path = path
        self.document = document
        self.binary = binary
        self._buffers: dict[int, bytes] = {}

    @cached_property
    def _folder(self) -> SceneFolder:
        return SceneFolder(self.path.parent, self.path.parent)

    def refuse(self, problem: str, remedy: str = "export the scene again") -> NoReturn:
        """Raise an error for a problem of the file.

        Raises
        ------
        SceneError
        """
        raise SceneError(f"{self.path} cannot be read as glTF ({problem}); {remedy}")

    def entry(self, kind: str, number: Any) -> dict[str, Any]:
        """Return an entry of one of the document's lists."""
        entries = self.document.get(kind, [])
        if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < len(entries):
            self.refuse(f"it refers to {kind}[{str(number)[:20]}], which does not exist")
        entry = entries[number]
        if not isinstance(entry, dict):
            self.refuse(f"{kind}[{number}] is not an object")
        return entry

    def read(self, number: Any, width: int) -> NDArray[np.float64]:
        """Return an accessor's values; normalised integers are converted to fractions.

        Parameters
        ----------
        width : int
            Components of each element.

        Returns
        -------
        ndarray of shape (count, width)
        """
        accessor = self.entry("accessors", number)
        values = self._stored(accessor, number, width).astype(np.float64)
        if accessor.get("normalized"):
            kind = np.dtype(COMPONENTS[accessor["componentType"]])
            if kind.kind != "f":
                values = np.maximum(values / np.iinfo(kind).max, -1.0)
        return values

    def indices(self, number: Any) -> NDArray[np.int64]:
        """Return an accessor's values as indices, shape (count,)."""
        accessor = self.entry("accessors", number)
        if accessor.get("componentType") not in (5121, 5123, 5125):
            self.refuse(f"accessors[{number}] has indices that are not unsigned integers")
        return self._stored(accessor, number, 1).reshape(-1).astype(np.int64)

    def has_data(self, number: Any) -> bool:
        """Whether an accessor has its own values, besides those of a compressed primitive."""
        accessor = self.entry("accessors", number)
        return "bufferView" in accessor or "sparse" in accessor

    def _stored(self, accessor: dict[str, Any], number: int, width: int) -> NDArray[Any]:
        where = f"accessors[{number}]"
        kind = accessor.get("componentType")
        if kind not in COMPONENTS or WIDTHS.get(str(accessor.get("type"))) != width:
            self.refuse(f"{where} is not a {width}-vector of numbers")
        count = self.whole(accessor, "count", where)
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            out = self._view(accessor, COMPONENTS[kind], width, count, where)
        elif sparse is None:
            self.refuse(f"{where} has no data")
        elif count > _MOST:
            self.refuse(f"{where} has {count:,} values that are not in the file, more than {_MOST:,}")
        else:
            out = np.zeros((count, width), COMPONENTS[kind])
        if sparse is None:
            return out
        some = self.whole(sparse, "count", f"{where}.sparse")
        at, new = sparse.get("indices", {}), sparse.get("values", {})
        if at.get("componentType") not in (5121, 5123, 5125):
            self.refuse(f"{where}.sparse has indices that are not unsigned integers")
        places = self._view(at, COMPONENTS[at["componentType"]], 1, some, where)[:, 0].astype(np.int64)
        if some and places.max() >= count:
            self.refuse(f"{where}.sparse changes a value beyond the accessor's count")
        out = out.copy()
        out[places] = self._view(new, COMPONENTS[kind], width, some, where)
        return out

    def whole(self, entry: dict[str, Any], key: str, where: str, missing: int | None = None) -> int:
        """Return an integer of 0 or more."""
        value = entry.get(key, missing)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            self.refuse(f"{where}.{key} is {str(value)[:20]}")
        return value

    def _view(self, entry: dict[str, Any], kind: str, width: int, count: int, where: str) -> NDArray[Any]:
        """Elements in a view, from the entry's offset on, shape (count, width)."""
        number = entry.get("bufferView")
        data, stride = self._view_bytes(number)
        offset = self.whole(entry, "byteOffset", where, 0)
        size = np.dtype(kind).itemsize * width
        stride = stride or size
        if stride < size:
            self.refuse(f"bufferViews[{number}].byteStride is {stride}, less than the size of an element")
        if count and offset + stride * (count - 1) + size > len(data):
            self.refuse(f"{where} goes beyond bufferViews[{number}]")
        if not count:
            return np.zeros((0, width), kind)
        rows = np.ndarray((count, width), kind, data, offset, (stride, np.dtype(kind).itemsize))
        return np.array(rows)

    def _view_bytes(self, number: Any) -> tuple[bytes, int]:
        view = self.entry("bufferViews", number)
        where = f"bufferViews[{number}]"
        buffer = view.get("buffer")
        compressed = [name for name in MESHOPT if name in view.get("extensions", {})]
        if compressed and not self._is_there(buffer):
            self.refuse(
                f"its geometry is compressed with {compressed[0]}, which is not supported",
                f"decompress it, for example with: {MESHOPT[compressed[0]]}",
            )
        data = self._buffer(buffer)
        start = self.whole(view, "byteOffset", where, 0)
        length = self.whole(view, "byteLength", where)
        if start + length > len(data):
            self.refuse(f"{where} goes beyond buffers[{buffer}]")
        return data[start : start + length], self.whole(view, "byteStride", where, 0)

    def _is_there(self, number: Any) -> bool:
        """Whether a buffer has content; a placeholder for compressed data may have none."""
        return "uri" in self.entry("buffers", number) or (number == 0 and self.binary is not None)

    def _buffer(self, number: Any) -> bytes:
        if number in self._buffers:
            return self._buffers[number]
        buffer = self.entry("buffers", number)
        length = self.whole(buffer, "byteLength", f"buffers[{number}]")
        uri = buffer.get("uri")
        if uri is None:
            if number != 0 or self.binary is None:
                self.refuse(f"buffers[{number}] has no content")
            data = self.binary
        elif not isinstance(uri, str):
            self.refuse(f"buffers[{number}].uri is not a text")
        elif uri.startswith("data:"):
            head, _, body = uri.partition(",")
            if not head.endswith(";base64"):
                self.refuse(f"buffers[{number}] has data that are not in base64")
            try:
                data = base64.b64decode(body, validate=True)
            except (binascii.Error, ValueError) as error:
                self.refuse(f"buffers[{number}] has data that are not base64 ({error})")
        else:
            data = self._file(uri)
        if len(data) < length:
            self.refuse(f"buffers[{number}] has {len(data):,} bytes instead of {length:,}")
        self._buffers[number] = data[:length]
        return self._buffers[number]

    def _file(self, uri: str) -> bytes:
        found = self._folder.find(uri)
        if found is None:
            if self._folder.refused:
                raise outside_error(str(self.path), uri)
            self.refuse(f"it needs '{uri[:200]}', which is missing", "put that file next to it")
        try:
            return found.read_bytes()
        except OSError as error:
            self.refuse(f"'{uri[:200]}' cannot be read: {error.strerror}", "correct its permissions")

    def draco(self, extension: dict[str, Any], count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return positions and triangles of a primitive compressed with Draco.

        Parameters
        ----------
        count : int
            Number of positions that the primitive's accessor states.
        """
        import DracoPy

        data, _ = self._view_bytes(extension.get("bufferView"))
        number = extension.get("attributes", {}).get("POSITION")
        try:
            mesh = DracoPy.decode(data)
            faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
            positions = next(each["data"] for each in mesh.attributes if each["unique_id"] == number)
            points = np.asarray(positions, np.float64).reshape(-1, 3)
        except Exception as error:  # the decoder raises various exceptions for damaged data
            reason = str(error)[:80] or type(error).__name__
            self.refuse(f"its data compressed with {DRACO} cannot be decoded: {reason}")
        if len(points) != count:
            self.refuse(f"its Draco data have {len(points):,} positions instead of {count:,}")
        return points, faces
