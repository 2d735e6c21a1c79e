"""What ``rayfix check`` adds to the findings of the twin: rays that leave the scene, and the form of the answer."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from rayfix.cli import main
from rayfix_offline.check import check_site
from rayfix_offline.rays.lost_rays import find_escapes
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import prepare_twin

WriteSite = Callable[..., Path]


def room_with_a_hole(low: tuple[float, float], high: tuple[float, float]) -> trimesh.Scene:
    """Room of 4 x 5 x 3 m with a rectangular hole in its ceiling."""
    (x0, y0), (x1, y1) = low, high
    box = trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)])
    box.update_faces(box.triangles[:, :, 2].min(axis=1) < 3.0)
    frame = [((0, 0), (4, y0)), ((0, y1), (4, 5)), ((0, y0), (x0, y1)), ((x1, y0), (4, y1))]
    meshes = [box]
    for (ax, ay), (bx, by) in frame:
        corners = [(ax, ay, 3), (bx, ay, 3), (bx, by, 3), (ax, by, 3)]
        meshes.append(trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)]))
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.util.concatenate(meshes), geom_name="room", node_name="room")
    return scene


def solid_angle(low: tuple[float, float], high: tuple[float, float], height: float) -> float:
    """Solid angle of a horizontal rectangle, seen from the origin, which lies ``height`` below it."""

    def corner(x: float, y: float) -> float:
        return float(np.arctan(x * y / (height * np.sqrt(x * x + y * y + height * height))))

    (x0, y0), (x1, y1) = low, high
    return corner(x1, y1) - corner(x0, y1) - corner(x1, y0) + corner(x0, y0)


def test_the_share_of_rays_through_a_hole(tmp_path: Path, write_site: WriteSite) -> None:
    """Without reflections it is the hole's share of the sphere."""
    low, high = (1.0, 2.0), (1.6, 2.6)
    station = np.array([2.0, 1.5, 1.2])
    path = write_site(
        tmp_path,
        scene=room_with_a_hole(low, high),
        stations=[{"id": "bs1", "position_m": station.tolist()}],
        propagation={"max_reflections": 0},
    )
    site = read_site(path)
    escapes = find_escapes(site.stations[0], prepare_twin(site, path.parent), max_reflections=0)
    expected = solid_angle(tuple(low - station[:2]), tuple(high - station[:2]), 1.8) / (4.0 * np.pi)
    assert escapes.share == pytest.approx(expected, rel=0.1)
    assert escapes.side == "+z"
    assert escapes.side_share == 1.0
    assert escapes.place is not None
    assert escapes.place[2] == pytest.approx(3.0, abs=1e-9)
    assert np.all((np.array(escapes.place[:2]) > low) & (np.array(escapes.place[:2]) < high))
    assert escapes.place_share > 0.3


def test_more_rays_find_the_hole_after_reflections(tmp_path: Path, write_site: WriteSite) -> None:
    path = write_site(tmp_path, scene=room_with_a_hole((1.0, 2.0), (1.6, 2.6)))
    site = read_site(path)
    twin = prepare_twin(site, path.parent)
    shares = [find_escapes(site.stations[0], twin, max_reflections=n).share for n in range(3)]
    assert 0.0 < shares[0] < shares[1] < shares[2]


def test_a_closed_room_loses_no_ray(tmp_path: Path, write_site: WriteSite) -> None:
    check = check_site(write_site(tmp_path))
    assert check.findings == ()
    (escapes,) = check.escapes
    assert escapes.share < 1e-3
    assert check.num_errors == 0


def test_the_finding_names_station_and_place(tmp_path: Path, write_site: WriteSite) -> None:
    path = write_site(tmp_path, scene=room_with_a_hole((1.0, 2.0), (3.0, 4.0)))
    (hole,) = [finding for finding in check_site(path).findings if finding.kind == "hole"]
    assert hole.station_id == "bs1"
    assert hole.severity == "warning"
    assert "of the rays of station 'bs1' leave the scene, 100% of them towards +z" in hole.problem
    assert ", 3.0) m" in hole.problem


