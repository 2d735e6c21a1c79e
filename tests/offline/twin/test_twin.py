"""What the check of a site finds, and that a sound one has no findings."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from rayfix_offline.twin.twin import Twin, refuse_errors
from rayfix_tables.errors import SceneError
from tests.support.scenes.rooms import twin_of

WriteSite = Callable[..., Path]
Stations = list[dict[str, Any]]


def messages(twin: Twin, severity: str) -> list[str]:
    """Give the findings of one severity."""
    return [finding.message for finding in twin.findings if finding.severity == severity]


def stations(*positions: tuple[float, float, float]) -> Stations:
    """Give stations ``bs1``, ``bs2``, ... at positions [m]."""
    return [{"id": f"bs{n}", "position_m": list(position)} for n, position in enumerate(positions, 1)]


FREE = ((3.6, 0.4, 2.6), (0.2, 4.8, 2.6), (2.0, 2.5, 2.6))


def test_a_sound_site(tmp_path: Path, write_site: WriteSite) -> None:
    twin = twin_of(write_site(tmp_path, stations=stations(*FREE)))
    assert twin.findings == ()
    assert twin.closed
    assert len(twin.scene.faces) == 36
    assert len(twin.planes) == 6 + 5 + 6  # the cabinet stands on the floor
    assert twin.free_space.volume == pytest.approx(60.0 - 0.8 * 1.2 * 1.8 - 1.0 * 1.3 * 0.2, rel=1e-9)
    refuse_errors(twin)


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ((0.9, 1.5, 1.0), "station 'bs4' at (0.9, 1.5, 1) m lies inside the solid 'cabinet'; move it into free space"),
        ((2.9, 3.5, 1.0), "station 'bs4' at (2.9, 3.5, 1) m lies inside the solid 'table'; move it into free space"),
        (
            (2.0, 2.0, 3.5),
            "station 'bs4' at (2, 2, 3.5) m lies outside the scene, which spans (0, 0, 0) to (4, 5, 3) m; correct "
            "position_m or scene_unit",
        ),
        (
            (2000.0, 2000.0, 2600.0),
            "station 'bs4' at (2000, 2000, 2600) m lies outside the scene, which spans (0, 0, 0) to (4, 5, 3) m; "
            "correct position_m or scene_unit",
        ),
    ],
)
def test_a_station_where_none_can_be(
    tmp_path: Path, write_site: WriteSite, position: tuple[float, float, float], expected: str
) -> None:
    twin = twin_of(write_site(tmp_path, stations=stations(*FREE, position)))
    assert messages(twin, "error") == [expected]
    assert messages(twin, "warning") == []
    with pytest.raises(SceneError, match=re.escape(expected)):
        refuse_errors(twin)


def test_a_station_in_a_wall(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    """The walls have an inner and an outer face, 0.3 m apart; the station is 0.1 m within."""
    outer = trimesh.creation.box(bounds=[(-0.3, -0.3, -0.3), (4.3, 5.3, 3.3)])
    cluttered_scene.add_geometry(outer, geom_name="shell", node_name="shell")
    twin = twin_of(write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE, (4.1, 2.0, 1.0))))
    assert messages(twin, "error") == [
        "station 'bs4' at (4.1, 2, 1) m lies outside or in the wall of 'room'; move it into free space"
    ]
    assert twin.free_space.volume == pytest.approx(60.0 - 0.8 * 1.2 * 1.8 - 1.0 * 1.3 * 0.2, rel=1e-9)


@pytest.mark.parametrize(
    ("position", "name"),
    [
        ((2.0, 2.5, 3.0), "room"),  # under the ceiling
        ((4.0, 2.2, 2.0), "room"),
        ((0.0, 0.0, 3.0), "room"),  # in a corner
        ((2.0, 2.2, 0.0004), "room"),
        ((0.9, 1.5, 1.8), "cabinet"),
        ((2.3999, 3.5, 1.0), "table"),
    ],
)
@pytest.mark.parametrize("others", [(), FREE])
def test_a_station_on_a_surface(
    tmp_path: Path,
    write_site: WriteSite,
    position: tuple[float, float, float],
    name: str,
    others: tuple[tuple[float, float, float], ...],
) -> None:
    """Half of its rays would start in the wall."""
    twin = twin_of(write_site(tmp_path, stations=stations(position, *others)))
    place = f"station 'bs1' at ({', '.join(f'{v:g}' for v in position)}) m"
    expected = f"{place} lies on the surface of '{name}'; move it a few centimetres off"
    assert [finding.message for finding in twin.findings] == [expected]


def test_a_station_on_an_open_sheet(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    cluttered_scene.geometry["table"].update_faces(np.arange(1, 12))
    twin = twin_of(write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE, (2.9, 3.0, 1.1))))
    assert messages(twin, "error") == [
        "station 'bs4' at (2.9, 3, 1.1) m lies on the surface of 'table'; move it a few centimetres off"
    ]


def test_two_millimetres_off_a_surface_is_free(tmp_path: Path, write_site: WriteSite) -> None:
    twin = twin_of(write_site(tmp_path, stations=stations((2.0, 2.5, 2.998), (0.9, 1.5, 1.802))))
    assert twin.findings == ()


def test_all_misplaced_stations_at_once(tmp_path: Path, write_site: WriteSite) -> None:
    wrong = ((0.9, 1.5, 0.7), (9.0, 9.0, 9.0))
    twin = twin_of(write_site(tmp_path, stations=stations(*FREE, *wrong)))
    assert [message.split()[1] for message in messages(twin, "error")] == ["'bs4'", "'bs5'"]
    with pytest.raises(SceneError) as caught:
        refuse_errors(twin)
    assert str(caught.value) == "; ".join(messages(twin, "error"))


def test_millimetres_taken_for_metres(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    """A hall of 8,000 x 10,000 x 6,000 units, whose stations are in metres, too."""
    cluttered_scene.apply_scale(2000.0)
    path = write_site(tmp_path, scene=cluttered_scene, stations=stations((7.2, 0.8, 5.2)))
    warnings = messages(twin_of(path), "warning")
    assert warnings == [
        'the scene is 8,000 x 10,000 x 6,000 m large; if its coordinates are millimetres, set scene_unit = "mm"'
    ]
    path = write_site(tmp_path, scene=cluttered_scene, stations=stations((7.2, 0.8, 5.2)), site={"scene_unit": "mm"})
    assert twin_of(path).findings == ()


@pytest.mark.parametrize("up", ["z", "y"])
def test_the_wrong_axis_up_is_named(
    tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene, up: str
) -> None:
    """Read with the other axis up, the room reaches from -3 to 0 m or from -5 to 0 m where the stations are above 0."""
    if up == "y":
        cluttered_scene.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2.0, [1.0, 0.0, 0.0]))
    wrong = {"z": "y", "y": "z"}[up]
    path = write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE), site={"scene_up": wrong})
    errors = [message for message in messages(twin_of(path), "error") if message.startswith("station")]
    assert len(errors) == len(FREE)
    assert all(message.endswith(f'; set scene_up = "{up}": then all stations lie inside') for message in errors)
    path = write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE), site={"scene_up": up})
    assert messages(twin_of(path), "error") == []


def test_a_toy_scene(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    cluttered_scene.apply_scale(0.1)
    twin = twin_of(write_site(tmp_path, scene=cluttered_scene, stations=stations((0.36, 0.04, 0.26))))
    assert messages(twin, "warning") == [
        "the scene is only 0.4 x 0.5 x 0.3 m large; set scene_unit to the unit of its coordinates"
    ]


def test_a_scene_that_lies_on_its_side(tmp_path: Path, write_site: WriteSite) -> None:
    """A hall of 8 x 18 x 2.5 m whose file has y up: 8 x 2.5 x 18 m as it stands."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(bounds=[(0, 0, 0), (8, 2.5, 18)]), geom_name="hall", node_name="hall")
    path = write_site(tmp_path, scene=scene, stations=stations((1, 1, 1)))
    assert messages(twin_of(path), "warning") == [
        'the scene is 8 x 2.5 x 18 m large and seems to lie on its side; if y points up, set scene_up = "y"'
    ]
    upright = twin_of(write_site(tmp_path, scene=scene, stations=stations((1, -1, 1)), site={"scene_up": "y"}))
    assert upright.findings == ()
    np.testing.assert_allclose(upright.scene.bounds, [(0, -18, 0), (8, 0, 2.5)], rtol=0, atol=1e-12)


