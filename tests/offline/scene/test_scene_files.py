"""Mesh files of every kind, sound and damaged."""

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from trimesh.visual.material import PBRMaterial

from rayfix_offline.scene.placed import Contents, Placed
from rayfix_offline.scene.scene import FILE_TYPES, METRES_PER_UNIT, Scene, _gather, load_scene
from rayfix_tables.errors import SceneError
from tests.support.messages.refusals import refusal

SINGLE = 1e-6  # m; most formats store single precision, and the room is 5 m long
KINDS = [kind for kind in FILE_TYPES if kind not in ("gltf", "xml", "ifc")]


def canonical(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Triangles in an order that depends on nothing but themselves, each from its least corner on."""
    rounded = np.round(triangles, 4)
    turned = []
    for corners, keys in zip(triangles, rounded, strict=True):
        first = min(range(3), key=lambda i: tuple(keys[i]))
        turned.append(np.roll(corners, -first, axis=0))
    return np.array(sorted(turned, key=lambda t: tuple(np.round(t, 4).ravel())))


def assert_same_triangles(scene: Scene, expected: NDArray[np.float64], *, atol: float = SINGLE) -> None:
    """Check that a scene has these triangles in any order, facing the same way."""
    assert scene.triangles.shape == expected.shape
    np.testing.assert_allclose(canonical(scene.triangles), canonical(expected), rtol=0, atol=atol)


def refused(path: Path) -> str:
    """Check that a file is refused in one line that names it, and return that line."""
    return refusal(SceneError, load_scene, path)


@pytest.fixture
def expected(cluttered_scene: trimesh.Scene) -> NDArray[np.float64]:
    """Triangles of the cluttered room."""
    return np.concatenate([mesh.triangles for mesh in cluttered_scene.geometry.values()])


def export(scene: trimesh.Scene, folder: Path, kind: str) -> Path:
    """Write a scene, or its triangles where the format knows no objects."""
    path = folder / f"room.{kind}"
    mesh = scene if kind in ("glb", "obj") else scene.to_geometry()
    mesh.export(path, file_type=kind)
    if kind == "dae":
        # trimesh says that y is up, whatever it writes.
        path.write_text(path.read_text(encoding="utf-8").replace("Y_UP", "Z_UP"), encoding="utf-8")
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file(
    cluttered_scene: trimesh.Scene, expected: NDArray[np.float64], tmp_path: Path, kind: str
) -> None:
    scene = load_scene(export(cluttered_scene, tmp_path, kind))
    assert_same_triangles(scene, expected)
    assert (scene.vertices.dtype, scene.faces.dtype) == (np.float64, np.int32)
    assert scene.num_degenerate == 0
    np.testing.assert_allclose(scene.bounds, [(0, 0, 0), (4, 5, 3)], rtol=0, atol=SINGLE)


def test_gltf_with_files_beside_it(
    cluttered_scene: trimesh.Scene, expected: NDArray[np.float64], tmp_path: Path
) -> None:
    for name, data in trimesh.exchange.gltf.export_gltf(cluttered_scene).items():
        (tmp_path / name).write_bytes(data)
    assert_same_triangles(load_scene(tmp_path / "model.gltf"), expected)
    for name in [p.name for p in tmp_path.glob("*.bin")]:
        (tmp_path / name).unlink()
    refused(tmp_path / "model.gltf")


def test_capital_letters_in_the_type(
    cluttered_scene: trimesh.Scene, expected: NDArray[np.float64], tmp_path: Path
) -> None:
    path = export(cluttered_scene, tmp_path, "glb").rename(tmp_path / "ROOM.GLB")
    assert_same_triangles(load_scene(path), expected)


def test_objects_and_materials_keep_their_names(cluttered_scene: trimesh.Scene, tmp_path: Path) -> None:
    for name, material in [("room", "itu_concrete"), ("cabinet", "itu_metal"), ("table", "itu_metal")]:
        visual = trimesh.visual.TextureVisuals(material=PBRMaterial(name=material))
        cluttered_scene.geometry[name].visual = visual
    scene = load_scene(export(cluttered_scene, tmp_path, "glb"))
    assert set(scene.objects) == {"room", "cabinet", "table"}
    assert set(scene.materials) == {"itu_concrete", "itu_metal"}
    for name, material in [("room", "itu_concrete"), ("cabinet", "itu_metal"), ("table", "itu_metal")]:
        mine = scene.face_objects == scene.objects.index(name)
        assert np.count_nonzero(mine) == 12
        np.testing.assert_array_equal(scene.face_materials[mine], scene.materials.index(material))
        low, high = cluttered_scene.geometry[name].bounds
        corners = scene.triangles[mine].reshape(-1, 3)
        np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [low, high], rtol=0, atol=SINGLE)


def test_without_materials(cluttered_scene: trimesh.Scene, tmp_path: Path) -> None:
    scene = load_scene(export(cluttered_scene, tmp_path, "stl"))
    assert scene.materials == ()
    np.testing.assert_array_equal(scene.face_materials, -1)


# Units and axes


@pytest.mark.parametrize(("unit", "metres"), METRES_PER_UNIT.items())
def test_units(
    cluttered_scene: trimesh.Scene, expected: NDArray[np.float64], tmp_path: Path, unit: str, metres: float
) -> None:
    cluttered_scene.apply_scale(1.0 / metres)
    path = export(cluttered_scene, tmp_path, "ply")
    assert_same_triangles(load_scene(path, unit=unit), expected)


def test_a_file_that_says_centimetres(shared_data: Path) -> None:
    """A shelf, 3.9 x 0.9 x 2.6 m; its node is moved as well. What the site says counts for nothing then."""
    path = shared_data / "warehouse" / "shelf_centimetres.dae"
    for unit in ("m", "mm"):
        size = np.diff(load_scene(path, unit=unit).bounds, axis=0)[0]
        np.testing.assert_allclose(size, [3.918, 0.880, 2.613], rtol=0, atol=5e-3)


@pytest.mark.parametrize("metres", [1.0, 0.01, 0.0254, 0.001])
def test_collada_units(
    cluttered_scene: trimesh.Scene, expected: NDArray[np.float64], tmp_path: Path, metres: float
) -> None:
    cluttered_scene.apply_scale(1.0 / metres)
    path = export(cluttered_scene, tmp_path, "dae")
    text = path.read_text(encoding="utf-8")
    assert text.count("<up_axis>") == 1
    path.write_text(text.replace("<up_axis>", f'<unit name="own" meter="{metres}"/><up_axis>'), "utf-8")
    assert_same_triangles(load_scene(path), expected)


@pytest.mark.parametrize(("axis", "order", "signs"), [("X", (2, 0, 1), (1, -1, -1)), ("Y", (0, 2, 1), (1, 1, -1))])
def test_collada_says_which_axis_is_up(
    cluttered_scene: trimesh.Scene,
    expected: NDArray[np.float64],
    tmp_path: Path,
    axis: str,
    order: tuple[int, int, int],
    signs: tuple[int, int, int],
) -> None:
    """The file has the room lying, (x, z, -y) for Y and (z, -x, -y) for X; the site's word counts for nothing."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(signs)[:, None] * np.eye(3)[list(order)]
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    cluttered_scene.apply_transform(matrix)
    path = export(cluttered_scene, tmp_path, "dae")
    text = path.read_text(encoding="utf-8")
    said = re.sub("<up_axis>.*</up_axis>", f"<up_axis>{axis}_UP</up_axis>", text)
    path.write_text(said, encoding="utf-8")
    for up in ("y", "z"):
        assert_same_triangles(load_scene(path, up=up), expected)
    path.write_text(re.sub("<up_axis>.*</up_axis>", "", text), encoding="utf-8")
    if axis == "Y":
        assert_same_triangles(load_scene(path, up="y"), expected)


def test_y_up(tmp_path: Path) -> None:
    """A right-handed turn about x: y becomes z and z becomes -y, so that nothing is mirrored."""
    mesh = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)], [(0, 1, 2), (0, 2, 3), (0, 3, 1), (1, 3, 2)])
    path = tmp_path / "a.ply"
    mesh.export(path)
    turned = np.array([(0, 0, 0), (1, 0, 0), (0, 0, 2), (0, -3, 0)])[mesh.faces]
    assert_same_triangles(load_scene(path, up="y"), turned)
    assert_same_triangles(load_scene(path, up="z"), np.array(mesh.triangles))
    a, b, c = (turned[:, i] for i in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) == pytest.approx(6.0 * mesh.volume, rel=1e-12)


