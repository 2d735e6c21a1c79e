"""Small valid scenes in every format, and random small edits of them."""

import re
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.scenes.collada_files import document, geometry, polygons_of, polylist, source_of, triangles_of
from tests.support.scenes.gltf_files import GltfFile, box_arrays
from tests.support.scenes.polygon_scene import Polygon, hall, indexed, partition

Rng = np.random.Generator
Edit = Callable[[str, Rng], str]

CRATE = ((1.0, 1.0, 0.0), (2.0, 2.5, 1.0))


def pick(found: Sequence[Any], rng: Rng) -> Any:
    """Choose one."""
    return found[int(rng.integers(len(found)))]


def in_a_line(begin: str, change: Callable[[list[str], Rng], list[str]]) -> Edit:
    """Return an edit of the words of a random line that begins so."""

    def edit(text: str, rng: Rng) -> str:
        lines = text.split("\n")
        number = pick([n for n, line in enumerate(lines) if line.startswith(begin)], rng)
        lines[number] = " ".join(change(lines[number].split(" "), rng))
        return "\n".join(line for n, line in enumerate(lines) if line or n != number)

    return edit


def replaced(pattern: str, new: str | Callable[[re.Match[str], Rng], str]) -> Edit:
    """Return an edit of a random match of a pattern."""

    def edit(text: str, rng: Rng) -> str:
        found = pick(list(re.finditer(pattern, text)), rng)
        return text[: found.start()] + (new if isinstance(new, str) else new(found, rng)) + text[found.end() :]

    return edit


def everywhere(old: str, new: str) -> Edit:
    """Return an edit of all places of a text."""
    return lambda text, rng: text.replace(old, new)


def _flip(words: list[str], rng: Rng) -> list[str]:
    k = int(rng.integers(1, len(words)))
    return [*words[:k], f"-{words[k]}".replace("--", ""), *words[k + 1 :]]


def _drop(words: list[str], rng: Rng) -> list[str]:
    k = int(rng.integers(1, len(words)))
    return [*words[:k], *words[k + 1 :]]


def _remove(words: list[str], rng: Rng) -> list[str]:
    return []


def _repeat(words: list[str], rng: Rng) -> list[str]:
    k = int(rng.integers(1, len(words)))
    return [*words[:k], words[k], *words[k:]]


def _far(words: list[str], rng: Rng) -> list[str]:
    return [*words[:-1], "9999"]


def _turn(words: list[str], rng: Rng) -> list[str]:
    k = int(rng.integers(1, len(words)))
    return [words[0], *words[k:], *words[1:k]]


HIGHER = everywhere("3.0", "4.5")
"""All corners of the ceiling are moved; what was flat stays so."""


def obj_text() -> str:
    """Write hall, partition and a crate."""
    lines, count = ["mtllib a.mtl"], 0
    for name, polygons in (("hall", hall()), ("wall", partition()), ("roof", hall())):
        points, rings = indexed(polygons)
        lines += [f"o {name}", *(f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()), "usemtl itu_wood"]
        lines += ["f " + " ".join(str(count + k + 1) for k in ring) for ring in rings]
        count += len(points)
    return "\n".join(lines) + "\n"


def _relative(text: str, rng: Rng) -> str:
    lines, count = [], 0
    for line in text.split("\n"):
        count += line.startswith("v ")
        words = line.split()
        if words[:1] == ["f"] and all("-" not in word for word in words):
            words = ["f", *(str(int(word) - 1 - count) for word in words[1:])]
            line = " ".join(words)
        lines.append(line)
    return "\n".join(lines)


OBJ_EDITS: dict[str, Edit] = {
    "all relative": _relative,
    "sign flipped": in_a_line("f ", _flip),
    "corner dropped": in_a_line("f ", _drop),
    "corner repeated": in_a_line("f ", _repeat),
    "face removed": in_a_line("f ", _remove),
    "vertex removed": in_a_line("v ", _remove),
    "index too large": in_a_line("f ", _far),
    "ring turned": in_a_line("f ", _turn),
    "line added": lambda text, rng: text + "l 1 2\n",
    "number cut": in_a_line("v ", lambda words, rng: words[:-1]),
    "word for a number": in_a_line("v ", lambda words, rng: [*words[:-1], "x"]),
    "object removed": in_a_line("o ", _remove),
    "library removed": in_a_line("mtllib", _remove),
    "texture corners": everywhere("f 1 ", "f 1/1/1 "),
    "higher": HIGHER,
    "comment": lambda text, rng: f"# Prüfung {rng.integers(100)}\n{text}",
    "continued": replaced(r"(?<=f )", "\\\n"),
}


