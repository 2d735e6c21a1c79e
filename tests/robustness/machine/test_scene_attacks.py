"""Scene files that were made to harm: each is refused by one line, and nothing outside their folder is read."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rayfix_offline.scene import scene
from rayfix_offline.scene.formats import mitsuba, xml_limits
from rayfix_offline.scene.scene import load_scene
from rayfix_offline.site import LARGEST_COORDINATE, read_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_tables.errors import SceneError, SiteError
from tests.support.checkout import ROOT
from tests.support.messages.refusals import refusal
from tests.support.scenes.rooms import ROOM, scene_of_boxes

SECRET = "newmtl not-yours\nKd 1 0 0\n"


def refused(path: Path) -> str:
    return refusal(SceneError, load_scene, path)


def box_mesh(**changes: object) -> trimesh.Trimesh:
    return trimesh.creation.box((4, 5, 3), **changes)


# Numbers


def obj_of(corner: str) -> str:
    return f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv {corner} 0 0\nf 1 2 3\nf 2 3 4\n"


def ascii_ply_of(corner: str) -> str:
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
    return f"{head}element face 2\nproperty list uchar int vertex_indices\nend_header\n" + (
        f"0 0 0\n1 0 0\n0 1 0\n{corner} 0 0\n3 0 1 2\n3 1 2 3\n"
    )


def ascii_stl_of(corner: str) -> str:
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex {} 1 0\nendloop\nendfacet\n"
    return f"solid a\n{facet.format('0')}{facet.format(corner)}endsolid a\n"


def dae_of(corner: str, *, nodes: str = '<node id="n"><instance_geometry url="#g"/></node>', library: str = "") -> str:
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="1" name="meter"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="12">0 0 0 1 0 0 0 1 0 {corner} 0 0</float_array>
<technique_common><accessor source="#pa" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="2"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_nodes>{library}</library_nodes>
<library_visual_scenes><visual_scene id="s">{nodes}</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


FORMATS: dict[str, Callable[[str], str]] = {"obj": obj_of, "ply": ascii_ply_of, "stl": ascii_stl_of, "dae": dae_of}


@pytest.mark.parametrize("corner", ["1e8", "1e20", "-1e37", "1e150", "1e300"])
@pytest.mark.parametrize("kind", FORMATS)
def test_coordinates_that_no_building_has_are_refused_with_their_value(kind: str, corner: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}"
    path.write_text(FORMATS[kind](corner))
    message = refused(path)
    # COLLADA's reader keeps single precision, which has no 1e150.
    infinite = kind == "dae" and abs(float(corner)) > 1e38
    expected = (
        f"the number {corner} in the float_array 'pa', which is not finite"
        if infinite
        else f"a coordinate of {abs(float(corner)):.6g} m, beyond 5e+07 m"
    )
    assert expected in message
    path.write_text(FORMATS[kind]("1e7"))
    assert load_scene(path).bounds[1, 0] == pytest.approx(1e7)


def test_a_position_that_is_no_number_is_not_taken_for_zero(tmp_path: Path) -> None:
    (tmp_path / "a.dae").write_text(dae_of("nan"))
    assert "the number nan in the float_array 'pa'" in refused(tmp_path / "a.dae")


def test_a_transform_counts_and_so_does_the_unit(tmp_path: Path) -> None:
    box_mesh().export(tmp_path / "box.ply")
    steps = '<scale value="1e8"/>'
    text = (
        '<scene><shape type="ply" id="b"><string name="filename" value="box.ply"/>'
        '<transform name="to_world">{}</transform></shape></scene>'
    )
    (tmp_path / "a.xml").write_text(text.format(steps))
    assert "the object 'b' has a coordinate of 2.5e+08 m" in refused(tmp_path / "a.xml")
    (tmp_path / "a.xml").write_text(text.format('<scale value="1e7"/>'))
    assert load_scene(tmp_path / "a.xml", unit="mm").bounds[1, 1] == pytest.approx(2.5e4)


def test_the_largest_coordinates_that_are_taken_are_worked_on(tmp_path: Path) -> None:
    """A sound room, and one corner of a box as far off as may be: findings, and no warning of NumPy's."""
    rooms = scene_of_boxes(room=ROOM, far=((1.0, 1.0, 1.0), (2.0, 2.0, 2.0)))
    corners = rooms.geometry["far"].vertices.copy()
    corners[0] = (LARGEST_COORDINATE, -LARGEST_COORDINATE, 0.0)
    rooms.geometry["far"].vertices = corners
    rooms.export(tmp_path / "room.glb")
    (tmp_path / "site.toml").write_text(
        '[site]\nname = "a"\nscene = "room.glb"\n[[stations]]\nid = "s"\nposition_m = [3.6, 0.4, 2.6]\n'
    )
    assert prepare_twin(read_site(tmp_path / "site.toml"), tmp_path).findings


