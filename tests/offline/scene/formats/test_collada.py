"""COLLADA: polygons of all kinds, materials where they are bound, and what must not be dropped without a word."""

from pathlib import Path

import numpy as np
import pytest

from rayfix_offline.scene.scene import Scene, load_scene
from rayfix_tables.errors import SceneError
from tests.support.messages.refusals import refusal
from tests.support.scenes.collada_files import (
    document,
    geometry,
    input_of,
    polygons_of,
    polylist,
    source_of,
    triangles_of,
)
from tests.support.scenes.polygon_scene import PARTITION_VOLUME, hall, partition

NODE = '<node id="wall"><instance_geometry url="#wall"/></node>'
SOURCE, RINGS = source_of("wall", partition())
WALL = geometry("wall", SOURCE + polylist("wall", RINGS))


def load(text: str, folder: Path) -> Scene:
    (folder / "a.dae").write_text(text, encoding="utf-8")
    return load_scene(folder / "a.dae")


def refused(text: str, folder: Path) -> str:
    (folder / "a.dae").write_text(text, encoding="utf-8")
    return refusal(SceneError, load_scene, folder / "a.dae")


def volume(scene: Scene) -> float:
    a, b, c = (scene.triangles[:, k] - scene.bounds[0] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


@pytest.mark.parametrize("write", [polylist, polygons_of])
def test_a_doorway_stays_open(write: object, tmp_path: Path) -> None:
    assert callable(write)
    scene = load(document(geometry("wall", SOURCE + write("wall", RINGS)), NODE), tmp_path)
    assert (len(scene.faces), scene.objects, scene.remarks) == (28, ("wall",), ())
    assert volume(scene) == pytest.approx(PARTITION_VOLUME, rel=1e-12)


def test_a_polygon_with_a_hole(tmp_path: Path) -> None:
    square = [np.array([(0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0)], float)]
    hole = [np.array([(1, 1, 0), (2, 1, 0), (2, 2, 0), (1, 2, 0)], float)]
    source, (outer, inner) = source_of("g", [*square, *hole])
    ring = f"<ph><p>{' '.join(map(str, outer))}</p><h>{' '.join(map(str, inner))}</h></ph>"
    text = geometry("g", f'{source}<polygons count="1">{input_of("g")}{ring}</polygons>')
    scene = load(document(text, '<node><instance_geometry url="#g"/></node>'), tmp_path)
    a, b, c = (scene.triangles[:, k] for k in range(3))
    assert np.cross(b - a, c - a)[:, 2].sum() / 2.0 == pytest.approx(15.0, rel=1e-12)


@pytest.mark.parametrize("kind", ["tristrips", "trifans"])
def test_strips_and_fans(kind: str, tmp_path: Path) -> None:
    source, rings = source_of("hall", hall())
    order = (0, 1, 3, 2) if kind == "tristrips" else (0, 1, 2, 3)
    sides = "".join(f"<p>{' '.join(str(ring[k]) for k in order)}</p>" for ring in rings)
    text = geometry("hall", f'{source}<{kind} count="6">{input_of("hall")}{sides}</{kind}>')
    scene = load(document(text, '<node><instance_geometry url="#hall"/></node>'), tmp_path)
    assert len(scene.faces) == 12
    assert abs(volume(scene)) == pytest.approx(180.0, rel=1e-12)


def test_materials_are_bound_where_a_geometry_is_shown(tmp_path: Path) -> None:
    """The same geometry twice, of other materials; and a symbol that is bound to nothing."""
    surfaces = polylist("wall", RINGS[:2], material="face") + polylist("wall", RINGS[2:], material="itu_brick")
    bind = (
        '<bind_material><technique_common><instance_material symbol="face" target="#{}"/></technique_common>'
        "</bind_material>"
    )
    nodes = "".join(
        f'<node name="{name}"><instance_geometry url="#wall">{bind.format(name)}</instance_geometry></node>'
        for name in ("m1", "m2")
    )
    materials = '<material id="m1" name="itu_concrete"/><material id="m2" name="itu_wood"/>'
    scene = load(document(geometry("wall", SOURCE + surfaces), nodes, materials=materials), tmp_path)
    found = {
        (scene.objects[o], scene.materials[m]) for o, m in zip(scene.face_objects, scene.face_materials, strict=True)
    }
    assert found == {("m1", "itu_concrete"), ("m2", "itu_wood"), ("m1", "itu_brick"), ("m2", "itu_brick")}
    assert scene.remarks == ()
    scene = load(document(geometry("wall", SOURCE + surfaces), nodes), tmp_path)
    assert "material '#m1' is missing: 'face' is used" in scene.remarks[0].problem


def test_transforms_one_after_the_other(tmp_path: Path) -> None:
    """Twice as high, then turned by 90 deg about z, then moved; within a node that is moved as well."""
    inner = "<translate>1 0 0</translate><rotate>0 0 1 90</rotate><scale>1 1 2</scale>"
    node = f'<node><matrix>1 0 0 0 0 1 0 0 0 0 1 5 0 0 0 1</matrix><node id="n">{inner}{{}}</node></node>'
    scene = load(document(WALL, node.format('<instance_geometry url="#wall"/>')), tmp_path)
    np.testing.assert_allclose(scene.bounds, [(-5, 4.9, 5), (1, 5.1, 11)], rtol=0, atol=1e-12)
    assert "without exactly 3 numbers" in refused(
        document(WALL, NODE.replace("><", "><scale>1 1</scale><", 1)), tmp_path
    )


def test_nodes_of_the_library_and_one_id_for_scene_node_and_geometry(tmp_path: Path) -> None:
    more = '<library_nodes><node id="scene"><instance_geometry url="#wall"/></node></library_nodes>'
    scene = load(document(WALL, '<node><instance_node url="#scene"/></node>' * 2, more=more), tmp_path)
    assert scene.objects == ("scene", "scene")
    assert len(scene.faces) == 56


@pytest.mark.parametrize("kind", ["lines", "linestrips", "points"])
def test_lines_beside_surfaces_are_told_of(kind: str, tmp_path: Path) -> None:
    lines = f'<{kind} count="1">{input_of("wall")}<p>0 1</p></{kind}>'
    scene = load(document(geometry("wall", SOURCE + polylist("wall", RINGS) + lines), NODE), tmp_path)
    assert len(scene.faces) == 28
    assert f"'wall' has <{kind}>" in scene.remarks[0].problem


def test_a_skin_is_read_in_its_rest_pose(tmp_path: Path) -> None:
    more = '<library_controllers><controller id="c"><skin source="#wall"/></controller></library_controllers>'
    scene = load(document(WALL, '<node><instance_controller url="#c"/></node>', more=more), tmp_path)
    assert len(scene.faces) == 28
    assert "bent by a controller" in scene.remarks[0].problem
    more = more.replace("#wall", "#none")
    assert "'#none', which is missing" in refused(
        document(WALL, '<node><instance_controller url="#c"/></node>', more=more), tmp_path
    )


def test_counts_that_are_not_the_files(tmp_path: Path) -> None:
    for text in (WALL.replace('<polylist count="10"', '<polylist count="9"'), WALL + '<geometry id="spare"/>'):
        scene = load(document(text, NODE), tmp_path)
        assert len(scene.faces) == 28
        assert len(scene.remarks) == 1
    assert "and its <vcount>" in refused(document(WALL.replace("<vcount>8", "<vcount>7"), NODE), tmp_path)


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ('source="#wall-v"', 'source="#none"', "the vertices '#none', which is missing"),
        ('source="#wall-p"', 'source="#none"', "the source '#none', which is missing"),
        ('source="#wall-pa"', 'source="#none"', "the float_array '#none', which is missing"),
        ('url="#wall"', 'url="#none"', "the geometry '#none', which is missing"),
        ('url="#wall"', 'url="b.dae#wall"', "'b.dae#wall', which is in another file"),
        ('url="#scene"', 'url="#none"', "the visual_scene '#none', which is missing"),
        ('count="16" stride="3"', 'count="17" stride="3"', "48 numbers, fewer than its accessor states"),
        ('stride="3"', 'stride="2"', "has no X, Y and Z"),
        ("<p>", "<p>9 ", "49 corners"),
        ("<p>7 ", "<p>99 ", "a vertex beyond its 16"),
        ("<p>7 ", "<p>x ", "invalid literal"),
        ('meter="1"', 'meter="0"', "its unit is 0 m"),
        ("<mesh>", "<convex_mesh>", "is a <convex_mesh>"),
    ],
)
def test_what_is_wrong_is_refused_by_name(before: str, after: str, told: str, tmp_path: Path) -> None:
    text = document(WALL, NODE)
    text = (
        text.replace("<p>" + text.partition("<p>")[2].partition(" ")[0] + " ", "<p>7 ", 1) if "7 " in before else text
    )
    assert before in text
    text = text.replace(before, after)
    if "convex" in after:
        text = text.replace("</mesh>", "</convex_mesh>")
    assert told in refused(text, tmp_path)


def test_geometry_with_two_surfaces(tmp_path: Path) -> None:
    surfaces = polylist("wall", RINGS[:2]) + triangles_of("wall", RINGS[2:])
    scene = load(document(geometry("wall", SOURCE + surfaces), NODE), tmp_path)
    assert volume(scene) == pytest.approx(PARTITION_VOLUME, rel=1e-12)
