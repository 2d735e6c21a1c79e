"""Scene files read a second time, plainly and slowly, by code that shares nothing with the readers under test.

Each reader takes what the small files of the tests have, and raises whatever comes up for anything else.
"""

import json
import re
import struct
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

Polygon = NDArray[np.float64]


class UnreadError(Exception):
    """The file holds something that has no place in a list of polygons."""


def text_of(content: bytes) -> str:
    """Decode by byte order mark, else byte for byte."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16")
    return content.removeprefix(b"\xef\xbb\xbf").decode("latin-1")


def read_obj(path: Path) -> list[Polygon]:
    """Read ``v`` and ``f``."""
    points: list[list[float]] = []
    rings: list[list[int]] = []
    for line in text_of(path.read_bytes()).replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            points.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            numbers = [int(word.split("/")[0]) for word in words[1:]]
            rings.append([n - 1 if n > 0 else len(points) + n for n in numbers])
            if 0 in numbers or min(rings[-1]) < 0:
                raise UnreadError("no such vertex")
        elif words[:1] in (["l"], ["p"]):
            raise UnreadError("no surface")
    return [np.array([points[k] for k in ring]) for ring in rings]


def read_ply(path: Path) -> list[Polygon]:
    """Read vertices of x, y, z and faces of one list."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    words = head.decode("latin-1").split()
    form = words[words.index("format") + 1]
    counts = {words[k + 1]: int(words[k + 2]) for k, word in enumerate(words) if word == "element"}
    if form == "ascii":
        numbers = [float(word) for word in body.split()]
        points = np.array(numbers[: 3 * counts["vertex"]]).reshape(-1, 3)
        at, rings = 3 * counts["vertex"], []
        for _ in range(counts["face"]):
            size = int(numbers[at])
            rings.append([int(n) for n in numbers[at + 1 : at + 1 + size]])
            at += 1 + size
        if at != len(numbers):
            raise UnreadError("another length")
    else:
        order = "<" if "little" in form else ">"
        points = np.frombuffer(body, f"{order}f8", 3 * counts["vertex"]).reshape(-1, 3)
        at, rings = 24 * counts["vertex"], []
        for _ in range(counts["face"]):
            size = body[at]
            rings.append(list(struct.unpack_from(f"{order}{size}i", body, at + 1)))
            at += 1 + 4 * size
        if at != len(body):
            raise UnreadError("another length")
    if any(k < 0 for ring in rings for k in ring):
        raise UnreadError("no such vertex")
    return [np.array([points[k] for k in ring]) for ring in rings]


def read_stl(path: Path) -> list[Polygon]:
    """Read binary records, or all lines that begin with ``vertex``."""
    content = path.read_bytes()
    if b"facet" in content[:300] or content[:2] == b"\xff\xfe":
        text = text_of(content)
        if len(re.findall(r"^\s*endfacet", text, re.MULTILINE)) * 3 != len(
            re.findall(r"^\s*vertex", text, re.MULTILINE)
        ):
            raise UnreadError("cut off")
        if "endsolid" not in text:
            raise UnreadError("no end")
        numbers = [float(v) for line in re.findall(r"^\s*vertex (.*)$", text, re.MULTILINE) for v in line.split()]
        return list(np.array(numbers).reshape(-1, 3, 3))
    (count,) = struct.unpack_from("<I", content, 80)
    if len(content) != 84 + 50 * count:
        raise UnreadError("another count")
    return [np.array(struct.unpack_from("<9f", content, 84 + 50 * k + 12)).reshape(3, 3) for k in range(count)]