def ply_bytes(form: str, rng: Rng, name: str | None) -> bytes:
    """Write hall and partition, edited."""
    points, rings = indexed([*hall(), *partition()])
    numbers = [len(points), len(rings)]
    if name == "count":
        numbers[int(rng.integers(2))] += int(pick([-2, -1, 1, 2], rng))
    elif name == "face removed":
        del rings[int(rng.integers(len(rings)))]
        numbers[1] -= 1
    elif name == "sign flipped":
        ring = pick(rings, rng)
        ring[int(rng.integers(len(ring)))] *= -1
    elif name == "index too large":
        pick(rings, rng)[0] = 99
    elif name == "ring turned":
        k = int(rng.integers(len(rings)))
        rings[k] = rings[k][1:] + rings[k][:1]
    elif name == "higher":
        points[points[:, 2] == 3.0, 2] = 4.5
    elif name == "size changed":
        k = int(rng.integers(len(rings)))
        rings[k] = rings[k][:-1] if rng.integers(2) else [*rings[k], rings[k][-1]]
    comment = "Prüfung".encode("cp1252") if name == "encoding" else b"test"
    head = (
        f"ply\nformat {form} 1.0\nelement vertex {numbers[0]}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {numbers[1]}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    head = head.replace(b"\nelement", b"\ncomment " + comment + b"\nelement", 1)
    if form == "ascii":
        lines = [" ".join(map(repr, point)) for point in points.tolist()]
        lines += [" ".join(map(str, [len(ring), *ring])) for ring in rings]
        body = ("\n".join(lines) + "\n").encode()
    else:
        order = "<" if "little" in form else ">"
        body = b"".join(struct.pack(f"{order}3d", *point) for point in points)
        body += b"".join(struct.pack(f"{order}B{len(ring)}i", len(ring), *ring) for ring in rings)
    if name == "cut off":
        body = body[: int(rng.integers(len(body) // 2, len(body) - 1))]
    return head + body


PLY_EDITS = (
    "count",
    "face removed",
    "sign flipped",
    "index too large",
    "ring turned",
    "higher",
    "size changed",
    "encoding",
    "cut off",
)


def write_obj(path: Path, rng: Rng, name: str | None) -> None:
    """Write an edited OBJ file, in a random encoding and with random ends of lines."""
    text = obj_text() if name is None else OBJ_EDITS[name](obj_text(), rng)
    encoding = "utf-8" if name is None else pick(["utf-8", "utf-8-sig", "cp1252", "utf-16"], rng)
    path.write_bytes(text.replace("\n", "\n" if name is None else pick(["\n", "\r\n"], rng)).encode(encoding))
    (path.parent / "a.mtl").write_text("newmtl itu_wood\n")


def write_ply(path: Path, rng: Rng, name: str | None) -> None:
    """Write an edited PLY file in a random format."""
    path.write_bytes(ply_bytes(pick(["ascii", "binary_little_endian", "binary_big_endian"], rng), rng, name))


def write_stl(path: Path, rng: Rng, name: str | None) -> None:
    """Write an edited STL file, binary or as text."""
    points, faces = box_arrays((0, 0, 0), (10, 6, 3))
    others, more = box_arrays(*CRATE)
    triangles = [*points[faces], *others[more]]
    if name == "triangle removed":
        del triangles[int(rng.integers(len(triangles)))]
    elif name == "triangle turned":
        k = int(rng.integers(len(triangles)))
        triangles[k] = triangles[k][::-1]
    if rng.integers(2):
        count = len(triangles) + (int(pick([-24, -2, -1, 1, 2], rng)) if name == "count" else 0)
        content = "solid Prüfung".encode("cp1252").ljust(80) + struct.pack("<I", max(count, 0))
        content += b"".join(bytes(12) + t.astype("<f4").tobytes() + bytes(2) for t in triangles)
    else:
        lines = ["solid Prüfung"]
        for t in triangles:
            lines += ["facet normal 0 0 0", "outer loop", *("vertex {} {} {}".format(*c) for c in t.tolist())]
            lines += ["endloop", "endfacet"]
        if name == "count":
            del lines[int(rng.integers(1, len(lines)))]
        content = "\n".join([*lines, "endsolid"]).encode(pick(["utf-8", "cp1252", "utf-16"], rng))
    if name == "cut off":
        content = content[: int(rng.integers(len(content) // 2, len(content) - 12))]
    elif name == "more behind" and b"\0" in content[84:]:
        content += b"note" if content[:2] != b"\xff\xfe" else "\nendsolid".encode("utf-16-le")
    path.write_bytes(content)


STL_EDITS = ("triangle removed", "triangle turned", "count", "cut off", "more behind", "encoding")


def dae_text(rng: Rng) -> str:
    """Write hall and partition, as polygons of a random kind."""
    parts = []
    for name, polygons, kinds in (
        ("hall", hall(), (polylist, polygons_of, triangles_of)),
        ("wall", partition(), (polylist, polygons_of)),
    ):
        source, rings = source_of(name, polygons)
        parts.append(geometry(name, source + pick(kinds, rng)(name, rings)))
    nodes = "".join(
        f'<node id="{name}"><translate>{x} 0 0</translate><instance_geometry url="#{name}"/></node>'
        for name, x in (("hall", 0), ("wall", 1))
    )
    return document("".join(parts), nodes)


def _one_number(found: re.Match[str], rng: Rng) -> str:
    words = found[0].split()
    k = int(rng.integers(len(words)))
    words[k] = pick([f"-{words[k]}", "99", str((int(words[k]) + 1) % 8)], rng)
    return " ".join(words)


DAE_EDITS: dict[str, Edit] = {
    "index changed": replaced(r"(?<=<p>)[\d ]+(?=</p>)", _one_number),
    "index dropped": replaced(r"(?<=<p>)\d+ ", ""),
    "count changed": replaced(
        r'(?<=<poly)(list|gons) count="\d+"', lambda m, rng: f'{m[1]} count="{rng.integers(20)}"'
    ),
    "node removed": replaced(r"<node id.*?</node>", ""),
    "geometry removed": replaced(r"<geometry.*?</geometry>", ""),
    "source renamed": replaced(r'source="#\w+-(v|p|pa)"', 'source="#none"'),
    "lines added": replaced(r"(?=</mesh>)", '<linestrips count="1"><p>0 1</p></linestrips>'),
    "moved": replaced(r"<translate>\d", "<translate>7"),
    "unit": everywhere('meter="1"', 'meter="0.0254"'),
    "higher": HIGHER,
    "url changed": replaced(r'url="#(hall|wall)"', 'url="#hall"'),
    "comment": replaced(r"(?=<library)", "<!-- Prüfung -->"),
}


def write_dae(path: Path, rng: Rng, name: str | None) -> None:
    """Write an edited COLLADA file."""
    text = dae_text(rng)
    text = text if name is None else DAE_EDITS[name](text, rng)
    encoding = pick(["utf-8", "utf-8-sig", "iso-8859-1"], rng)
    path.write_bytes(text.replace('encoding="utf-8"', f'encoding="{encoding.removesuffix("-sig")}"').encode(encoding))


def _made_sparse(file: GltfFile, rng: Rng) -> None:
    number = pick([0, 2], rng)
    points, _ = box_arrays(*(((0, 0, 0), (10, 6, 3)) if number == 0 else CRATE))
    points[4:, 2] += 1.0
    entry = file.document["accessors"][number]
    entry["sparse"] = {
        "count": 4,
        "indices": {"bufferView": file.view(np.arange(4, 8).astype(np.uint16).tobytes()), "componentType": 5123},
        "values": {"bufferView": file.view(points[4:].tobytes())},
    }


def _quantised(file: GltfFile, rng: Rng) -> None:
    points = np.where(box_arrays((0, 0, 0), (1, 1, 1))[0] > 0.5, 32767, 0).astype(np.int16)
    file.document["accessors"][2] |= {
        "componentType": 5122,
        "bufferView": file.view(points.tobytes()),
        "normalized": True,
    }
    file.document["nodes"][1]["scale"] = [1.5, 1.0, 0.5]
    file.document["extensionsRequired"] = ["KHR_mesh_quantization"]


def _instanced(file: GltfFile, rng: Rng) -> None:
    places = np.arange(3 * int(rng.integers(1, 6)), dtype=np.float32).reshape(-1, 3)
    extension = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": file.accessor(places)}}}
    file.document["nodes"][1]["extensions"] = extension
    file.document["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]


def _extended(file: GltfFile, rng: Rng) -> None:
    node = pick(file.document["nodes"], rng)
    node["extensions"] = {"ACME_clones": {"count": 3}}
    if rng.integers(2):
        file.document["extensionsRequired"] = ["ACME_clones"]


def _fanned(file: GltfFile, rng: Rng) -> None:
    primitive = file.document["meshes"][1]["primitives"][0]
    primitive["mode"] = pick([5, 6], rng)
    primitive["indices"] = file.accessor(np.array([0, 1, 3, 2, 6], np.uint8))


def _number(file: GltfFile, rng: Rng) -> None:
    entry = pick(file.document["accessors"] + file.document["bufferViews"], rng)
    key = pick([key for key in ("count", "byteLength", "byteOffset", "bufferView") if key in entry], rng)
    entry[key] = max(0, entry[key] + int(pick([-4, -1, 1, 3, 400], rng)))


def _hidden(file: GltfFile, rng: Rng) -> None:
    del file.document["scenes"][0]["nodes"][int(rng.integers(2))]


def _below_camera(file: GltfFile, rng: Rng) -> None:
    file.document["scenes"][0]["nodes"] = [0]
    file.document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]
    file.node(camera=0, children=[1], translation=[0.0, float(rng.integers(5)), 0.0])


def _matrix(file: GltfFile, rng: Rng) -> None:
    file.document["nodes"][1] |= {"matrix": [2.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 3, 0, 1, 2, 0, 1]}
    del file.document["nodes"][1]["translation"]


def _no_data(file: GltfFile, rng: Rng) -> None:
    del pick(file.document["accessors"], rng)["bufferView"]


GLB_EDITS: dict[str, Callable[[GltfFile, Rng], None]] = {
    "made sparse": _made_sparse,
    "quantised": _quantised,
    "instanced": _instanced,
    "extended": _extended,
    "fan or strip": _fanned,
    "number changed": _number,
    "node hidden": _hidden,
    "below a camera": _below_camera,
    "matrix": _matrix,
    "no data": _no_data,
    "mesh unused": lambda file, rng: file.document["nodes"][1].update(mesh=0),
}


def write_glb(path: Path, rng: Rng, name: str | None) -> None:
    """Write an edited binary glTF file of a hall and a crate."""
    file = GltfFile()
    for low, high in (((0.0, 0.0, 0.0), (10.0, 6.0, 3.0)), CRATE):
        points, faces = box_arrays(low, high)
        kind = pick([np.uint8, np.uint16, np.uint32], rng)
        primitive = {
            "attributes": {"POSITION": file.accessor(points)},
            "indices": file.accessor(faces.reshape(-1).astype(kind)),
        }
        file.node(mesh=file.mesh([primitive]), translation=[1.0, 0.0, 0.0])
    if name is not None:
        GLB_EDITS[name](file, rng)
    file.write(path)


XML_EDITS: dict[str, Edit] = {
    "moved": replaced(r'x="\d"', 'x="-5"'),
    "shape removed": replaced(r"<shape.*?</shape>", ""),
    "shape repeated": replaced(r"<shape.*?</shape>", lambda m, rng: m[0] * 2),
    "file renamed": replaced(r"\w+\.ply", "none.ply"),
    "other type": replaced('type="ply"', 'type="sphere"'),
    "transform cut": replaced(r'<translate[^>]*y="0"', '<translate x="1" y="a"'),
    "comment": replaced(r"(?=<shape)", "<!-- Prüfung -->"),
}


def write_xml(path: Path, rng: Rng, name: str | None) -> None:
    """Write an edited Mitsuba scene; its mesh is edited too now and then."""
    inner = pick(PLY_EDITS, rng) if name == "comment" else None
    (path.parent / "whole.ply").write_bytes(ply_bytes("binary_little_endian", rng, inner))
    shape = (
        '<shape type="ply"><string name="filename" value="whole.ply"/><transform name="to_world">{}</transform></shape>'
    )
    text = "".join(shape.format(f'<translate x="{x}" y="0" z="0"/>') for x in (0, 5))
    text = f"<scene>{text}</scene>"
    text = text if name is None else XML_EDITS[name](text, rng)
    path.write_bytes(text.encode(pick(["utf-8", "utf-8-sig"], rng)))


def ifc_text() -> str:
    """Write four walls and two slabs, extruded rectangles in metres."""
    head = (
        "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\nFILE_NAME('a','2026-01-01T00:00:00',(''),(''),'','','');\n"
        "FILE_SCHEMA(('IFC4'));\nENDSEC;\nDATA;\n#1=IFCCARTESIANPOINT((0.,0.,0.));\n#2=IFCDIRECTION((0.,0.,1.));\n"
        "#3=IFCDIRECTION((1.,0.,0.));\n#4=IFCAXIS2PLACEMENT3D(#1,#2,#3);\n#5=IFCSIUNIT(*,.LENGTHUNIT.,$,.METRE.);\n"
        "#6=IFCUNITASSIGNMENT((#5));\n#7=IFCGEOMETRICREPRESENTATIONCONTEXT($,'Model',3,1.E-05,#4,$);\n"
        "#8=IFCPROJECT('0000000000000000000001',$,'P',$,$,$,$,(#7),#6);\n#9=IFCCARTESIANPOINT((0.,0.));\n"
        "#10=IFCAXIS2PLACEMENT2D(#9,$);\n"
    )
    boxes: list[tuple[float, ...]] = [
        (5, 0, 0, 10, 0.2, 3),
        (5, 6, 0, 10, 0.2, 3),
        (0, 3, 0, 0.2, 6, 3),
        (10, 3, 0, 0.2, 6, 3),
    ]
    boxes += [(5, 3, -0.2, 10, 6, 0.2), (5, 3, 3, 10, 6, 0.2)]
    lines = []
    for k, (x, y, z, width, depth, height) in enumerate(boxes):
        n = 100 + 10 * k
        kind = "IFCWALL" if k < 4 else "IFCSLAB"
        lines += [
            f"#{n}=IFCCARTESIANPOINT(({float(x)},{float(y)},{float(z)}));",
            f"#{n + 1}=IFCAXIS2PLACEMENT3D(#{n},#2,#3);",
            f"#{n + 2}=IFCLOCALPLACEMENT($,#{n + 1});",
            f"#{n + 3}=IFCRECTANGLEPROFILEDEF(.AREA.,$,#10,{float(width)},{float(depth)});",
            f"#{n + 4}=IFCEXTRUDEDAREASOLID(#{n + 3},#4,#2,{float(height)});",
            f"#{n + 5}=IFCSHAPEREPRESENTATION(#7,'Body','SweptSolid',(#{n + 4}));",
            f"#{n + 6}=IFCPRODUCTDEFINITIONSHAPE($,$,(#{n + 5}));",
            f"#{n + 7}={kind}('00000000000000000000{n}'{',$' * 2},$,$,#{n + 2},#{n + 6},$,$);".replace(
                "'00000000000000000000", "'0000000000000000000"
            ),
        ]
    return head + "\n".join(lines) + "\nENDSEC;\nEND-ISO-10303-21;\n"


IFC_EDITS: dict[str, Edit] = {
    "height": replaced(r"(?<=#2,)3\.0\)", lambda m, rng: f"{pick(['0.', '-1.', '5.0', '2.5'], rng)})"),
    "width": replaced(r"(?<=#10,)[\d.]+", lambda m, rng: pick(["0.", "1.5", "4.0"], rng)),
    "product removed": replaced(r"#\d+=IFC(WALL|SLAB)\(.*\n", ""),
    "solid removed": replaced(r"#\d+=IFCEXTRUDEDAREASOLID\(.*\n", ""),
    "profile removed": replaced(r"#\d+=IFCRECTANGLEPROFILEDEF\(.*\n", ""),
    "schema": everywhere("'IFC4'", "'IFC4X3'"),
    "comment behind": lambda text, rng: f"{text}/* Prüfung */\n",
    "end cut": everywhere("END-ISO-10303-21;\n", ""),
    "moved": replaced(r"IFCCARTESIANPOINT\(\(5\.0", "IFCCARTESIANPOINT((7.0"),
}


def write_ifc(path: Path, rng: Rng, name: str | None) -> None:
    """Write an edited IFC model."""
    text = ifc_text() if name is None else IFC_EDITS[name](ifc_text(), rng)
    path.write_bytes(text.encode(pick(["utf-8", "utf-8-sig"], rng)))


Writer = Callable[[Path, Rng, str | None], None]
FORMATS: dict[str, tuple[Writer, tuple[str, ...]]] = {
    "obj": (write_obj, tuple(OBJ_EDITS)),
    "ply": (write_ply, PLY_EDITS),
    "stl": (write_stl, STL_EDITS),
    "dae": (write_dae, tuple(DAE_EDITS)),
    "glb": (write_glb, tuple(GLB_EDITS)),
    "xml": (write_xml, tuple(XML_EDITS)),
    "ifc": (write_ifc, tuple(IFC_EDITS)),
}
"""How to write a file of each format, and the names of the edits; None is the file as it should be."""

__all__ = ["FORMATS", "Polygon", "Writer"]