def test_transforms_of_nested_nodes(tmp_path: Path) -> None:
    r"""A bolt in a frame: the frame is turned by 90 deg and moved, the bolt is moved within it; and a copy.

    ::

        world -- frame (rotation about z, moved by 10 along x) -- bolt (moved by 1 along the frame's x)
              \- copy of the bolt's mesh, twice as large
    """
    bolt = trimesh.creation.box(extents=(0.2, 0.4, 0.6))
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1))
    turn[0, 3] = 10.0
    scene.graph.update("frame", "world", matrix=turn)
    scene.add_geometry(bolt, "bolt", "bolt", "frame", transform=trimesh.transformations.translation_matrix((1, 0, 0)))
    scene.graph.update("copy", "world", matrix=np.diag((2.0, 2.0, 2.0, 1.0)), geometry="bolt")
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    loaded = load_scene(tmp_path / "a.glb")
    boxes = {name: loaded.triangles[loaded.face_objects == i].reshape(-1, 3) for i, name in enumerate(loaded.objects)}
    np.testing.assert_allclose(boxes["bolt"].mean(axis=0), (10, 1, 0), rtol=0, atol=SINGLE)
    np.testing.assert_allclose(np.ptp(boxes["bolt"], axis=0), (0.4, 0.2, 0.6), rtol=0, atol=SINGLE)
    np.testing.assert_allclose(boxes["copy"].mean(axis=0), (0, 0, 0), rtol=0, atol=SINGLE)
    np.testing.assert_allclose(np.ptp(boxes["copy"], axis=0), (0.4, 0.8, 1.2), rtol=0, atol=SINGLE)


