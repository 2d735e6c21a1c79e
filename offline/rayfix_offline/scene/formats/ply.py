"""PLY: the Stanford format, as text or binary, with triangles, polygons and strips."""

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.placed import Contents, Placed, one_material, too_few_corners
from rayfix_offline.scene.polygons import cut_polygons
from rayfix_offline.scene.text import decode
from rayfix_tables.errors import SceneError

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
LISTS = ("vertex_indices", "vertex_index")

_MOST = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class _Property:
    name: str
    kind: str
    length_kind: str = ""
    """Type of a list's length."""


@dataclass(frozen=True, kw_only=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


_Column = NDArray[np.float64] | tuple[NDArray[np.int64], NDArray[np.float64]]
"""A property of all instances: values, or lengths and values of lists."""


def read_ply(path: Path) -> Contents:
    """Read a PLY file as one object.

    Raises
    ------
    SceneError
        When the file is not PLY, is shorter or longer than its header states, or refers to missing vertices.
    """
    content = path.read_bytes()
    order, elements, start = _header(path, content)
    if order:
        columns = _binary(path, elements, content[start:], order)
    else:
        columns = _words(path, elements, decode(content[start:]).split())
    vertex = columns.get("vertex", {})
    if not {"x", "y", "z"} <= set(vertex):
        _refuse(path, "its header names no vertices with x, y and z")
    vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    sizes, corners = _polygons(path, columns.get("face", {}))
    strips = _strips(path, columns.get("tristrips", {}))
    used = np.concatenate([corners, strips.reshape(-1)])
    if len(used) and not (used.min() >= 0 and used.max() < len(vertices)):
        _refuse(path, f"it has a face with a vertex beyond its {len(vertices):,} vertices")
    if (sizes < 3).any():
        kept = np.repeat(sizes >= 3, sizes)
        corners = corners[kept]
    flat = int(np.count_nonzero(sizes < 3))
    sizes = sizes[sizes >= 3]
    cut = cut_polygons(vertices, corners, sizes)
    remarks = list(cut.remarks(vertices, corners, np.cumsum(sizes) - sizes))
    if flat:
        remarks.append(too_few_corners(flat))
    faces = np.concatenate([cut.faces, strips])
    materials, face_materials = one_material(None, len(faces))
    placed = Placed(name=path.name, vertices=vertices, faces=faces, materials=materials, face_materials=face_materials)
    return Contents(objects=(placed,), remarks=tuple(remarks))


def _header(path: Path, content: bytes) -> tuple[str, list[_Element], int]:
    """Byte order, empty for text; elements; and where they begin."""
    end = content.find(b"end_header")
    if content[:3] != b"ply" or end < 0:
        _refuse(path, "it does not begin with the header of a PLY file")
    lines = decode(content[:end]).replace("\r\n", "\n").replace("\r", "\n").split("\n")
    start = end + len(b"end_header")
    start += 2 if content[start : start + 2] == b"\r\n" else 1
    order: str | None = None
    elements: list[_Element] = []
    for line in lines[1:]:
        words = line.split()
        try:
            match words:
                case [] | ["comment" | "obj_info", *_]:
                    continue
                case ["format", "ascii", *_]:
                    order = ""
                case ["format", name, *_]:
                    order = ORDERS[name]
                case ["element", name, count]:
                    elements.append(_Element(name=name, count=int(count), properties=[]))
                    if not 0 <= int(count) < _MOST:
                        raise ValueError
                case ["property", "list", length, kind, name]:
                    new = _Property(name=name, kind=TYPES[kind], length_kind=TYPES[length])
                    elements[-1].properties.append(new)
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name=name, kind=TYPES[kind]))
                case _:
                    raise ValueError
        except (KeyError, ValueError, IndexError):
            _refuse(path, f"its header has the line '{line.strip()[:60]}'")
    if order is None:
        _refuse(path, "its header has no format")
    return order, elements, start


def _binary(path: Path, elements: list[_Element], data: bytes, order: str) -> dict[str, dict[str, _Column]]:
    found: dict[str, dict[str, _Column]] = {}
    at = 0
    for element in elements:
        lists = [each for each in element.properties if each.length_kind]
        lengths = dict.fromkeys((each.name for each in lists), 0)
        if lists and element.count:
            lengths = _first_lengths(path, element, data, at, order)
        fields: list[tuple[str, ...] | tuple[str, str, tuple[int]]] = []
        for number, each in enumerate(element.properties):
            if each.length_kind:
                fields.append((f"n{number}", order + each.length_kind))
                fields.append((f"v{number}", order + each.kind, (lengths[each.name],)))
            else:
                fields.append((f"v{number}", order + each.kind))
        kind = np.dtype(fields)
        columns: dict[str, _Column] = {}
        alike = at + kind.itemsize * element.count <= len(data)
        if alike:
            rows = np.frombuffer(data, kind, element.count, at)
            alike = all(
                (rows[f"n{number}"] == lengths[each.name]).all()
                for number, each in enumerate(element.properties)
                if each.length_kind
            )
        if alike:
            for number, each in enumerate(element.properties):
                values = rows[f"v{number}"].astype(np.float64)
                if each.length_kind:
                    columns[each.name] = (np.full(element.count, lengths[each.name]), values.reshape(-1))
                else:
                    columns[each.name] = values
            at += kind.itemsize * element.count
        elif not lists:
            _truncated(path, element)
        else:
            columns, at = _one_by_one(path, element, data, at, order)
        found[element.name] = columns
    if data[at:].strip(b"\0\r\n\t "):
        _refuse(path, f"it has {len(data) - at:,} bytes more than its header states")
    return found


