"""glTF: every way of storing triangles, and what must not be dropped without a word."""

import json
from pathlib import Path
from typing import Any

import DracoPy
import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_offline.scene.scene import Scene, load_scene
from rayfix_tables.errors import SceneError
from tests.support.messages.refusals import refusal
from tests.support.scenes.gltf_files import GltfFile, box_arrays

LOW, HIGH = (1.0, 2.0, 0.0), (2.0, 4.0, 3.0)
VOLUME = 6.0
SINGLE = 1e-6  # m


def volume(scene: Scene) -> float:
    a, b, c = (scene.triangles[:, k] - scene.bounds[0] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def one_box(**node: Any) -> GltfFile:
    file = GltfFile()
    points, faces = box_arrays(LOW, HIGH)
    primitive = {"attributes": {"POSITION": file.accessor(points)}, "indices": file.accessor(faces.reshape(-1))}
    file.node(mesh=file.mesh([primitive]), name="box", **node)
    return file


def assert_is_the_box(path: Path, *, atol: float = SINGLE) -> Scene:
    scene = load_scene(path)
    assert (len(scene.faces), scene.num_degenerate, scene.remarks) == (12, 0, ())
    np.testing.assert_allclose(scene.bounds, [LOW, HIGH], rtol=0, atol=atol)
    assert volume(scene) == pytest.approx(VOLUME, abs=20.0 * atol)
    return scene


def test_plain(tmp_path: Path) -> None:
    assert assert_is_the_box(one_box().write(tmp_path / "a.glb")).objects == ("box",)


def test_sparse_positions(tmp_path: Path) -> None:
    """The upper corners are stored lower down, and lifted by the sparse values; or all are sparse, over zeros."""
    points, faces = box_arrays(LOW, HIGH)
    for start in (points * (1.0, 1.0, 0.5), None):
        file = one_box()
        moved = np.arange(4, 8) if start is not None else np.arange(8)
        sparse = {
            "count": len(moved),
            "indices": {"bufferView": file.view(moved.astype(np.uint8).tobytes()), "componentType": 5121},
            "values": {"bufferView": file.view(points[moved].tobytes())},
        }
        accessor = file.document["accessors"][0]
        accessor["sparse"] = sparse
        if start is None:
            del accessor["bufferView"]
        else:
            accessor["bufferView"] = file.view(start.astype(np.float32).tobytes())
        assert_is_the_box(file.write(tmp_path / "a.glb"))
    assert len(faces) == 12


@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int16, np.uint16])
@pytest.mark.parametrize("normalized", [False, True])
def test_quantised_positions(kind: type[np.integer[Any]], normalized: bool, tmp_path: Path) -> None:
    """Stored from 0 to 100; the node scales them to metres. With a stride, as alignment wants it."""
    points, faces = box_arrays((0, 0, 0), (100, 100, 100))
    file = GltfFile()
    padded = np.zeros((8, 4), kind)
    padded[:, :3] = points
    size = np.dtype(kind).itemsize
    accessor = file.accessor(padded[:, :3], normalized=normalized)
    file.document["accessors"][accessor]["bufferView"] = file.view(padded.tobytes(), byteStride=4 * size)
    indices = file.accessor(faces.reshape(-1).astype(np.uint8))
    unit = 100.0 / np.iinfo(kind).max if normalized else 100.0
    scale = ((np.array(HIGH) - LOW) / unit).tolist()
    file.node(
        mesh=file.mesh([{"attributes": {"POSITION": accessor}, "indices": indices}]), translation=LOW, scale=scale
    )
    file.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    assert_is_the_box(file.write(tmp_path / "a.glb"))


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans(mode: int, tmp_path: Path) -> None:
    """One primitive for each side; the corners of a side go round, or to and fro."""
    points, _ = box_arrays(LOW, HIGH)
    rings = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    file = GltfFile()
    at = file.accessor(points)
    order = (0, 1, 3, 2) if mode == 5 else (0, 1, 2, 3)
    sides = [file.accessor(np.array([ring[k] for k in order], np.uint32)) for ring in rings]
    file.node(mesh=file.mesh([{"attributes": {"POSITION": at}, "indices": side, "mode": mode} for side in sides]))
    assert_is_the_box(file.write(tmp_path / "a.glb"))


