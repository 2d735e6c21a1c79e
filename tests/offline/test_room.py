"""Rooms without a mesh: the scene, its materials, and stations on the walls."""

from pathlib import Path

import numpy as np
import pytest

from rayfix_offline.build import build_table
from rayfix_offline.scene.room import room_scene
from rayfix_offline.site import OFF_WALL, parse_site, read_site
from rayfix_offline.site_sections import RoomSection
from rayfix_offline.twin.twin import prepare_twin
from rayfix_tables.errors import SiteError
from rayfix_tables.table import Table

SITE = """
[site]
name = "lab"
[room]
size_m = [6.0, 5.0, 2.8]
walls = "concrete"
floor = "wood"
[propagation]
max_reflections = 1
max_path_length_m = 20.0
[table]
windows_deg = [15.0]
[[stations]]
id = "middle"
position_m = [0.0, 2.0, 2.0]
[[stations]]
id = "corner"
position_m = [6.0, 5.0, 2.8]
[[stations]]
id = "inside"
position_m = [3.0, 2.5, 2.0]
"""


def test_a_room_is_a_closed_box_with_its_materials() -> None:
    scene = room_scene(RoomSection(size_m=(6.0, 5.0, 2.8), walls="concrete", floor="wood"))
    assert scene.bounds.tolist() == [[0.0, 0.0, 0.0], [6.0, 5.0, 2.8]]
    a, b, c = scene.triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    middle = np.array([3.0, 2.5, 1.4])
    facing = np.einsum("ij,ij->i", normal, middle - a)
    assert np.all(facing > 0.0) or np.all(facing < 0.0)
    areas = 0.5 * np.linalg.norm(normal, axis=1)
    names = np.array([*scene.materials, ""])[scene.face_materials]
    heights = scene.triangles[:, :, 2]
    assert areas[names == "concrete"].sum() == pytest.approx(2 * 2.8 * 11.0)
    assert areas[names == "wood"].sum() == pytest.approx(30.0)
    assert np.all(heights[names == "wood"] == 0.0)
    assert areas[names == ""].sum() == pytest.approx(30.0)
    assert np.all(heights[names == ""] == 2.8)


def test_stations_on_walls_are_moved_off_and_said_to_be(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(SITE, encoding="utf-8")
    build_table(path, tmp_path / "lab.h5", jobs=1)
    table = Table.open(tmp_path / "lab.h5")
    positions = {s.id: s.position for s in table.site.stations}
    assert positions["middle"] == pytest.approx((OFF_WALL, 2.0, 2.0), abs=1e-12)
    assert positions["corner"] == pytest.approx((6.0 - OFF_WALL, 5.0 - OFF_WALL, 2.8 - OFF_WALL), abs=1e-12)
    assert positions["inside"] == (3.0, 2.5, 2.0)
    assert table.scene.free_space.volume == pytest.approx(84.0, rel=0.01)
    for part in table.parts.values():
        assert part.lost_ray_share < 1e-3
    twin = prepare_twin(parse_site(table.site.document), tmp_path)
    (finding,) = [f for f in twin.findings if "wall" in f.message]
    assert finding.severity == "warning"
    assert "middle, corner: on a wall of the room, moved off it by 1 mm" in finding.message


def warnings_of(text: str, folder: Path) -> dict[str, str]:
    path = folder / "site.toml"
    path.write_text(text, encoding="utf-8")
    return {found.kind: found.message for found in prepare_twin(read_site(path), folder).findings}


def test_materials_that_count_for_nothing_are_said(tmp_path: Path) -> None:
    """Tables with and without materials were the same, and a name that does not exist passed."""
    constant = warnings_of(SITE, tmp_path)
    assert "not looked up: 'concrete', 'wood'" in constant["material"]
    by_material = SITE.replace("[propagation]", '[propagation]\nreflection = "itu"')
    assert "not looked up" not in warnings_of(by_material, tmp_path)["material"]
    assert "'wod' unknown" in warnings_of(by_material.replace('"wood"', '"wod"'), tmp_path)["material"]
    assert "material" not in warnings_of(SITE.replace('walls = "concrete"\nfloor = "wood"', ""), tmp_path)


def test_sizes_in_centimetres_and_short_paths_are_said(tmp_path: Path) -> None:
    plain = warnings_of(SITE, tmp_path)
    assert not {"unit", "short paths"} & set(plain)
    large = warnings_of(SITE.replace("[6.0, 5.0, 2.8]", "[600.0, 500.0, 280.0]"), tmp_path)
    assert "size_m is in metres" in large["unit"]
    short = warnings_of(SITE.replace("max_path_length_m = 20.0", "max_path_length_m = 5.0"), tmp_path)
    assert "'middle', 'corner'; give 8.3 at least" in short["short paths"]


@pytest.mark.parametrize(
    ("room", "scene", "message"),
    [
        (None, None, "site.scene is missing"),
        ({"size_m": [1, 1, 1]}, "hall.glb", "give one of them"),
        ({"size_m": [1, 1, 0]}, None, "size_m"),
        ({"size_m": "7x5"}, None, "room.size_m = '7x5': give a list of numbers"),
        ({"size_m": [1, 1, 1], "wall": "wood"}, None, "unknown key room.wall"),
    ],
)
def test_scenes_that_are_not_clear(room: object, scene: str | None, message: str) -> None:
    document: dict[str, object] = {
        "site": {"name": "a"} | ({} if scene is None else {"scene": scene}),
        "stations": [{"id": "a", "position_m": [0.5, 0.5, 0.5]}],
    }
    if room is not None:
        document["room"] = room
    with pytest.raises(SiteError, match=message):
        parse_site(document)
