"""Wavefront OBJ: polygons in groups, with names of materials.

Only the names of materials matter, and they are in the file itself. Material files are looked for but not read.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np

from rayfix_offline.scene.placed import Contents, Placed, Remark, counted
from rayfix_offline.scene.polygons import cut_polygons
from rayfix_offline.scene.scene_folder import SceneFolder
from rayfix_offline.scene.text import decode
from rayfix_tables.errors import SceneError

FREE_FORM = ("cstype", "curv", "curv2", "surf", "bmat", "call", "csh")
"""Keywords that are refused: free-form geometry, and geometry in other files."""

PASSED_OVER = {"l": "line", "p": "point element"}
"""Keywords of elements without an area."""

IGNORED = frozenset(
    ("vt", "vn", "s", "mg", "lod", "bevel", "c_interp", "d_interp", "shadow_obj", "trace_obj", "maplib", "usemap")
)
"""Keywords of appearance."""


def read_obj(path: Path) -> Contents:
    """Read an OBJ file; each group, or each object without groups, becomes an object.

    Raises
    ------
    SceneError
        When a line cannot be read, or the file has free-form surfaces.
    """
    parser = _Parser(path)
    try:
        text = decode(path.read_bytes())
    except UnicodeDecodeError as error:
        raise SceneError(f"{path} cannot be read as text in the encoding that its byte order mark names") from error
    parser.read(text)
    return parser.contents()


class _Parser:
    """State of the file up to a line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.line = 0
        self.vertices: list[tuple[float, float, float]] = []
        self.corners: list[int] = []
        self.sizes: list[int] = []
        self.polygon_groups: list[int] = []
        self.polygon_materials: list[int] = []
        self.groups: dict[str, int] = {}
        self.materials: dict[str, int] = {}
        self.libraries: list[str] = []
        self.passed: dict[str, int] = {}
        self.object = ""
        self.group = -1
        self.material = -1
        self.enter("")

    def refuse(self, problem: str) -> NoReturn:
        raise SceneError(f"{self.path}, line {self.line}: {problem}")

    def read(self, text: str) -> None:
        statements: dict[str, Callable[[str], None]] = {
            "v": self.vertex,
            "f": self.face,
            "fo": self.face,
            "g": self.begin_group,
            "o": self.begin_object,
            "usemtl": self.use_material,
            "mtllib": self.name_library,
        }
        going_on = ""
        for self.line, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
            if line.endswith("\\"):
                going_on += line[:-1] + " "
                continue
            if going_on:
                line, going_on = going_on + line, ""
            word, _, rest = line.strip().replace("\t", " ").partition(" ")
            if word in statements:
                statements[word](rest)
            elif word in PASSED_OVER:
                self.passed[word] = self.passed.get(word, 0) + 1
            elif word in FREE_FORM:
                self.refuse(f"'{word}' is not supported; export the scene as polygons, in one file")
            elif word and not word.startswith("#") and word not in IGNORED:
                self.passed[word] = self.passed.get(word, 0) + 1

    def vertex(self, rest: str) -> None:
        words = rest.split()
        try:
            self.vertices.append((float(words[0]), float(words[1]), float(words[2])))
        except (ValueError, IndexError):
            self.refuse(f"'v {rest.strip()[:60]}' does not have three numbers; export the scene again")

    def face(self, rest: str) -> None:
        count = len(self.vertices)
        ring = []
        try:
            for word in rest.split():
                if word.startswith("#"):
                    break
                number = int(word.partition("/")[0])
                # Negative ones count from the last vertex so far.
                ring.append(number - 1 if number > 0 else count + number if number < 0 else -1)
        except ValueError:
            self.refuse(f"'f {rest.strip()[:60]}' has an invalid vertex index; export the scene again")
        if ring and min(ring) < 0:
            self.refuse(f"'f {rest.strip()[:60]}' refers to a vertex that does not exist; export the scene again")
        if len(ring) < 3:
            self.passed["f"] = self.passed.get("f", 0) + 1
            return
        self.corners += ring
        self.sizes.append(len(ring))
        self.polygon_groups.append(self.group)
        self.polygon_materials.append(self.material)

    def enter(self, name: str) -> None:
        self.group = self.groups.setdefault(name, len(self.groups))

    def begin_object(self, rest: str) -> None:
        self.object = rest.strip()
        self.enter(self.object)

    def begin_group(self, rest: str) -> None:
        # An empty name, by which many exporters close a group: back to the object.
        name = " ".join(rest.split())
        plain = name in ("", "default", "off", "(null)")
        self.enter(self.object if plain else f"{self.object}/{name}" if self.object else name)

    def use_material(self, rest: str) -> None:
        name = rest.strip()
        self.material = self.materials.setdefault(name, len(self.materials)) if name else -1

    def name_library(self, rest: str) -> None:
        if rest.strip():
            self.libraries.append(rest.strip())

    def contents(self) -> Contents:
        vertices = np.array(self.vertices, np.float64).reshape(-1, 3)
        corners = np.array(self.corners, np.int64)
        if len(corners) and corners.max() >= len(vertices):
            raise SceneError(
                f"{self.path} has a face of vertex {corners.max() + 1:,}, and {len(vertices):,} vertices; "
                "export the scene again"
            )
        sizes = np.array(self.sizes, np.int64)
        cut = cut_polygons(vertices, corners, sizes)
        starts = np.cumsum(sizes) - sizes
        groups = np.array(self.polygon_groups, np.int64)[cut.polygons]
        materials = np.array(self.polygon_materials, np.int64)[cut.polygons]
        order = np.argsort(groups, kind="stable")
        ends = np.cumsum(np.bincount(groups, minlength=len(self.groups)))
        objects = []
        for name, number in self.groups.items():
            own = order[(ends[number - 1] if number else 0) : ends[number]]
            if not len(own):
                continue
            used, faces = np.unique(cut.faces[own], return_inverse=True)
            objects.append(
                Placed(
                    name=name or self.path.stem,
                    vertices=vertices[used],
                    faces=faces.reshape(-1, 3),
                    materials=tuple(self.materials),
                    face_materials=materials[own],
                )
            )
        remarks = (*self.library_remarks(), *self.passed_remarks(), *cut.remarks(vertices, corners, starts))
        return Contents(objects=tuple(objects), remarks=remarks)

    def library_remarks(self) -> list[Remark]:
        """Warn of missing material files; a line names several files, or one with blanks in its name."""
        folder = SceneFolder(self.path.parent, self.path.parent)
        missing = []
        for line in dict.fromkeys(self.libraries):
            if folder.find(line) is None:
                missing += [name for name in line.split() if folder.find(name) is None]
        folder.refuse_outside(str(self.path))
        if not missing:
            return []
        names = ", ".join(f"'{name[:100]}'" for name in dict.fromkeys(missing))
        return [
            Remark(
                kind="material file",
                problem=f"the material file {names} is missing: materials have the names in the scene file",
                remedy="no effect if those are names of ITU-R P.2040; otherwise export it too",
            )
        ]

    def passed_remarks(self) -> list[Remark]:
        flat = [counted(n, PASSED_OVER[word]) for word, n in self.passed.items() if word in PASSED_OVER]
        if "f" in self.passed:
            flat.append(counted(self.passed["f"], "face") + " of fewer than three corners")
        unknown = {word: n for word, n in self.passed.items() if word not in PASSED_OVER and word != "f"}
        remarks = []
        if flat:
            problem = f"{' and '.join(flat)}, without an area, left out"
            remarks.append(Remark(kind="left out", problem=problem, remedy="export surfaces only"))
        if unknown:
            named = ", ".join(f"'{word[:30]}'" for word in list(unknown)[:4])
            number = sum(unknown.values())
            begin = "that begins" if number == 1 else "that begin"
            problem = f"{counted(number, 'line')} of the file {begin} with {named} left out, because they are unknown"
            remarks.append(Remark(kind="left out", problem=problem, remedy="export the scene again"))
        return remarks
