"""The files of the bundled example."""

import tomllib
from pathlib import Path

import pytest

from rayfix.example.files import write_example
from rayfix.example.hall import hall_stations
from rayfix.example.office import OFFICE_SIZE, office_stations
from rayfix_offline.rays.trace import scene_walls
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import prepare_twin


def test_the_site_file_has_the_stations_of_the_hall_which_look_diagonally_into_it(tmp_path: Path) -> None:
    site = tomllib.loads(write_example(tmp_path).read_text(encoding="utf-8"))
    assert [(s["id"], tuple(s["position_m"])) for s in site["stations"]] == hall_stations()
    for station in site["stations"]:
        x, y, _ = station["position_m"]
        bearing, *rest = station["boresight_azimuth_deg"], station["boresight_downtilt_deg"]
        assert bearing == {(True, True): 45, (False, True): 135, (False, False): -135, (True, False): -45}[x < 4, y < 9]
        assert rest == [0]
    assert site["table"]["windows_deg"] == [1.25, 5, 15]


@pytest.mark.parametrize("windows", [(2.5, 10.0), (15.0,)])
def test_other_windows_change_nothing_else(tmp_path: Path, windows: tuple[float, ...]) -> None:
    usual = tomllib.loads(write_example(tmp_path / "usual").read_text(encoding="utf-8"))
    site = tomllib.loads(write_example(tmp_path / "other", windows_deg=windows).read_text(encoding="utf-8"))
    assert site["table"].pop("windows_deg") == list(windows)
    usual["table"].pop("windows_deg")
    assert site == usual


def test_the_office_is_closed_and_its_walls_but_no_cabinet_let_signals_through(tmp_path: Path) -> None:
    path = write_example(tmp_path, example="office")
    site = read_site(path)
    assert [(s.id, s.position_m) for s in site.stations] == office_stations()
    twin = prepare_twin(site, path.parent)
    assert twin.closed
    assert not [finding for finding in twin.findings if finding.severity == "error" or finding.kind == "facing"]
    assert tuple(twin.scene.bounds[1]) == pytest.approx(OFFICE_SIZE, abs=1e-6)
    passable = scene_walls(site, twin).passable
    materials = [twin.scene.materials[n] for n in twin.scene.face_materials]
    assert {m for m, lets in zip(materials, passable, strict=True) if lets} == {
        "itu_concrete",
        "itu_plasterboard",
        "itu_glass",
        "itu_wood",
    }
    assert {m for m, lets in zip(materials, passable, strict=True) if not lets} == {"itu_metal"}
    # Cabinets alone are solids.
    assert {materials[n] for n in range(len(materials)) if twin.solid[n] >= 0} == {"itu_metal"}
