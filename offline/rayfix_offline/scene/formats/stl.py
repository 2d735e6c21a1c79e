"""STL: loose triangles, binary or as text."""

import re
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.placed import Contents, Placed, Remark, counted, one_material
from rayfix_offline.scene.polygons import cut_polygons
from rayfix_offline.scene.text import decode
from rayfix_tables.errors import SceneError

HEADER, RECORD = 84, 50
"""Bytes of a binary file's header, count included, and of a triangle."""

NO_COUNT = (0, 2**32 - 1)
"""Counts that programs write if they do not know the number in advance."""

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path) -> Contents:
    """Read an STL file as one object.

    Raises
    ------
    SceneError
        When the file is not STL, or ends before its last triangle.
    """
    content = path.read_bytes()
    if not _is_binary(content):
        return _text(path, content)
    if len(content) < HEADER:
        _refuse(path, "it is neither text nor as long as the head of a binary file")
    said = int.from_bytes(content[HEADER - 4 : HEADER], "little")
    count, rest = divmod(len(content) - HEADER, RECORD)
    remarks = []
    if rest and (said in NO_COUNT or said > count):
        _refuse(path, f"it ends within a triangle, after {count:,}")
    if said > count and said not in NO_COUNT:
        _refuse(path, f"it states {counted(said, 'triangle')}, and ends after {count:,}")
    if rest:
        count = said
        problem = f"the file continues after its {counted(said, 'triangle')}, with bytes that are not read"
        remarks.append(
            Remark(kind="count", problem=problem, remedy="export the scene again, and see that all is there")
        )
    elif said != count:
        problem = f"the file states {counted(said, 'triangle')}, and has {count:,}: all of these are read"
        remarks.append(
            Remark(kind="count", problem=problem, remedy="export the scene again, and see that all is there")
        )
    corners = np.frombuffer(content, _RECORD, count, HEADER)["corners"].astype(np.float64).reshape(-1, 3)
    return _one(path, corners, np.arange(3 * count).reshape(-1, 3), remarks)


def _is_binary(content: bytes) -> bool:
    if len(content) >= HEADER and len(content) == HEADER + RECORD * int.from_bytes(content[80:84], "little"):
        return True
    head = content[:512]
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return False
    # Binary heads may begin with "solid" too; text has no zero bytes.
    return head.lstrip(b"\xef\xbb\xbf \t\r\n")[:5].lower() != b"solid" or b"\0" in content


def _text(path: Path, content: bytes) -> Contents:
    try:
        text = decode(content)
    except UnicodeDecodeError:
        _refuse(path, "it is not text in the encoding of its byte order mark")
    points: list[str] = []
    sizes: list[int] = []
    state = "solid"
    begun = ended = 0
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
        words = line.split()
        word = words[0].lower() if words else ""
        if word == "vertex" and state == "loop" and len(words) == 4:
            points += words[1:]
            sizes[-1] += 1
        elif word == "outer" and state == "facet":
            state = "loop"
            sizes.append(0)
        elif word == "endloop" and state == "loop":
            state = "end"
        elif word == "endfacet" and state == "end":
            state = "solid"
        elif word == "facet" and state == "solid":
            state = "facet"
        elif word == "solid" and state == "solid":
            begun += 1
        elif word == "endsolid" and state == "solid":
            ended += 1
        elif word:
            _refuse(path, f"line {number} is '{line.strip()[:60]}'")
    if state != "solid":
        _refuse(path, "it ends within a triangle")
    try:
        corners = np.array(points, np.float64).reshape(-1, 3)
    except ValueError as error:
        _refuse(path, str(error)[:80])
    remarks = []
    if ended < begun:
        problem = f"the file ends without 'endsolid', after {counted(len(sizes), 'triangle')}"
        remarks.append(Remark(kind="count", problem=problem, remedy="check that it is complete, or export it again"))
    if len(sizes) and min(sizes) < 3:
        _refuse(path, "it has a triangle of fewer than three corners")
    counts = np.array(sizes, np.int64)
    cut = cut_polygons(corners, np.arange(len(corners)), counts)
    remarks += cut.remarks(corners, np.arange(len(corners)), np.cumsum(counts) - counts)
    return _one(path, corners, cut.faces, remarks)


def _one(path: Path, corners: NDArray[np.float64], faces: NDArray[np.int64], remarks: list[Remark]) -> Contents:
    _, face_materials = one_material(None, len(faces))
    placed = Placed(name=path.name, vertices=corners, faces=faces, face_materials=face_materials)
    return Contents(objects=(placed,), remarks=tuple(remarks))


def _refuse(path: Path, problem: str) -> NoReturn:
    raise SceneError(f"{path} cannot be read as STL ({problem}); export the scene again")