def test_an_open_mesh(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    cabinet = cluttered_scene.geometry["cabinet"]
    cabinet.update_faces(np.arange(1, 12))
    twin = twin_of(write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE)))
    assert messages(twin, "warning") == [
        "open parts without an inside: cabinet; they reflect, but count as sheets and not as solids; close them if "
        "they are solid"
    ]
    assert twin.closed
    assert twin.free_space.volume == pytest.approx(60.0 - 1.0 * 1.3 * 0.2, rel=1e-9)


def test_a_room_without_a_ceiling(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    room = cluttered_scene.geometry["room"]
    room.update_faces(room.triangles[:, :, 2].min(axis=1) < 3.0)
    twin = twin_of(write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE)))
    assert len(twin.scene.faces) == 34
    assert not twin.closed
    assert messages(twin, "error") == []
    assert "open parts without an inside: room" in messages(twin, "warning")[0]


def test_an_inverted_solid(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    cluttered_scene.geometry["table"].invert()
    twin = twin_of(write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE)))
    assert messages(twin, "warning") == ["solids whose triangles face inwards: table; harmless here, but mend the mesh"]
    assert twin.free_space.volume == pytest.approx(60.0 - 0.8 * 1.2 * 1.8 - 1.0 * 1.3 * 0.2, rel=1e-9)