def test_instances(tmp_path: Path) -> None:
    """Three of them: shifted, turned by 90 deg about z, and twice as large, within a node that is shifted too."""
    file = one_box(translation=[10, 0, 0])
    turn = [0, 0, float(np.sqrt(0.5)), float(np.sqrt(0.5))]
    file.document["nodes"][0]["extensions"] = {
        "EXT_mesh_gpu_instancing": {
            "attributes": {
                "TRANSLATION": file.accessor(np.array([(0, 0, 5), (0, 0, 0), (0, 0, 0)], np.float32)),
                "ROTATION": file.accessor(np.array([(0, 0, 0, 1), turn, (0, 0, 0, 1)], np.float32)),
                "SCALE": file.accessor(np.array([(1, 1, 1), (1, 1, 1), (2, 2, 2)], np.float32)),
                "_ID": file.accessor(np.arange(3).astype(np.float32)),
            }
        }
    }
    file.document["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    scene = load_scene(file.write(tmp_path / "a.glb"))
    expected = [[(11, 2, 5), (12, 4, 8)], [(6, 1, 0), (8, 2, 3)], [(12, 4, 0), (14, 8, 6)]]
    assert scene.objects == ("box instance 1", "box instance 2", "box instance 3")
    for number, box in enumerate(expected):
        corners = scene.triangles[scene.face_objects == number].reshape(-1, 3)
        assert len(corners) == 36
        np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], box, rtol=0, atol=1e-5)