# Depth and multiplication


def nested(count: int) -> str:
    return '<bsdf type="twosided">' * count + '<bsdf type="diffuse" id="mat-itu_wood"/>' + "</bsdf>" * count


def test_elements_in_each_other_have_a_limit(tmp_path: Path) -> None:
    box_mesh().export(tmp_path / "box.ply")
    shape = '<shape type="ply" id="b"><string name="filename" value="box.ply"/>{}</shape>'
    path = tmp_path / "a.xml"
    path.write_text(f"<scene>{nested(200_000)}</scene>")
    assert "elements nested more than 200 deep" in refused(path)
    path.write_text(f"<scene>{shape.format(nested(190))}</scene>")
    assert load_scene(path).materials == ("itu_wood",)


def test_nodes_in_each_other_have_a_limit(tmp_path: Path) -> None:
    path = tmp_path / "a.dae"
    inner = '<instance_geometry url="#g"/>'
    path.write_text(dae_of("1", nodes="<node>" * 100_000 + inner + "</node>" * 100_000))
    assert "nested more than 200 deep" in refused(path)
    path.write_text(dae_of("1", nodes="<node>" * 190 + inner + "</node>" * 190))
    assert len(load_scene(path).faces) == 1


def test_instances_of_instances_have_a_limit(tmp_path: Path) -> None:
    """Each of 30 nodes stands for ten of the next: 1e30 triangles from a file of some kB."""
    chain = "".join(
        f'<node id="n{k}">' + f'<instance_node url="#n{k + 1}"/>' * 10 + "</node>" for k in reversed(range(30))
    )
    library = '<node id="n30"><instance_geometry url="#g"/></node>' + chain
    (tmp_path / "a.dae").write_text(dae_of("1", nodes='<node><instance_node url="#n0"/></node>', library=library))
    assert "characters of indices, more than 200,000,000" in refused(tmp_path / "a.dae")
    few = '<node id="n1"><instance_geometry url="#g"/></node><node id="n0">' + '<instance_node url="#n1"/>' * 3
    (tmp_path / "b.dae").write_text(
        dae_of("0.5", nodes='<node><instance_node url="#n0"/></node>', library=few + "</node>")
    )
    assert load_scene(tmp_path / "b.dae").num_degenerate + len(load_scene(tmp_path / "b.dae").faces) == 6


def chain(count: int) -> list[dict[str, object]]:
    return [{"children": [k + 1]} for k in range(count - 1)] + [{"mesh": 0}]


@pytest.mark.parametrize(
    ("nodes", "expected"),
    [
        (chain(100_000), "nodes nested more than 200 deep"),
        ([{"children": [1], "mesh": 0}, {"children": [0]}], "nodes that form a cycle"),
        ([{"mesh": 0}, {"children": [1], "mesh": 0}], "nodes that form a cycle"),
        ([{"children": [2]}, {"children": [2]}, {"mesh": 0}], "the node 2 in two other nodes"),
    ],
)
def test_nodes_of_a_gltf_file_are_trees(nodes: list[dict[str, object]], expected: str, tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(glb_buffer())
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps({**json.loads(gltf_of("a.bin")), "nodes": nodes}))
    assert expected in refused(path)
    path.write_text(json.dumps({**json.loads(gltf_of("a.bin")), "nodes": chain(200)}))
    assert len(load_scene(path).faces) == 1


def test_nodes_of_a_binary_gltf_file_are_trees(tmp_path: Path) -> None:
    whole = trimesh.Scene([box_mesh()]).export(file_type="glb")
    length = int.from_bytes(whole[12:16], "little")
    document = json.loads(whole[20 : 20 + length])
    document["nodes"][-1]["children"] = [len(document["nodes"]) - 1]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = whole[20 + length :]
    total = (20 + len(text) + len(rest)).to_bytes(4, "little")
    (tmp_path / "a.glb").write_bytes(whole[:8] + total + len(text).to_bytes(4, "little") + b"JSON" + text + rest)
    message = refused(tmp_path / "a.glb")
    assert "form a cycle" in message or "in two other nodes" in message


