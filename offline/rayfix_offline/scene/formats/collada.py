"""COLLADA: nodes with geometries, whose materials are bound where they are instantiated."""

from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.formats.collada_transforms import transform_of
from rayfix_offline.scene.formats.ply import strip_triangles
from rayfix_offline.scene.formats.xml_limits import MOST_NESTED, kind_of, refuse_hostile_collada, refuse_hostile_xml
from rayfix_offline.scene.placed import Contents, Placed, Remark, counted, too_few_corners
from rayfix_offline.scene.polygons import cut_polygons
from rayfix_tables.errors import SceneError

UP = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}
NO_AREA = ("lines", "linestrips", "points")
SURFACES = ("triangles", "polylist", "polygons", "tristrips", "trifans")

_Surface = tuple[str, NDArray[np.int64]]
"""Symbol of a material, and triangles."""


def read_collada(path: Path) -> Contents:
    """Read the geometries of a COLLADA file's scene, one object for each instance.

    Raises
    ------
    SceneError
        When the file cannot be read completely: it is not XML, or refers to missing elements.
    """
    content = path.read_bytes()
    refuse_hostile_xml(path, content)
    refuse_hostile_collada(path, content)
    return _Reader(path, ElementTree.fromstring(content)).contents()


class _Reader:
    def __init__(self, path: Path, root: Element) -> None:
        self.path = path
        self.root = root
        # Exporters give one id to a scene, its node and its geometry.
        self.named: dict[tuple[str, str], list[Element]] = {}
        for each in root.iter():
            if each.get("id"):
                self.named.setdefault((kind_of(each), each.get("id", "")), []).append(each)
        self.geometries: dict[str, tuple[NDArray[np.float64], list[_Surface]]] = {}
        self.remarks: list[Remark] = []

    def refuse(self, problem: str) -> NoReturn:
        raise SceneError(f"{self.path} cannot be read as COLLADA ({problem}); export the scene again")

    def remark(self, kind: str, problem: str, remedy: str) -> None:
        new = Remark(kind=kind, problem=problem, remedy=remedy)
        if new not in self.remarks:
            self.remarks.append(new)

    def contents(self) -> Contents:
        asset = next((each for each in self.root if kind_of(each) == "asset"), None)
        metres, up = 1.0, None
        for each in asset if asset is not None else ():
            if kind_of(each) == "unit":
                metres = self.metres(each)
            elif kind_of(each) == "up_axis":
                up = UP.get((each.text or "").strip())
        objects = []
        for name, instance, transform in self.instances():
            url = instance.get("url", "")
            vertices, surfaces = self.geometry(self.target(url, "geometry"))
            if not surfaces:
                continue
            bound = self.bound(instance)
            names = [self.material(symbol, bound) for symbol, _ in surfaces]
            materials = tuple(dict.fromkeys(each for each in names if each))
            numbers = [materials.index(each) if each else -1 for each in names]
            sizes = [len(faces) for _, faces in surfaces]
            objects.append(
                Placed(
                    name=name,
                    vertices=vertices,
                    faces=np.concatenate([faces for _, faces in surfaces]),
                    materials=materials,
                    face_materials=np.repeat(np.array(numbers, np.int64), sizes),
                    transform=transform,
                )
            )
        self.notice_unplaced()
        return Contents(objects=tuple(objects), remarks=tuple(self.remarks), metres=metres, up=up)

    def metres(self, unit: Element) -> float:
        try:
            value = float(unit.get("meter", "1"))
        except ValueError:
            value = 0.0
        if not 0.0 < value < np.inf:
            self.refuse(f"its unit is {unit.get('meter', '')[:20]} m")
        return value

    def notice_unplaced(self) -> None:
        beside = [
            each.get("name") or each.get("id") or ""
            for each in self.root.iter()
            if kind_of(each) == "geometry" and each.get("id") and each.get("id") not in self.geometries
        ]
        if beside:
            self.remark(
                "left out",
                f"{counted(len(beside), 'geometry').replace('geometrys', 'geometries')} left out, such as "
                f"'{beside[0][:50]}', which no node of the scene uses",
                "add nodes for them if they belong to the scene",
            )

    def target(self, url: str, kind: str) -> Element:
        if not url.startswith("#"):
            self.refuse(f"it refers to '{url[:60]}', which is in another file")
        found = self.named.get((kind, url[1:]), [])
        if not found:
            self.refuse(f"it refers to the {kind} '{url[:60]}', which is missing")
        if len(found) > 1:
            self.refuse(f"it refers to the {kind} '{url[:60]}', of which there are {len(found)}")
        return found[0]

    def instances(self) -> Iterator[tuple[str, Element, NDArray[np.float64]]]:
        """Give name, instance and transform of all geometries in the scene."""
        shown = [each for each in self.root.iter() if kind_of(each) == "instance_visual_scene"]
        if shown:
            scene = self.target(shown[0].get("url", ""), "visual_scene")
        else:
            scenes = [each for each in self.root.iter() if kind_of(each) == "visual_scene"]
            if not scenes:
                return
            scene = scenes[0]
        stack = [(each, np.eye(4)) for each in reversed(scene) if kind_of(each) == "node"]
        while stack:
            node, outer = stack.pop()
            name = node.get("name") or node.get("id") or ""
            transform = outer @ self.transform(node, name)
            inner = []
            for each in node:
                kind = kind_of(each)
                if kind == "node":
                    inner.append((each, transform))
                elif kind == "instance_node":
                    inner.append((self.target(each.get("url", ""), "node"), transform))
                elif kind == "instance_geometry":
                    shape = self.target(each.get("url", ""), "geometry")
                    yield name or shape.get("name") or shape.get("id") or "", each, transform
                elif kind == "instance_controller":
                    yield name, self.skinned(each), transform
            stack += reversed(inner)

    def transform(self, node: Element, name: str) -> NDArray[np.float64]:
        try:
            return transform_of(node)
        except ValueError as error:
            self.refuse(f"the node '{name[:50]}' has {error}")

    def skinned(self, instance: Element) -> Element:
        """Return an instance of the geometry that a controller bends, in its rest pose."""
        url = instance.get("url", "")
        for _ in range(MOST_NESTED):
            controller = self.target(url, "controller")
            skin = next((each for each in controller if kind_of(each) in ("skin", "morph")), Element("none"))
            url = skin.get("source", "")
            if ("controller", url[1:]) not in self.named:
                break
        self.remark(
            "left out", "a geometry is bent by a controller: it is read in its rest pose", "apply it before the export"
        )
        out = Element("instance_geometry", {"url": url})
        out.extend(list(instance))
        return out

    def bound(self, instance: Element) -> dict[str, str]:
        """Materials' ids by the symbols that an instance binds."""
        return {
            each.get("symbol", ""): each.get("target", "")
            for each in instance.iter()
            if kind_of(each) == "instance_material"
        }

    def material(self, symbol: str, bound: dict[str, str]) -> str:
        """Name of a material; where a symbol is bound to none, the symbol."""
        target = bound.get(symbol, f"#{symbol}")
        found = self.named.get(("material", target[1:]), [])
        if found:
            return found[0].get("name") or found[0].get("id") or symbol
        if symbol in bound:
            self.remark(
                "material",
                f"the material '{target[:50]}' is missing: '{symbol[:50]}' is used, its name in the geometry",
                "export the scene again",
            )
        return symbol

    def geometry(self, element: Element) -> tuple[NDArray[np.float64], list[_Surface]]:
        """Vertices and triangles of a geometry."""
        name = element.get("id", "")
        if name in self.geometries:
            return self.geometries[name]
        vertices: list[NDArray[np.float64]] = []
        surfaces: list[_Surface] = []
        known: dict[str, int] = {}
        count = 0
        for mesh in element:
            if kind_of(mesh) in ("convex_mesh", "spline", "brep"):
                self.refuse(f"the geometry '{name[:50]}' is a <{kind_of(mesh)}>, and no <mesh>")
            for each in mesh if kind_of(mesh) == "mesh" else ():
                if kind_of(each) in NO_AREA:
                    self.remark(
                        "left out",
                        f"the geometry '{name[:50]}' has <{kind_of(each)}>, which have no area and are left out",
                        "export surfaces only",
                    )
                elif kind_of(each) in SURFACES:
                    source, stride, offset = self.inputs(each, name)
                    if source not in known:
                        known[source] = count
                        vertices.append(self.positions(source, name))
                        count += len(vertices[-1])
                    points = vertices[list(known).index(source)]
                    faces = self.faces(each, points, stride, offset, name)
                    if len(faces):
                        surfaces.append((each.get("material", ""), faces + known[source]))
                elif kind_of(each) not in ("source", "vertices", "extra"):
                    self.remark(
                        "left out",
                        f"the geometry '{name[:50]}' has <{kind_of(each)[:30]}>, which is unknown and left out",
                        "export triangles",
                    )
        self.geometries[name] = (np.concatenate([*vertices, np.zeros((0, 3))]), surfaces)
        return self.geometries[name]

    def inputs(self, surface: Element, name: str) -> tuple[str, int, int]:
        """Source of a surface's positions, number of indices per corner, and which of them is the position's."""
        found, stride = None, 1
        for each in surface:
            if kind_of(each) == "input":
                offset = self.number(each.get("offset", "0"), name)
                stride = max(stride, offset + 1)
                if each.get("semantic") == "VERTEX":
                    vertices = self.target(each.get("source", ""), "vertices")
                    inner = [i for i in vertices if kind_of(i) == "input" and i.get("semantic") == "POSITION"]
                    if not inner:
                        self.refuse(f"the geometry '{name[:50]}' has vertices without positions")
                    found = inner[0].get("source", ""), offset
                elif each.get("semantic") == "POSITION":
                    found = each.get("source", ""), offset
        if found is None:
            self.refuse(f"the geometry '{name[:50]}' has <{kind_of(surface)}> without vertices")
        return found[0], stride, found[1]

    def positions(self, url: str, name: str) -> NDArray[np.float64]:
        source = self.target(url, "source")
        accessor = next((each for each in source.iter() if kind_of(each) == "accessor"), None)
        if accessor is None:
            self.refuse(f"the source '{url[:50]}' has no accessor")
        values = self.floats(self.target(accessor.get("source", ""), "float_array"), name)
        stride = self.number(accessor.get("stride", "1"), name)
        offset = self.number(accessor.get("offset", "0"), name)
        count = self.number(accessor.get("count", "0"), name)
        params = [each.get("name", "") for each in accessor if kind_of(each) == "param"]
        places = [params.index(axis) for axis in "XYZ"] if {*"XYZ"} <= set(params) else [0, 1, 2]
        if stride < 3 or max(places) >= stride:
            self.refuse(f"the source '{url[:50]}' has no X, Y and Z")
        if offset + stride * count > len(values):
            self.refuse(f"the source '{url[:50]}' has {len(values):,} numbers, fewer than its accessor states")
        return values[offset : offset + stride * count].reshape(count, stride)[:, places]

    def faces(
        self, surface: Element, points: NDArray[np.float64], stride: int, offset: int, name: str
    ) -> NDArray[np.int64]:
        """Triangles of a <triangles>, <polylist> and so on."""
        kind = kind_of(surface)
        rings = [self.ring(each, stride, offset, name) for each in surface if kind_of(each) == "p"]
        holes: dict[int, list[NDArray[np.int64]]] = {}
        for each in surface:
            if kind_of(each) == "ph":
                outline = [self.ring(part, stride, offset, name) for part in each if kind_of(part) == "p"]
                if len(outline) != 1:
                    self.refuse(f"the geometry '{name[:50]}' has a polygon with holes, but not with one outline")
                holes[len(rings)] = [self.ring(part, stride, offset, name) for part in each if kind_of(part) == "h"]
                rings.append(outline[0])
        inner = [ring for each in holes.values() for ring in each]
        all_corners = np.concatenate([*rings, *inner, np.zeros(0, np.int64)])
        if len(all_corners) and not (all_corners.min() >= 0 and all_corners.max() < len(points)):
            self.refuse(f"the geometry '{name[:50]}' has a corner at a vertex beyond its {len(points):,}")
        if kind in ("tristrips", "trifans"):
            self.compare(surface, len(rings), name)
            if kind == "tristrips":
                return np.concatenate([*(strip_triangles(ring) for ring in rings), np.zeros((0, 3), np.int64)])
            fans = [np.stack([np.full(len(r) - 2, r[0]), r[1:-1], r[2:]], axis=1) for r in rings if len(r) > 2]
            return np.concatenate([*fans, np.zeros((0, 3), np.int64)])
        if kind == "triangles":
            if len(all_corners) % 3:
                self.refuse(f"the geometry '{name[:50]}' has {len(all_corners):,} corners, not a multiple of 3")
            self.compare(surface, len(all_corners) // 3, name)
            return all_corners.reshape(-1, 3)
        if kind == "polylist":
            listed = next((each for each in surface if kind_of(each) == "vcount"), None)
            sizes = self.integers(listed, name) if listed is not None else np.zeros(0, np.int64)
            if (sizes < 0).any() or sizes.sum() != len(all_corners):
                self.refuse(
                    f"the geometry '{name[:50]}' has {len(all_corners):,} corners, and its <vcount> {sizes.sum():,}"
                )
        else:
            sizes = np.array([len(ring) for ring in rings], np.int64)
        self.compare(surface, len(sizes), name)
        corners = np.concatenate([*rings, np.zeros(0, np.int64)])
        small = np.flatnonzero(sizes < 3)
        if len(small):
            self.remarks.append(too_few_corners(len(small)))
            if holes:
                self.refuse(f"the geometry '{name[:50]}' has a polygon of fewer than three corners")
            corners, sizes = corners[np.repeat(sizes >= 3, sizes)], sizes[sizes >= 3]
        cut = cut_polygons(points, corners, sizes, holes=holes)
        starts: NDArray[np.int64] = np.cumsum(sizes) - sizes
        for remark in cut.remarks(points, corners, starts):
            self.remark(remark.kind, f"in the geometry '{name[:50]}', {remark.problem}", remark.remedy)
        return cut.faces

    def compare(self, surface: Element, number: int, name: str) -> None:
        """Warn if the count differs from the one that the file states."""
        said = self.number(surface.get("count", str(number)), name)
        if said != number:
            self.remark(
                "count",
                f"the geometry '{name[:50]}' states {said:,} in <{kind_of(surface)}>, and has {number:,}: "
                "all of these are read",
                "export the scene again, and check that it is complete",
            )

    def ring(self, element: Element, stride: int, offset: int, name: str) -> NDArray[np.int64]:
        """Vertices of a list of corners."""
        numbers = self.integers(element, name)
        if len(numbers) % stride:
            self.refuse(f"the geometry '{name[:50]}' has {len(numbers):,} indices, no multiple of {stride}")
        return numbers[offset::stride]

    def floats(self, element: Element, name: str) -> NDArray[np.float64]:
        try:
            return np.array((element.text or "").split(), np.float64)
        except ValueError as error:
            self.refuse(f"the geometry '{name[:50]}': {str(error)[:80]}")

    def integers(self, element: Element, name: str) -> NDArray[np.int64]:
        try:
            return np.array((element.text or "").split(), np.int64)
        except (ValueError, OverflowError) as error:
            self.refuse(f"the geometry '{name[:50]}': {str(error)[:80]}")

    def number(self, text: str, name: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = -1
        if not 0 <= value < 2**31:
            self.refuse(f"the geometry '{name[:50]}' has '{text[:20]}' where a whole number belongs")
        return value
