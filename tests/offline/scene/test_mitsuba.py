"""Mitsuba XML scenes: those of Sionna RT, transforms by hand, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from rayfix_offline.scene.scene import Scene, load_scene
from rayfix_tables.errors import SceneError
from tests.support.messages.refusals import refusal

SINGLE = 1e-5  # m; PLY files of trimesh store single precision


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder with the mesh ``meshes/box.ply``, from (1, 2, 3) to (2, 4, 6) m."""
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box(bounds=[(1, 2, 3), (2, 4, 6)]).export(tmp_path / "meshes" / "box.ply")
    return tmp_path


def shape(content: str = "", *, name: str = "box", kind: str = "ply", file: str = "meshes/box.ply") -> str:
    """XML of a shape."""
    filename = f'<string name="filename" value="{file}"/>' if file else ""
    return f'<shape type="{kind}" id="mesh-{name}">{filename}{content}</shape>'


def moved(operations: str) -> str:
    """XML of a shape that is moved."""
    return shape(f'<transform name="to_world">{operations}</transform>')


def load(folder: Path, content: str) -> Scene:
    """Write a scene and load it."""
    (folder / "scene.xml").write_text(f'<scene version="2.1.0">{content}</scene>', encoding="utf-8")
    return load_scene(folder / "scene.xml")


def refused(folder: Path, content: str | bytes) -> str:
    """Check that a file is refused in one line that names it, and return that line."""
    path = folder / "scene.xml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return refusal(SceneError, load_scene, path)


def refused_scene(folder: Path, content: str) -> str:
    """Check that a scene is refused."""
    return refused(folder, f'<scene version="2.1.0">{content}</scene>')


def corners(scene: Scene) -> NDArray[np.float64]:
    """Corners of the triangles in a fixed order, shape (n, 3), m."""
    points = np.round(scene.triangles.reshape(-1, 3), 4) + 0.0
    return np.unique(points, axis=0)


def box_corners() -> NDArray[np.float64]:
    """Corners of the box where the file has it, shape (8, 3), m."""
    return np.array([(x, y, z) for x in (1.0, 2.0) for y in (2.0, 4.0) for z in (3.0, 6.0)])


def test_a_scene_of_sionna(shared_data: Path) -> None:
    """A closed metal box, 10 x 10 x 5 m, with two glass screens that reach 1 cm through its floor and ceiling."""
    scene = load_scene(shared_data / "mitsuba" / "box_two_screens" / "box_two_screens.xml")
    assert scene.objects == ("screen_1", "box", "screen_2")
    assert scene.materials == ("itu_glass", "itu_metal")
    assert (len(scene.faces), scene.num_degenerate) == (16, 0)
    np.testing.assert_allclose(scene.bounds, [(-5, -5, 0), (5, 5, 5)], rtol=0, atol=0.011)
    box = scene.face_objects == 1
    np.testing.assert_array_equal(scene.face_materials, np.where(box, 1, 0))
    corners = scene.triangles[box]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert abs(volume) == pytest.approx(10 * 10 * 5, rel=1e-6)


def test_a_scene_of_blender(folder: Path) -> None:
    """The older dialect: the bsdf's id is the material; camera, light and defaults are passed over."""
    scene = load(
        folder,
        f"""
        <default name="spp" value="4096"/>
        <integrator type="path"><integer name="max_depth" value="12"/></integrator>
        <sensor type="perspective" id="Camera"><transform name="to_world"><scale x="-1"/></transform></sensor>
        <emitter type="constant"><rgb value="1 1 1" name="radiance"/></emitter>
        <bsdf type="twosided" id="mat-itu_concrete"><bsdf type="diffuse"/></bsdf>
        <bsdf type="twosided" id="mat-itu_metal.001"><bsdf type="diffuse"/></bsdf>
        <bsdf type="diffuse" id="mat-Paint"/>
        <bsdf type="twosided"><bsdf type="diffuse" id="itu-wood"/></bsdf>
        {shape('<ref id="mat-itu_concrete"/>', name="a")}
        {shape('<ref id="mat-itu_metal.001" name="bsdf"/>', name="b")}
        {shape('<ref id="mat-Paint" name="bsdf"/>', name="c")}
        {shape('<bsdf type="twosided"><bsdf type="diffuse" id="mat-itu_wood"/></bsdf>', name="d")}
        {shape('<ref id="light" name="emitter"/>', name="e")}
        """,
    )
    assert scene.objects == ("a", "b", "c", "d", "e")
    assert scene.materials == ("itu_concrete", "itu_metal", "Paint", "itu_wood")
    np.testing.assert_array_equal(scene.face_materials, np.repeat([0, 1, 2, 3, -1], 12))
    np.testing.assert_array_equal(corners(scene), box_corners())