def read_dae(path: Path) -> list[Polygon]:
    """Read the polygons of all nodes, which may be shifted."""
    root = ElementTree.fromstring(path.read_bytes())
    for each in root.iter():
        each.tag = each.tag.rpartition("}")[2]
    found: list[Polygon] = []
    shown = set()
    scale = float(root.find("asset/unit").get("meter"))  # type: ignore[union-attr, arg-type]
    for node in root.iter("node"):
        for instance in node.iter("instance_geometry"):
            (mesh,) = [g[0] for g in root.iter("geometry") if "#" + g.get("id", "") == instance.get("url")]
            shown.add(instance.get("url"))
            shift = [float(v) for v in (node.findtext("translate") or "0 0 0").split()]
            points = np.array([float(v) for v in (mesh.findtext("source/float_array") or "").split()]).reshape(-1, 3)
            for surface in mesh:
                if surface.tag in ("lines", "linestrips", "points"):
                    raise UnreadError("no surface")
                if surface.tag not in ("polylist", "triangles", "polygons"):
                    continue
                source = surface.find("input").get("source")  # type: ignore[union-attr]
                if source != "#" + mesh.find("vertices").get("id"):  # type: ignore[union-attr, operator]
                    raise UnreadError("no such source")
                lists = [[int(v) for v in (p.text or "").split()] for p in surface.findall("p")]
                if surface.tag == "triangles":
                    sizes = [3] * (len(lists[0]) // 3)
                elif surface.tag == "polylist":
                    sizes = [int(v) for v in (surface.findtext("vcount") or "").split()]
                else:
                    sizes = [len(each) for each in lists]
                corners = [k for each in lists for k in each]
                if sum(sizes) != len(corners) or int(surface.get("count", "0")) != len(sizes) or min(corners) < 0:
                    raise UnreadError("another count")
                for size in sizes:
                    found.append((points[corners[:size]] + shift) * scale)
                    corners = corners[size:]
    if len(shown) != len(list(root.iter("geometry"))):
        raise UnreadError("not shown")
    return found


KINDS = {5120: "b", 5121: "B", 5122: "h", 5123: "H", 5125: "I", 5126: "f"}
LARGEST = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}