def test_the_command(tmp_path: Path, write_site: WriteSite, capsys: pytest.CaptureFixture[str]) -> None:
    """A line for each finding, and the same as JSON; status 2 where a build would stop."""
    wrong = [{"id": "bs1", "position_m": [0.9, 1.5, 0.7]}, {"id": "bs2", "position_m": [3.6, 0.4, 2.6]}]
    path = write_site(tmp_path, stations=wrong, propagation={"reflection": "itu"})
    assert main(["check", str(path)]) == 2
    lines = capsys.readouterr().out.splitlines()
    starts = [line.split(":")[0] for line in lines]
    assert starts == ["warning", "error", "rays that leave the scene", "windows of 10 deg", str(path)]
    assert main(["check", str(path), "--json"]) == 2
    document = json.loads(capsys.readouterr().out)
    assert [(f["severity"], f["kind"], f["station_id"]) for f in document["findings"]] == [
        ("warning", "material", None),
        ("error", "station", "bs1"),
    ]
    assert [station["id"] for station in document["stations"]] == ["bs2"]
    assert document["scene"]["closed"] is True
    assert document["scene"]["size_m"] == [4.0, 5.0, 3.0]
    assert document["scene"]["triangles"] == 36
    assert document["windows"] == {
        "windows_deg": [10.0],
        "best_up_to_deg": 8.0,
        "integrated_from_deg": 12.8,
        "unknown_clocks_quick_up_to_deg": 8.0,
    }


def write_far_room(folder: Path, shift: NDArray[np.float64], *, file_type: str) -> Path:
    """Write a room of 4 x 5 x 3 m with one station, moved by a vector."""
    room = trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)])
    room.invert()
    if file_type == "obj":
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in (room.vertices + shift).tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in room.faces + 1]
        (folder / "room.obj").write_text("\n".join(lines))
    else:
        moved = trimesh.Scene()
        if file_type == "glb":  # moved by its node
            moved.add_geometry(room, node_name="room", transform=trimesh.transformations.translation_matrix(shift))
        else:
            moved.add_geometry(room.apply_translation(shift), node_name="room")
        (folder / f"room.{file_type}").write_bytes(moved.export(file_type=file_type))
    station = np.add(shift, (3.6, 0.4, 2.6)).round(3).tolist()
    path = folder / "site.toml"
    path.write_text(
        f'[site]\nname = "a"\nscene = "room.{file_type}"\n[propagation]\nmax_reflections = 2\n'
        f'[[stations]]\nid = "s"\nposition_m = {station}\n'
    )
    return path


@pytest.mark.parametrize("file_type", ["obj", "glb"])
@pytest.mark.parametrize("distance", [50_000.0, 5_412_330.0])
def test_a_sound_scene_on_map_coordinates_has_no_finding(distance: float, file_type: str, tmp_path: Path) -> None:
    path = write_far_room(tmp_path, np.array([300.0, distance, 12.0]), file_type=file_type)
    check = check_site(path)
    assert check.findings == ()
    assert [escapes.share for escapes in check.escapes] == [0.0]


def test_map_coordinates_in_single_precision_are_told(tmp_path: Path) -> None:
    """Walls of such a file lie where single precision has a number."""
    path = write_far_room(tmp_path, np.array([448_250.3, 5_412_330.2, 12.0]), file_type="stl")
    (finding,) = [finding for finding in check_site(path).findings if finding.kind == "precision"]
    assert finding.severity == "warning"
    assert "that they have steps of up to 0.5 m" in finding.problem
    near = write_far_room(tmp_path, np.array([20_000.0, 30_000.0, 12.0]), file_type="stl")
    assert not [finding for finding in check_site(near).findings if finding.kind == "precision"]