def draco_box(*, plain: bool) -> GltfFile:
    points, faces = box_arrays(LOW, HIGH)
    data = DracoPy.encode(points, faces=faces.astype(np.uint32), quantization_bits=16, preserve_order=True)
    number = next(each["unique_id"] for each in DracoPy.decode(data).attributes if each["attribute_type"] == 0)
    count = len(DracoPy.decode(data).points)
    file = one_box()
    primitive = file.document["meshes"][0]["primitives"][0]
    primitive["extensions"] = {
        "KHR_draco_mesh_compression": {"bufferView": file.view(data), "attributes": {"POSITION": number}}
    }
    if not plain:
        for accessor in file.document["accessors"]:
            del accessor["bufferView"]
        file.document["accessors"][0]["count"] = count
        file.document["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    return file


@pytest.mark.parametrize("plain", [False, True])
def test_draco(plain: bool, tmp_path: Path) -> None:
    assert_is_the_box(draco_box(plain=plain).write(tmp_path / "a.glb"), atol=1e-4)


def test_damaged_draco(tmp_path: Path) -> None:
    file = draco_box(plain=False)
    view = file.document["bufferViews"][-1]
    view["byteLength"] //= 2
    message = refusal(SceneError, load_scene, file.write(tmp_path / "a.glb"))
    assert "KHR_draco_mesh_compression cannot be decoded" in message


@pytest.mark.parametrize(
    ("extension", "tool"), [("EXT_meshopt_compression", "gltf-transform copy"), ("KHR_meshopt_compression", "gltfpack")]
)
def test_meshopt_is_refused_by_name(extension: str, tool: str, tmp_path: Path) -> None:
    file = one_box()
    for view in file.document["bufferViews"]:
        view["extensions"] = {extension: {"buffer": 0, "byteLength": 1, "byteStride": 12, "count": 8}}
    assert_is_the_box(file.write(tmp_path / "plain.glb"))
    document = json.loads(json.dumps(file.document))
    document["buffers"] = [{"byteLength": 1, "uri": "data:application/octet-stream;base64,AA=="}, {"byteLength": 999}]
    for view in document["bufferViews"]:
        view["buffer"] = 1
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    message = refusal(SceneError, load_scene, tmp_path / "a.gltf")
    assert f"its geometry is compressed with {extension}, which is not supported" in message
    assert f"decompress it, for example with: {tool} " in message


@pytest.mark.parametrize("where", ["node", "mesh", "primitive", "file"])
def test_unknown_extensions(where: str, tmp_path: Path) -> None:
    file = one_box()
    document = file.document
    entries = {
        "node": document["nodes"][0],
        "mesh": document["meshes"][0],
        "primitive": document["meshes"][0]["primitives"][0],
        "file": document,
    }
    entries[where]["extensions"] = {"ACME_more_walls": {}, "KHR_materials_unlit": {}, "KHR_lights_punctual": {}}
    scene = load_scene(file.write(tmp_path / "a.glb"))
    assert ["ACME_more_walls" in remark.problem for remark in scene.remarks] == [True]
    document["extensionsRequired"] = ["KHR_materials_unlit", "ACME_more_walls"]
    message = refusal(SceneError, load_scene, file.write(tmp_path / "a.glb"))
    assert "needs the extension ACME_more_walls, which" in message


def test_a_mesh_below_a_camera_and_a_matrix(tmp_path: Path) -> None:
    file = one_box()
    file.document["scenes"][0]["nodes"] = [1]
    file.document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}]
    matrix: NDArray[np.float64] = np.diag((1.0, 1.0, 2.0, 1.0))
    matrix[:3, 3] = (0.0, 0.0, 1.0)
    file.node(root=False, camera=0, children=[0], matrix=matrix.T.reshape(-1).tolist())
    scene = load_scene(file.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(scene.bounds, [(1, 2, 1), (2, 4, 7)], rtol=0, atol=SINGLE)


def test_a_mirrored_node_keeps_its_outside(tmp_path: Path) -> None:
    scene = load_scene(one_box(scale=[-1, 1, 1]).write(tmp_path / "a.glb"))
    assert volume(scene) == pytest.approx(VOLUME, rel=1e-6)


def test_morph_targets_at_their_default(tmp_path: Path) -> None:
    file = one_box()
    rise = np.zeros((8, 3), np.float32)
    rise[4:, 2] = 2.0
    mesh = file.document["meshes"][0]
    mesh["primitives"][0]["targets"] = [{"POSITION": file.accessor(rise)}]
    for weights, top in ((None, 3.0), ([0.5], 4.0)):
        if weights:
            mesh["weights"] = weights
        assert load_scene(file.write(tmp_path / "a.glb")).bounds[1, 2] == pytest.approx(top, rel=1e-6)
    file.document["nodes"][0]["weights"] = [1.0]
    assert load_scene(file.write(tmp_path / "a.glb")).bounds[1, 2] == pytest.approx(5.0, rel=1e-6)


def test_what_the_scene_does_not_show_is_told(tmp_path: Path) -> None:
    file = one_box()
    file.node(root=False, mesh=0, name="spare")
    file.mesh(file.document["meshes"][0]["primitives"])
    lines = {**file.document["meshes"][0]["primitives"][0], "mode": 1}
    file.document["meshes"][0]["primitives"].append(lines)
    file.document["nodes"][0]["skin"] = 0
    scene = load_scene(file.write(tmp_path / "a.glb"))
    told = " ".join(remark.problem for remark in scene.remarks)
    assert len(scene.faces) == 12
    for expected in (
        "points or lines",
        "deformed by a skin",
        "1 node with a mesh left out, such as 'spare'",
        "a mesh left out",
    ):
        assert expected in told


@pytest.mark.parametrize("name", ["hall A.bin", "hall%20A.bin"])
def test_names_with_blanks(name: str, tmp_path: Path) -> None:
    file = one_box()
    (tmp_path / name).write_bytes(file.binary)
    document = {**file.document, "buffers": [{"byteLength": len(file.binary), "uri": "hall%20A.bin"}]}
    (tmp_path / "a.gltf").write_bytes(b"\xef\xbb\xbf" + json.dumps(document).encode())
    assert_is_the_box(tmp_path / "a.gltf")


@pytest.mark.parametrize(
    ("entry", "key", "value", "told"),
    [
        ("accessors", "count", 9, "accessors[0] goes beyond bufferViews[0]"),
        ("accessors", "count", -1, "accessors[0].count is -1"),
        ("accessors", "bufferView", 7, "bufferViews[7], which does not exist"),
        ("accessors", "componentType", 5130, "accessors[0] is not a 3-vector"),
        ("accessors", "type", "VEC2", "accessors[0] is not a 3-vector"),
        ("bufferViews", "byteLength", 10_000, "bufferViews[0] goes beyond buffers[0]"),
        ("bufferViews", "byteStride", 4, "byteStride is 4"),
        ("nodes", "mesh", 3, "meshes[3], which does not exist"),
        ("nodes", "children", [5], "nodes[5], which does not exist"),
        ("nodes", "scale", [1, 2], "scale does not have 3 numbers"),
        ("meshes", "primitives", [{"attributes": {}}], "has no positions"),
        ("meshes", "primitives", [{"attributes": {"POSITION": 0}, "mode": 9}], "mode 9"),
        ("meshes", "primitives", [{"attributes": {"POSITION": 0}}], "8 indices, not a multiple of 3"),
        ("meshes", "primitives", 5, "an entry is of a wrong type"),
    ],
)
def test_what_is_wrong_is_refused_by_name(entry: str, key: str, value: Any, told: str, tmp_path: Path) -> None:
    file = one_box()
    file.document[entry][0][key] = value
    assert told in refusal(SceneError, load_scene, file.write(tmp_path / "a.glb"))


def test_indices_beyond_the_positions(tmp_path: Path) -> None:
    file = one_box()
    file.document["accessors"][1]["bufferView"] = file.view(np.full(36, 8, np.uint16).tobytes())
    assert "the index 8, beyond its 8" in refusal(SceneError, load_scene, file.write(tmp_path / "a.glb"))


def test_version_1_is_refused(tmp_path: Path) -> None:
    file = one_box()
    file.document["asset"]["version"] = "1.0"
    assert "of version 1.0" in refusal(SceneError, load_scene, file.write(tmp_path / "a.glb"))