def _first_lengths(path: Path, element: _Element, data: bytes, at: int, order: str) -> dict[str, int]:
    """Lengths of the lists of an element's first instance."""
    lengths = {}
    for each in element.properties:
        if each.length_kind:
            lengths[each.name] = _value(path, element, data, at, order + each.length_kind)
            at += np.dtype(each.length_kind).itemsize
            if not 0 <= lengths[each.name] < _MOST:
                _truncated(path, element)
        at += np.dtype(each.kind).itemsize * lengths.get(each.name, 1)
    return lengths


def _value(path: Path, element: _Element, data: bytes, at: int, kind: str) -> int:
    if at + np.dtype(kind).itemsize > len(data):
        _truncated(path, element)
    return int(np.frombuffer(data, kind, 1, at)[0])


def _one_by_one(path: Path, element: _Element, data: bytes, at: int, order: str) -> tuple[dict[str, _Column], int]:
    """Read instances whose lists differ in length."""
    lengths: dict[str, list[int]] = {each.name: [] for each in element.properties}
    pieces: dict[str, list[NDArray[np.float64]]] = {each.name: [] for each in element.properties}
    kinds = [
        (each.name, np.dtype(order + each.kind), np.dtype(order + each.length_kind) if each.length_kind else None)
        for each in element.properties
    ]
    for _ in range(element.count):
        for name, kind, length_kind in kinds:
            length = 1
            if length_kind is not None:
                if at + length_kind.itemsize > len(data):
                    _truncated(path, element)
                length = int(np.frombuffer(data, length_kind, 1, at)[0])
                at += length_kind.itemsize
            if length < 0 or at + length * kind.itemsize > len(data):
                _truncated(path, element)
            lengths[name].append(length)
            pieces[name].append(np.frombuffer(data, kind, length, at).astype(np.float64))
            at += length * kind.itemsize
    columns: dict[str, _Column] = {}
    for each in element.properties:
        values = np.concatenate(pieces[each.name])
        columns[each.name] = (np.array(lengths[each.name]), values) if each.length_kind else values
    return columns, at


def _words(path: Path, elements: list[_Element], words: list[str]) -> dict[str, dict[str, _Column]]:
    found: dict[str, dict[str, _Column]] = {}
    at = 0
    try:
        for element in elements:
            columns: dict[str, _Column] = {}
            width = len(element.properties)
            if not any(each.length_kind for each in element.properties):
                stop = at + width * element.count
                if stop > len(words):
                    _truncated(path, element)
                values = np.array(words[at:stop], np.float64).reshape(element.count, width)
                columns = {each.name: values[:, k] for k, each in enumerate(element.properties)}
                at = stop
            else:
                lengths: dict[str, list[int]] = {each.name: [] for each in element.properties}
                pieces: dict[str, list[str]] = {each.name: [] for each in element.properties}
                for _ in range(element.count):
                    for each in element.properties:
                        length = 1
                        if each.length_kind:
                            length, at = int(words[at]), at + 1
                        if length < 0 or at + length > len(words):
                            _truncated(path, element)
                        lengths[each.name].append(length)
                        pieces[each.name] += words[at : at + length]
                        at += length
                for each in element.properties:
                    numbers = np.array(pieces[each.name], np.float64)
                    columns[each.name] = (np.array(lengths[each.name]), numbers) if each.length_kind else numbers
            found[element.name] = columns
    except IndexError:
        _truncated(path, element)
    except ValueError as error:
        _refuse(path, f"element '{element.name}': {str(error)[:80]}")
    if at < len(words):
        _refuse(path, f"it has {len(words) - at:,} numbers more than its header states")
    return found


def _polygons(path: Path, face: dict[str, _Column]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sizes and corners of the faces."""
    if not face:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    column = next((face[name] for name in LISTS if name in face), None)
    if not isinstance(column, tuple):
        _refuse(path, f"its faces have no list called {' or '.join(LISTS)}")
    return column[0].astype(np.int64), column[1].astype(np.int64)


def _strips(path: Path, strips: dict[str, _Column]) -> NDArray[np.int64]:
    """Triangles of strips, which -1 separates; every other triangle is flipped."""
    if not strips:
        return np.zeros((0, 3), np.int64)
    column = next((strips[name] for name in LISTS if name in strips), None)
    if not isinstance(column, tuple):
        _refuse(path, f"its strips have no list called {' or '.join(LISTS)}")
    ends = np.cumsum(column[0])
    out = [np.zeros((0, 3), np.int64)]
    for whole in np.split(column[1].astype(np.int64), ends[:-1].astype(np.int64)):
        pieces = np.split(whole, np.flatnonzero(whole == -1))
        out.extend(strip_triangles(piece[piece != -1]) for piece in pieces)
    return np.concatenate(out)


def strip_triangles(strip: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles of a strip of corners, shape (n, 3), oriented like the first."""
    if len(strip) < 3:
        return np.zeros((0, 3), np.int64)
    faces = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    faces[1::2] = faces[1::2][:, [1, 0, 2]]
    return faces


def _truncated(path: Path, element: _Element) -> NoReturn:
    _refuse(path, f"it ends within its {element.count:,} '{element.name}'")


def _refuse(path: Path, problem: str) -> NoReturn:
    raise SceneError(f"{path} cannot be read as PLY ({problem}); export the scene again")
