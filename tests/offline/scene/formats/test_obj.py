"""Wavefront OBJ as all kinds of programs write it."""

from pathlib import Path

import numpy as np
import pytest

from rayfix_offline.scene.scene import load_scene
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_tables.errors import SceneError
from tests.support.messages.refusals import refusal
from tests.support.scenes.polygon_scene import FREE_VOLUME, Polygon, hall, partition

SITE = '[site]\nname = "a"\nscene = "{}"\n[[stations]]\nid = "s"\nposition_m = [0.4, 0.4, 2.6]\n'
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def obj_of(objects: dict[str, list[Polygon]], *, relative: bool = False) -> str:
    """Write every polygon with corners of its own."""
    lines, count = [], 0
    for name, polygons in objects.items():
        lines.append(f"o {name}")
        for ring in polygons:
            lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in ring.tolist()]
            first = -len(ring) if relative else count + 1
            lines.append("f " + " ".join(f"{first + k}/1/1" for k in range(len(ring))))
            count += len(ring)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("first", [0, 3])
def test_a_doorway_stays_open(first: int, relative: bool, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(obj_of({"hall": hall(), "wall": partition(first=first)}, relative=relative))
    (tmp_path / "site.toml").write_text(SITE.format("a.obj"))
    twin = prepare_twin(read_site(tmp_path / "site.toml"), tmp_path)
    assert [finding.kind for finding in twin.findings] == ["thin partition"]
    assert twin.scene.objects == ("hall", "wall")
    # Voxels of 0.25 m at most: the partition is thinner.
    assert len(twin.scene.faces) == 12 + 2 * 6 + 8 * 2
    solid = [np.einsum("i,i->", t[0], np.cross(t[1], t[2])) / 6.0 for t in twin.scene.triangles]
    assert abs(sum(solid)) == pytest.approx(FREE_VOLUME, rel=1e-12)


def test_groups_are_objects_and_come_back(tmp_path: Path) -> None:
    text = f"{TRIANGLE}o house\ng walls\nf 1 2 3\ng roof\nf 1 2 3\ng walls\nf 3 2 1\ng\nf 1 3 2\no shed\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(text)
    scene = load_scene(tmp_path / "a.obj")
    assert scene.objects == ("house", "house/walls", "house/roof", "shed")
    assert np.bincount(scene.face_objects).tolist() == [1, 2, 1, 1]


NAMED = f"mtllib {{}}\n{TRIANGLE}usemtl itu_metal\nf 1 2 3\nusemtl\titu_wood \nf 3 2 1\n"


@pytest.mark.parametrize(
    ("line", "file", "missing"),
    [
        ("a.mtl", "a.mtl", None),
        ("none.mtl", "a.mtl", "'none.mtl'"),
        ("a.mtl b.mtl", "a.mtl", "'b.mtl'"),
        ("my house.mtl", "my house.mtl", None),
        (r"C:\Users\me\house.mtl", "house.mtl", None),
        ("\ta.mtl\t", "a.mtl", None),
    ],
)
def test_materials_are_those_of_usemtl(line: str, file: str, missing: str | None, tmp_path: Path) -> None:
    (tmp_path / file).write_bytes(b"\xef\xbb\xbfnewmtl \xff\n")
    (tmp_path / "a.obj").write_text(NAMED.format(line))
    scene = load_scene(tmp_path / "a.obj")
    assert [scene.materials[k] for k in scene.face_materials] == ["itu_metal", "itu_wood"]
    told = [remark.problem for remark in scene.remarks]
    assert len(told) == (missing is not None)
    assert all(str(missing) in problem for problem in told)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252", "latin-1"])
def test_encodings(encoding: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(f"# Prüfung\no Träger\n{TRIANGLE}usemtl Stahlträger\nf 1 2 3\n".encode(encoding))
    scene = load_scene(tmp_path / "a.obj")
    assert (scene.objects, scene.materials, scene.remarks) == (("Träger",), ("Stahlträger",), ())


@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_ends_of_lines(end: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes((TRIANGLE + "f 1 2 \\\n3\n").replace("\n", end).encode())
    assert len(load_scene(tmp_path / "a.obj").faces) == 1


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("l 1 2", "1 line"),
        ("p 1", "1 point element"),
        ("f 1 2", "1 face of fewer than three corners"),
        ("vertex 1 2 3", "1 line of the file that begins with 'vertex'"),
    ],
)
def test_what_is_left_out_is_told(line: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(f"{TRIANGLE}f 1 2 3\n{line}\n")
    scene = load_scene(tmp_path / "a.obj")
    assert len(scene.faces) == 1
    assert told in scene.remarks[0].problem


@pytest.mark.parametrize(
    "line", ["f 1 2 0", "f 1 2 -4", "f 1 2 4", "f 1 2 x", "f 1 2 1.5", "v 1 2", "v 1 2 0,5", "surf 0 1"]
)
def test_what_cannot_be_read_is_refused_with_its_line(line: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(f"{TRIANGLE}f 1 2 3\n{line}\n")
    message = refusal(SceneError, load_scene, tmp_path / "a.obj")
    assert "line 5" in message or "vertex 4" in message