def test_a_material_of_sionna_within_another(folder: Path) -> None:
    material = '<bsdf type="itu-radio-material"><string name="type" value="very_dry_ground"/></bsdf>'
    scene = load(folder, f'<bsdf type="twosided" id="earth">{material}</bsdf>' + shape('<ref id="earth"/>'))
    assert scene.materials == ("itu_very_dry_ground",)


# Transforms


@pytest.mark.parametrize(
    ("operations", "expected"),
    [
        ("", lambda p: p),
        ('<translate x="1" z="-2"/>', lambda p: p + np.array([1, 0, -2])),
        ('<translate value="1, 2, 3"/>', lambda p: p + np.array([1, 2, 3])),
        ('<scale value="2"/>', lambda p: 2 * p),
        ('<scale value="2 3 0.5"/>', lambda p: p * [2, 3, 0.5]),
        ('<scale y="3"/>', lambda p: p * [1, 3, 1]),
        ('<rotate z="1" angle="90"/>', lambda p: p[:, [1, 0, 2]] * [-1, 1, 1]),
        ('<rotate value="0 0 2" angle="-90"/>', lambda p: p[:, [1, 0, 2]] * [1, -1, 1]),
        ('<rotate x="1" angle="90"/>', lambda p: p[:, [0, 2, 1]] * [1, -1, 1]),
        ('<matrix value="0 0 1 7  1 0 0 8  0 1 0 9  0 0 0 1"/>', lambda p: p[:, [2, 0, 1]] + [7, 8, 9]),
        ('<matrix value="0 0 1  1 0 0  0 1 0"/>', lambda p: p[:, [2, 0, 1]]),
        # One after the other, in the order of the file.
        ('<translate x="1"/><scale value="2"/>', lambda p: 2 * (p + np.array([1, 0, 0]))),
        ('<scale value="2"/><translate x="1"/>', lambda p: 2 * p + np.array([1, 0, 0])),
    ],
)
def test_transforms(folder: Path, operations: str, expected: object) -> None:
    assert callable(expected)
    wanted = expected(box_corners())
    found = corners(load(folder, moved(operations)))
    np.testing.assert_allclose(found, np.unique(np.round(wanted, 4) + 0.0, axis=0), rtol=0, atol=SINGLE)


def test_a_transform_of_the_oldest_dialect_and_others(folder: Path) -> None:
    other = (
        '<transform name="toWorld"><scale value="3"/></transform><transform name="uv"><scale value="9"/></transform>'
    )
    np.testing.assert_allclose(corners(load(folder, shape(other))), 3 * box_corners(), rtol=0, atol=SINGLE)


def test_values_from_defaults(folder: Path) -> None:
    content = '<default name="size" value="2"/><default name="where" value="meshes"/>'
    scale = '<transform name="to_world"><scale value="$size"/></transform>'
    scene = load(folder, content + shape(scale, file="$where/box.ply"))
    np.testing.assert_allclose(corners(scene), 2 * box_corners(), rtol=0, atol=SINGLE)


def test_unit_and_axis_of_the_site(folder: Path) -> None:
    load(folder, shape())
    scene = load_scene(folder / "scene.xml", unit="cm", up="y")
    np.testing.assert_allclose(scene.bounds, [(0.01, -0.06, 0.02), (0.02, -0.03, 0.04)], rtol=0, atol=SINGLE)


