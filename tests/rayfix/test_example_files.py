"""The files of the bundled example."""

import tomllib
from pathlib import Path

import pytest

from rayfix.example.files import write_example
from rayfix.example.hall import hall_stations


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