def read_glb(path: Path) -> list[Polygon]:
    """Read triangles of the scene's nodes, which may be shifted, scaled and instanced by shifts."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    binary = content[28 + length :]
    if document.get("extensionsRequired", []) not in ([], ["EXT_mesh_gpu_instancing"], ["KHR_mesh_quantization"]):
        raise UnreadError("an extension")

    def view(number: int, offset: int, kind: int, width: int, count: int) -> list[tuple[float, ...]]:
        entry = document["bufferViews"][number]
        size = struct.calcsize(KINDS[kind]) * width
        step = entry.get("byteStride", size)
        if offset + step * (count - 1) + size > entry["byteLength"]:
            raise UnreadError("too short")
        at = entry["byteOffset"] + offset
        return [struct.unpack_from(f"<{width}{KINDS[kind]}", binary, at + k * step) for k in range(count)]

    def accessor(number: int) -> NDArray[np.float64]:
        entry = document["accessors"][number]
        kind, count = entry["componentType"], entry["count"]
        width = {"SCALAR": 1, "VEC3": 3}[entry["type"]]
        values = view(entry["bufferView"], entry.get("byteOffset", 0), kind, width, count)
        if "sparse" in entry:
            some = entry["sparse"]
            at = view(some["indices"]["bufferView"], 0, some["indices"]["componentType"], 1, some["count"])
            new = view(some["values"]["bufferView"], 0, kind, width, some["count"])
            for (k,), value in zip(at, new, strict=True):
                values[int(k)] = value
        scale = LARGEST[kind] if entry.get("normalized") else 1.0
        return np.array(values) / scale

    found: list[Polygon] = []
    shown = set()

    def visit(number: int, shift: NDArray[np.float64], scale: NDArray[np.float64]) -> None:
        node = document["nodes"][number]
        shown.add(number)
        shift = shift + scale * node.get("translation", (0, 0, 0))
        scale = scale * node.get("scale", (1, 1, 1))
        if "matrix" in node:
            shift, scale = (
                shift + scale * node["matrix"][12:15],
                scale * np.diag(np.reshape(node["matrix"], (4, 4)))[:3],
            )
        places = np.zeros((1, 3))
        for name, extension in node.get("extensions", {}).items():
            if name != "EXT_mesh_gpu_instancing":
                raise UnreadError("an extension")
            places = accessor(extension["attributes"]["TRANSLATION"])
        for primitive in document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            points = accessor(primitive["attributes"]["POSITION"])
            corners = [int(k) for k in accessor(primitive["indices"]).reshape(-1)]
            mode = primitive.get("mode", 4)
            if mode == 4 and len(corners) % 3:
                raise UnreadError("another count")
            faces = {
                4: [corners[k : k + 3] for k in range(0, len(corners), 3)],
                5: [corners[k : k + 3][:: 1 if k % 2 == 0 else -1] for k in range(len(corners) - 2)],
                6: [[corners[0], *corners[k : k + 2]] for k in range(1, len(corners) - 1)],
            }[mode]
            found.extend(shift + scale * (points[face] + place) for place in places for face in faces)
        for child in node.get("children", []):
            visit(child, shift, scale)

    for root in document["scenes"][0]["nodes"]:
        visit(root, np.zeros(3), np.ones(3))
    if any("mesh" in node and n not in shown for n, node in enumerate(document["nodes"])):
        raise UnreadError("not shown")
    if {node.get("mesh") for node in document["nodes"]} - {None} != set(range(len(document["meshes"]))):
        raise UnreadError("not shown")
    return found


def read_xml(path: Path) -> list[Polygon]:
    """Read the shapes of a Mitsuba scene, each shifted."""
    found: list[Polygon] = []
    for shape in ElementTree.fromstring(path.read_bytes().removeprefix(b"\xef\xbb\xbf")).iter("shape"):
        move: Any = shape.find("transform/translate")
        shift = [float(move.get(axis)) for axis in "xyz"]
        name: Any = shape.find("string")
        found += [ring + shift for ring in read_ply(path.parent / name.get("value"))]
    return found


def read_ifc(path: Path) -> list[Polygon]:
    """Read extruded rectangles, each as the six sides of its box."""
    text = path.read_bytes().removeprefix(b"\xef\xbb\xbf").decode("latin-1").partition("END-ISO-10303-21;")[0]
    lines = dict(re.findall(r"^#(\d+)=(.*);", text, re.MULTILINE))

    def of(number: str, kind: str) -> list[str]:
        name, _, rest = lines[number].partition("(")
        if name != kind:
            raise UnreadError(f"no {kind}")
        return [word.strip("#'() ") for word in rest.split(",")]

    found: list[Polygon] = []
    for each in [line for line in lines.values() if re.match(r"IFC(WALL|SLAB)\(", line)]:
        words = [word.strip("#'() ") for word in each.split(",")]
        placement, shape = words[5], words[6]
        point = of(of(of(placement, "IFCLOCALPLACEMENT")[1], "IFCAXIS2PLACEMENT3D")[0], "IFCCARTESIANPOINT")
        solid = of(of(of(shape, "IFCPRODUCTDEFINITIONSHAPE")[2], "IFCSHAPEREPRESENTATION")[3], "IFCEXTRUDEDAREASOLID")
        profile = of(solid[0], "IFCRECTANGLEPROFILEDEF")
        width, depth, height = float(profile[3]), float(profile[4]), float(solid[3])
        if not min(width, depth, height) > 0.0:
            raise UnreadError("no body")
        x, y, z = (float(v) for v in point)
        low, high = np.array([x - width / 2, y - depth / 2, z]), np.array([x + width / 2, y + depth / 2, z + height])
        found += box_sides(low, high)
    return found


def box_sides(low: NDArray[np.float64], high: NDArray[np.float64]) -> list[Polygon]:
    """Six quadrilaterals of a box that face outwards."""
    ends = (low, high)
    corners = np.array([[ends[(k >> axis) & 1][axis] for axis in range(3)] for k in range(8)])
    rings = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return [corners[list(ring)] for ring in rings]