# Triangles that are none


def test_degenerate_triangles_are_left_out_and_counted(tmp_path: Path) -> None:
    vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.5, 0, 0), (2, 0, 0)]
    faces = [(0, 1, 2), (0, 0, 1), (0, 3, 1), (2, 2, 2), (1, 4, 2)]
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "a.ply")
    scene = load_scene(tmp_path / "a.ply")
    assert scene.num_degenerate == 3
    assert_same_triangles(scene, np.array(vertices)[[(0, 1, 2), (1, 4, 2)]])
    assert len(scene.face_materials) == len(scene.face_objects) == 2


def test_only_degenerate_triangles(tmp_path: Path) -> None:
    trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)], process=False).export(tmp_path / "a.ply")
    assert "only triangles without an area" in refused(tmp_path / "a.ply")


def test_bounds_ignore_vertices_that_no_triangle_uses(tmp_path: Path) -> None:
    vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (99, 99, 99)]
    trimesh.Trimesh(vertices, [(0, 1, 2)], process=False).export(tmp_path / "a.ply")
    np.testing.assert_array_equal(load_scene(tmp_path / "a.ply").bounds, [(0, 0, 0), (1, 1, 0)])


def test_quadrilaterals_are_cut(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 2 0\nv 0 2 0\nf 1 2 3 4\n")
    triangles = load_scene(tmp_path / "a.obj").triangles
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2
    assert len(triangles) == 2
    assert area.sum() == pytest.approx(2.0, rel=1e-12)


# Files that cannot be used


def test_a_missing_file(tmp_path: Path) -> None:
    assert "correct 'scene' in the site file" in refused(tmp_path / "none.glb")


def test_a_folder(tmp_path: Path) -> None:
    (tmp_path / "a.glb").mkdir()
    refused(tmp_path / "a.glb")


@pytest.mark.parametrize("name", ["a.blend", "a", "a.glb.zip", "a.usd"])
def test_an_unknown_type(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"x")
    assert "give one of glb, gltf, obj, ply, stl, dae, xml, ifc" in refused(tmp_path / name)


@pytest.mark.parametrize("kind", FILE_TYPES)
@pytest.mark.parametrize("content", [b"", b"\n", b"hello", bytes(200), bytes(range(256)) * 4, b"glTF\x02\x00\x00\x00"])
def test_garbage(tmp_path: Path, kind: str, content: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"a.{kind}"
    path.write_bytes(content)
    refused(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["glb", "stl", "dae", "ply"])
@pytest.mark.parametrize("share", [0.03, 0.3, 0.6, 0.95])
def test_a_truncated_file(cluttered_scene: trimesh.Scene, tmp_path: Path, kind: str, share: float) -> None:
    path = export(cluttered_scene, tmp_path, kind)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    refused(path)


def test_points_are_no_scene(tmp_path: Path) -> None:
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(9, 3))).export(tmp_path / "a.ply")
    assert "holds no triangles" in refused(tmp_path / "a.ply")


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e999"])
def test_coordinates_that_are_not_finite(tmp_path: Path, value: str) -> None:
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 {value}\nv 0 1 1\nf 1 2 3\nf 1 2 4\n")
    assert "not finite" in refused(tmp_path / "a.obj")


