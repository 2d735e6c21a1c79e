"""PLY and STL as all kinds of programs write them."""

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_offline.scene.scene import load_scene
from rayfix_tables.errors import SceneError
from tests.support.messages.refusals import refusal
from tests.support.scenes.polygon_scene import PARTITION_VOLUME, indexed, partition

FORMATS = ["ascii", "binary_little_endian", "binary_big_endian"]


def signed_volume(triangles: NDArray[np.float64]) -> float:
    return float(np.einsum("ij,ij->", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6.0)


def ply_of(form: str, *, comment: bytes = b"", number: int | None = None, list_name: str = "vertex_indices") -> bytes:
    """Write the partition: faces of four and of eight corners, with a quality behind each."""
    points, rings = indexed(partition())
    head = (
        f"ply\nformat {form} 1.0\nelement vertex {len(points)}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(rings) if number is None else number}\n"
        f"property list uchar int {list_name}\nproperty float quality\nend_header\n"
    ).encode()
    head = head.replace(b"\nelement vertex", b"\ncomment " + comment + b"\nelement vertex", 1)
    if form == "ascii":
        lines = [" ".join(map(repr, point)) for point in points.tolist()]
        lines += [" ".join(map(str, [len(ring), *ring, 0.5])) for ring in rings]
        return head + ("\n".join(lines) + "\n").encode()
    order = "<" if "little" in form else ">"
    body = b"".join(struct.pack(f"{order}3d", *point) for point in points)
    body += b"".join(struct.pack(f"{order}B{len(ring)}if", len(ring), *ring, 0.5) for ring in rings)
    return head + body


@pytest.mark.parametrize("list_name", ["vertex_indices", "vertex_index"])
@pytest.mark.parametrize("form", FORMATS)
def test_polygons_of_different_size(form: str, list_name: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply_of(form, comment="Prüfung".encode("cp1252"), list_name=list_name))
    scene = load_scene(tmp_path / "a.ply")
    assert len(scene.faces) == 2 * 6 + 8 * 2
    assert signed_volume(scene.triangles) == pytest.approx(PARTITION_VOLUME, rel=1e-12)
    assert scene.remarks == ()


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("number", [3, 9, 11, 1000])
def test_a_wrong_number_of_faces_is_refused(number: int, form: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply_of(form, number=number))
    message = refusal(SceneError, load_scene, tmp_path / "a.ply")
    assert ("more than its header states" in message) == (number < 10)
    assert ("it ends within" in message) == (number > 10)


def test_strips_of_triangles(tmp_path: Path) -> None:
    """A strip of four corners and one of three: three triangles that face the same way."""
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
        "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0\n1 1 0\n2 0 0\n8 0 1 2 3 -1 1 4 3\n"
    )
    triangles = load_scene(tmp_path / "a.ply").triangles
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    np.testing.assert_allclose(normals, np.tile((0.0, 0.0, 1.0), (3, 1)), rtol=0, atol=1e-12)


def test_indices_beyond_the_vertices_are_refused(tmp_path: Path) -> None:
    text = ply_of("ascii").decode().replace("4 0 ", "4 99 ", 1).replace("8 0 ", "8 99 ", 1)
    (tmp_path / "a.ply").write_text(text)
    assert "a vertex beyond its" in refusal(SceneError, load_scene, tmp_path / "a.ply")


TRIANGLES = np.array(
    [[(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 0, 0), (0, 1, 0), (0, 0, 1)], [(0, 0, 0), (0, 0, 1), (1, 0, 0)]], "<f4"
)


def stl_of(said: int, *, head: bytes = b"", tail: bytes = b"") -> bytes:
    records = b"".join(bytes(12) + triangle.tobytes() + bytes(2) for triangle in TRIANGLES)
    return head.ljust(80, b"\0") + struct.pack("<I", said) + records + tail


@pytest.mark.parametrize("said", [0, 1, 2, 2**32 - 1])
def test_all_triangles_are_read_when_the_file_says_fewer(said: int, tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(stl_of(said))
    scene = load_scene(tmp_path / "a.stl")
    assert len(scene.faces) == 3
    assert "and has 3: all of these are read" in scene.remarks[0].problem


def test_a_file_that_says_more_triangles_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(stl_of(4))
    assert "states 4 triangles, and ends after 3" in refusal(SceneError, load_scene, tmp_path / "a.stl")


def test_what_follows_the_triangles_is_told_of(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(stl_of(3, head=b"solid \xe4", tail=b"note"))
    scene = load_scene(tmp_path / "a.stl")
    assert len(scene.faces) == 3
    assert "continues after its 3 triangles" in scene.remarks[0].problem


def stl_text(*, ends: bool = True) -> str:
    facets = "".join(
        "facet normal 0 0 0\n outer loop\n"
        + "".join("  vertex {} {} {}\n".format(*corner) for corner in triangle)
        + " endloop\nendfacet\n"
        for triangle in TRIANGLES
    )
    return f"solid Träger\n{facets}" + ("endsolid Träger\n" if ends else "")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
@pytest.mark.parametrize("large", [False, True])
def test_text_in_all_encodings(encoding: str, large: bool, tmp_path: Path) -> None:
    text = stl_text()
    text = text.upper() if large else text
    (tmp_path / "a.stl").write_bytes(text.encode(encoding))
    scene = load_scene(tmp_path / "a.stl")
    np.testing.assert_array_equal(scene.triangles, TRIANGLES)
    assert scene.remarks == ()


def test_text_that_ends_early(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_text(stl_text(ends=False))
    assert "ends without 'endsolid', after 3 triangles" in load_scene(tmp_path / "a.stl").remarks[0].problem
    (tmp_path / "a.stl").write_text(stl_text().rpartition("  vertex")[0])
    assert "ends within a triangle" in refusal(SceneError, load_scene, tmp_path / "a.stl")
    (tmp_path / "a.stl").write_text(stl_text().replace("vertex 0", "vertx 0", 1))
    assert "line 4 is 'vertx" in refusal(SceneError, load_scene, tmp_path / "a.stl")