def test_the_material_counts_in_the_checksum(folder: Path) -> None:
    sums = set()
    for kind in ("glass", "metal"):
        material = f'<bsdf type="itu-radio-material" id="m"><string name="type" value="{kind}"/></bsdf>'
        sums.add(load(folder, material + shape('<ref id="m"/>')).sha256)
    assert len(sums) == 2


# Files that cannot be used


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "holds no triangles"),
        ("<shape type='ply' id='a'/>", "shape 'a' names no file"),
        (shape(file="meshes/none.ply"), "shape 'box' needs meshes/none.ply, which is missing; put it next to"),
        (shape(file="x" * 5000), "which is missing"),
        (shape(file="meshes"), "which is missing"),
        (shape(kind="sphere", file=""), "shape 'box' is of type 'sphere', which is not supported; export it as ply"),
        (shape(kind="instance", file=""), "is of type 'instance'"),
        (shape('<ref id="gold"/>'), "refers to the material 'gold', which the file does not define"),
        ('<include filename="a.xml"/>' + shape(), "includes another file"),
        (moved('<lookat origin="0 0 0"/>'), "<lookat>, which is not supported; use matrix"),
        (moved('<scale value="big"/>'), "the value 'big'; give 1 or 3 finite numbers"),
        (moved('<scale value="$missing"/>'), "the value '$missing'"),
        (moved('<translate x="nan"/>'), "the value 'nan'; give 1 finite numbers"),
        (moved('<rotate z="1"/>'), "the value ''; give 1 finite numbers"),
        (moved('<rotate angle="3"/>'), "has a rotation without an axis"),
        (moved('<matrix value="1 2 3"/>'), "give 9 or 16 finite numbers"),
        (moved('<matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1"/>'), "perspective"),
        (moved('<scale value="0"/>'), "only triangles without an area"),
        (moved('<scale value="1e200"/>'), "give 1 or 3 finite numbers below 1e+09"),
        (moved('<scale value="1e8"/>' * 60), "a transform with numbers beyond 1e+09"),
    ],
)
def test_a_scene_that_cannot_be_used(folder: Path, content: str, expected: str) -> None:
    assert expected in refused_scene(folder, content)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("<scene><shape></scene>", "cannot be read as XML"),
        ("<mesh/>", "its root is <mesh>"),
        (b"\xff\xfe" + "<scene/>".encode("utf-16-le"), "not UTF-8"),
        ('<!DOCTYPE scene [<!ENTITY a "b">]><scene>&a;</scene>', "document type or entities"),
        ("<!DOCTYPE scene><scene/>", "document type or entities"),
        ("<!doctype scene><scene/>", "cannot be read as XML"),
        ("<scene>&a;</scene>", "cannot be read as XML"),
    ],
)
def test_a_file_that_cannot_be_read(folder: Path, content: str | bytes, expected: str) -> None:
    assert expected in refused(folder, content)


def test_a_damaged_mesh(folder: Path) -> None:
    (folder / "meshes" / "box.ply").write_bytes(b"ply\nformat")
    (folder / "scene.xml").write_text(f"<scene>{shape()}</scene>")
    with pytest.raises(SceneError, match=r"box\.ply cannot be read as PLY"):
        load_scene(folder / "scene.xml")


def test_points_are_no_shape(folder: Path) -> None:
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(9, 3))).export(folder / "meshes" / "box.ply")
    assert "shape 'box': meshes/box.ply holds no triangles" in refused_scene(folder, shape())


def test_the_thickness_of_a_material(folder: Path) -> None:
    """Sionna RT states it in metres, whatever the unit of the scene."""
    material = '<string name="type" value="glass"/><float name="thickness" value="0.012"/>'
    bsdf = f'<bsdf type="itu-radio-material" id="pane">{material}</bsdf>'
    scene = load(
        folder, bsdf + shape('<ref id="pane"/>', name="a") + shape('<bsdf type="diffuse" id="itu_wood"/>', name="b")
    )
    assert scene.face_thickness is not None
    np.testing.assert_array_equal(scene.face_thickness, np.repeat([0.012, np.nan], 12))
    with pytest.raises(SceneError, match=r"material 'pane' has the thickness 'thin'; give metres, more than 0"):
        load(folder, bsdf.replace("0.012", "thin") + shape('<ref id="pane"/>'))