def test_a_binary_file_with_nan(tmp_path: Path) -> None:
    mesh = trimesh.creation.box()
    mesh.export(tmp_path / "a.stl")
    raw = bytearray((tmp_path / "a.stl").read_bytes())
    raw[100:104] = struct.pack("<f", np.nan)
    (tmp_path / "a.stl").write_bytes(raw)
    assert "not finite" in refused(tmp_path / "a.stl")


@pytest.mark.parametrize("face", ["f 1 2 9", "f 1 2 -7"])
def test_faces_of_vertices_that_are_not_there(tmp_path: Path, face: str) -> None:
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n{face}\n")
    refused(tmp_path / "a.obj")


# Checksum


def test_the_checksum_is_that_of_the_geometry(cluttered_scene: trimesh.Scene, tmp_path: Path) -> None:
    path = export(cluttered_scene, tmp_path, "glb")
    scene = load_scene(path)
    assert len(scene.sha256) == 64
    assert load_scene(path.rename(tmp_path / "other.glb")).sha256 == scene.sha256
    variations: list[dict[str, Any]] = [{"unit": "mm"}, {"up": "y"}]
    sums = {load_scene(tmp_path / "other.glb", **changes).sha256 for changes in variations}
    assert len(sums | {scene.sha256}) == 3


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s.vertices.__setitem__((5, 1), np.nextafter(s.vertices[5, 1], 99)),
        lambda s: s.faces.__setitem__(3, s.faces[3, ::-1]),
        lambda s: s.face_materials.__setitem__(0, 0),
    ],
)
def test_the_checksum_finds_a_change(
    cluttered_scene: trimesh.Scene, tmp_path: Path, change: Callable[[Scene], None]
) -> None:
    scene = load_scene(export(cluttered_scene, tmp_path, "stl"))
    before = scene.sha256
    change(scene)
    assert scene.sha256 != before


def of_materials(count: int) -> Scene:
    """Return a scene of one triangle a material; a file of so many takes gigabytes to read."""
    placed = Placed(
        name="part",
        vertices=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        faces=np.tile([0, 1, 2], (count, 1)),
        materials=tuple(f"m{n}" for n in range(count)),
        face_materials=np.arange(count),
    )
    return _gather(Path("a.obj"), [placed], Contents(objects=(placed,)), scale=1.0, up="z")


def test_more_materials_than_a_table_holds() -> None:
    """Beyond index 32,767 they wrapped: such triangles got another material, or none."""
    scene = of_materials(32_768)
    assert len(scene.materials) == 32_768
    np.testing.assert_array_equal(scene.face_materials, np.arange(32_768))
    with pytest.raises(SceneError, match=r"a\.obj has 32,769 materials, a table holds 32,768 at most; give"):
        of_materials(32_769)