@pytest.mark.parametrize("position", ["1e20", "-1e300"])
def test_stations_have_coordinates_of_a_building(position: str, tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text(
        f'[site]\nname = "a"\nscene = "a.glb"\n[[stations]]\nid = "s"\nposition_m = [{position}, 0.4, 2.6]\n'
    )
    message = refusal(SiteError, read_site, tmp_path / "site.toml")
    assert "position_m" in message


def test_nodes_that_instantiate_each_other_in_a_circle(tmp_path: Path) -> None:
    library = '<node id="a"><instance_node url="#b"/></node><node id="b"><instance_node url="#a"/></node>'
    (tmp_path / "a.dae").write_text(dae_of("1", nodes='<node><instance_node url="#a"/></node>', library=library))
    assert "in a circle" in refused(tmp_path / "a.dae")


def test_triangles_have_a_limit_that_counts_instances(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "MOST_TRIANGLES", 50)
    monkeypatch.setattr(mitsuba, "MOST_TRIANGLES", 50)
    box_mesh().export(tmp_path / "box.ply")
    shape = '<shape type="ply"><string name="filename" value="box.ply"/></shape>'
    (tmp_path / "a.xml").write_text(f"<scene>{shape * 5}</scene>")
    assert "shape 5': the scene has more than 50 triangles up to here" in refused(tmp_path / "a.xml")
    (tmp_path / "a.xml").write_text(f"<scene>{shape * 4}</scene>")
    assert len(load_scene(tmp_path / "a.xml").faces) == 48
    many = trimesh.Scene()
    for n in range(5):
        many.add_geometry(box_mesh(), geom_name="box", node_name=f"n{n}")
    many.export(tmp_path / "a.glb")
    assert "60 triangles, more than 50" in refused(tmp_path / "a.glb")


def test_defaults_do_not_multiply(tmp_path: Path) -> None:
    """A default of 1 MB that is named a million times would be 1 TB."""
    default = f'<default name="a" value="{"x" * 1_000_000}"/>'
    (tmp_path / "a.xml").write_text(f'<scene>{default}<shape type="{"$a" * 1_000_000}"/></scene>')
    assert "a default 'a' of 1,000,000 characters" in refused(tmp_path / "a.xml")


BOMB = "<!DOCTYPE a [<!ENTITY a0 'ha'>" + "".join(f"<!ENTITY a{n + 1} '{f'&a{n};' * 10}'>" for n in range(12)) + "]>"
OUTSIDE = "<!DOCTYPE a [<!ENTITY a12 SYSTEM 'file:///etc/passwd'>]>"


@pytest.mark.parametrize("declaration", [BOMB, OUTSIDE, "<!DOCTYPE a SYSTEM 'http://127.0.0.1:1/a.dtd'>"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("kind", ["dae", "xml"])
def test_entities_and_document_types_are_refused(kind: str, encoding: str, declaration: str, tmp_path: Path) -> None:
    content = dae_of("1").split("?>", 1)[1] if kind == "dae" else "<scene>&a12;</scene>"
    (tmp_path / f"a.{kind}").write_bytes((declaration + content).encode(encoding))
    expected = "not UTF-8" if (kind, encoding) == ("xml", "utf-16") else "declares a document type or entities"
    assert expected in refused(tmp_path / f"a.{kind}")


def test_a_file_that_is_no_xml_is_refused_before_its_reader_unpacks_it(tmp_path: Path) -> None:
    (tmp_path / "a.dae").write_bytes(b"PK\x03\x04" + bytes(100))
    assert "cannot be read as XML" in refused(tmp_path / "a.dae")


# Names of other files


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a scene's folder; beside it are files that are none of the scene's, all of them sound."""
    box_mesh().export(tmp_path / "outside.ply")
    (tmp_path / "outside.mtl").write_text(SECRET)
    (tmp_path / "outside.bin").write_bytes(glb_buffer())
    (tmp_path / "scene-2").mkdir()
    box_mesh().export(tmp_path / "scene-2" / "outside.ply")
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "link.ply").symlink_to(tmp_path / "outside.ply")
    (folder / "link.mtl").symlink_to(tmp_path / "outside.mtl")
    (folder / "link.bin").symlink_to(tmp_path / "outside.bin")
    return folder


def glb_buffer() -> bytes:
    return np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()


def outside_names(folder: Path, suffix: str) -> list[str]:
    names = [f"../outside.{suffix}", str(folder.parent / f"outside.{suffix}"), f"a/../../outside.{suffix}"]
    return [*names, f"link.{suffix}"]


def mitsuba_of(name: str) -> str:
    return f'<scene><shape type="ply" id="b"><string name="filename" value="{name}"/></shape></scene>'


def gltf_of(uri: str) -> str:
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "buffers": [{"uri": uri, "byteLength": 36}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "accessors": [
                {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]}
            ],
        }
    )


def obj_with(library: str) -> str:
    return f"mtllib {library}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl not-yours\nf 1 2 3\n"


WRITERS = {"xml": ("ply", mitsuba_of), "gltf": ("bin", gltf_of), "obj": ("mtl", obj_with)}


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("number", range(4))
def test_what_a_scene_names_elsewhere_is_not_read(kind: str, number: int, folder: Path) -> None:
    """Up and out, absolute, out by a detour, and through a link; each file is there and could be read."""
    suffix, write = WRITERS[kind]
    name = outside_names(folder, suffix)[number]
    (folder / "a").mkdir()
    path = folder / f"scene.{kind}"
    path.write_text(write(name))
    assert f"names the file '{name}', which is not in the scene's folder" in refused(path)


@pytest.mark.parametrize("kind", WRITERS)
def test_what_a_scene_names_in_its_folder_is_read(kind: str, folder: Path) -> None:
    """In a folder below, by a detour, and in a folder whose own name is a link, as Kubernetes mounts them."""
    suffix, write = WRITERS[kind]
    (folder / "below").mkdir()
    os.replace(folder.parent / f"outside.{suffix}", folder / "below" / f"inside.{suffix}")
    for name in (f"below/inside.{suffix}", f"./below/../below/inside.{suffix}"):
        (folder / f"scene.{kind}").write_text(write(name))
        assert len(load_scene(folder / f"scene.{kind}").faces) in (1, 12)
    linked = folder.parent / "linked"
    linked.symlink_to(folder, target_is_directory=True)
    assert load_scene(linked / f"scene.{kind}").sha256 == load_scene(folder / f"scene.{kind}").sha256
    if kind == "obj":
        assert load_scene(folder / "scene.obj").materials == ("not-yours",)


def test_a_folder_whose_name_begins_alike_is_another(folder: Path) -> None:
    (folder / "scene.xml").write_text(mitsuba_of("../scene-2/outside.ply"))
    assert "not in the scene's folder" in refused(folder / "scene.xml")


def test_a_material_file_that_came_along_is_found_under_its_former_path(folder: Path) -> None:
    os.replace(folder.parent / "outside.mtl", folder / "house.mtl")
    for name in ("/home/somebody/house.mtl", "../exports/house.mtl"):
        (folder / "scene.obj").write_text(obj_with(name))
        assert load_scene(folder / "scene.obj").materials == ("not-yours",)


def test_textures_of_a_collada_file_are_not_read(folder: Path) -> None:
    """The texture is a pipe outside the folder: opened, it would wait for a writer for ever."""
    os.mkfifo(folder.parent / "outside.png")
    images = '<library_images><image id="i"><init_from>../outside.png</init_from></image></library_images>'
    effect = """<library_effects><effect id="e"><profile_COMMON>
<newparam sid="s"><surface type="2D"><init_from>i</init_from></surface></newparam>
<newparam sid="t"><sampler2D><source>s</source></sampler2D></newparam>
<technique sid="c"><phong><diffuse><texture texture="t" texcoord="u"/></diffuse></phong></technique>
</profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>"""
    text = dae_of("1").replace("<library_geometries>", images + effect + "<library_geometries>", 1)
    (folder / "scene.dae").write_text(text)
    assert len(load_scene(folder / "scene.dae").faces) == 1


def test_a_name_that_no_file_can_have_is_not_there(folder: Path) -> None:
    for name in ("x" * 5000, "circle.ply"):
        (folder / "circle.ply").unlink(missing_ok=True)
        (folder / "circle.ply").symlink_to("circle.ply")
        (folder / "scene.xml").write_text(mitsuba_of(name))
        assert "is missing" in refused(folder / "scene.xml")


def test_a_pipe_is_no_file(folder: Path) -> None:
    """Opened, it would wait for a writer for ever."""
    os.mkfifo(folder / "pipe.mtl")
    (folder / "scene.obj").write_text(obj_with("pipe.mtl"))
    assert load_scene(folder / "scene.obj").materials in ((), ("not-yours",))


def test_the_limits_are_those_of_the_documentation() -> None:
    text = (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8")
    for limit in (
        f"{xml_limits.MOST_NESTED} deep",
        f"{mitsuba.MOST_TRIANGLES:,} triangles",
        f"{LARGEST_COORDINATE / 1000:,.0f} km",
    ):
        assert limit in text