def test_a_mixed_up_solid(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    table = cluttered_scene.geometry["table"]
    table.faces[3] = table.faces[3, ::-1]
    twin = twin_of(write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE)))
    assert messages(twin, "warning") == [
        "parts whose triangles face different ways: table; harmless here, but mend the mesh"
    ]


def test_many_names_are_cut_short(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    for n in range(8):
        crate = trimesh.creation.box(bounds=[(0.3 * n, 4.0, 0.0), (0.3 * n + 0.2, 4.2, 0.2)])
        crate.invert()
        cluttered_scene.add_geometry(crate, geom_name=f"crate{n}", node_name=f"crate{n}")
    (warning,) = messages(twin_of(write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE))), "warning")
    listed = re.search(r"inwards: (.*);", warning)
    assert listed
    assert len(re.findall(r"crate\d", listed[1])) == 4
    assert listed[1].endswith(" and 4 more")


def test_degenerate_triangles(tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene) -> None:
    cabinet = cluttered_scene.geometry["cabinet"]
    cluttered_scene.geometry["cabinet"] = trimesh.Trimesh(
        cabinet.vertices, [*cabinet.faces, (0, 0, 1), (2, 2, 2)], process=False
    )
    twin = twin_of(write_site(tmp_path, scene=cluttered_scene, stations=stations(*FREE)))
    assert messages(twin, "warning") == ["2 triangles have no area and are removed; clean the mesh"]


def test_no_free_space(tmp_path: Path, write_site: WriteSite) -> None:
    """A block fills the room up to a gap of 20 mm, in which the station is."""
    scene = trimesh.Scene()
    gap = 0.02
    block = trimesh.creation.box(bounds=[(gap, gap, gap), (4 - gap, 5 - gap, 3 - gap)])
    for name, mesh in (("room", trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)])), ("block", block)):
        scene.add_geometry(mesh, geom_name=name, node_name=name)
    sites = [(gap / 2, 2.2, 1.1)], [(gap / 2, 2.2, 1.1), (2.0, 2.2, 1.1), (2.1, 2.2, 1.1)]
    alone, most_inside = (twin_of(write_site(tmp_path, scene=scene, stations=stations(*site))) for site in sites)
    assert messages(alone, "error") == [
        "the scene has no free space: every voxel lies in a solid or outside; check for an inverted room"
    ]
    # Where most stations are inside the block, it counts as the building, and the one in the gap is misplaced.
    assert [message.split(";")[0] for message in messages(most_inside, "error")] == [
        "station 'bs1' at (0.01, 2.2, 1.1) m lies outside or in the wall of 'block'"
    ]


def test_a_missing_scene(tmp_path: Path, write_site: WriteSite) -> None:
    path = write_site(tmp_path, site={"scene": "none.glb"})
    with pytest.raises(SceneError, match=re.escape(f"there is no scene at {tmp_path / 'none.glb'}")):
        twin_of(path)
