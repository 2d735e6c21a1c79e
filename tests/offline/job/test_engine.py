"""Whoever fits the cells, each station's rays are traced once."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rayfix_offline.build import build_table
from rayfix_offline.job import engine, previous_table
from rayfix_offline.rays.trace import StationTrace, trace_station
from rayfix_offline.site import StationSection
from tests.support.scenes.rooms import room_with_crate

WriteSite = Callable[..., Path]
TWO = [{"id": "bs1", "position_m": [3.6, 0.4, 2.6]}, {"id": "bs2", "position_m": [0.2, 4.8, 2.6]}]


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Return the list that each trace of a station is written to: in the new or in the former scene, and which."""
    found: list[tuple[str, str]] = []

    def recording(scene: str) -> Callable[..., StationTrace]:
        def trace(station: StationSection, *arguments: Any, **settings: Any) -> StationTrace:
            found.append((scene, station.id))
            return trace_station(station, *arguments, **settings)

        return trace

    monkeypatch.setattr(engine, "trace_station", recording("new"))
    monkeypatch.setattr(previous_table, "trace_station", recording("former"))
    return found


def test_rays_are_traced_once(traced: list[tuple[str, str]], tmp_path: Path, write_site: WriteSite) -> None:
    site = write_site(tmp_path, stations=TWO, table={"windows_deg": [10.0, 25.0]})
    build_table(site, tmp_path / "t.h5", jobs=1)
    assert traced == [("new", "bs1"), ("new", "bs2")]


def test_an_update_traces_each_scene_once(traced: list[tuple[str, str]], tmp_path: Path, write_site: WriteSite) -> None:
    site = write_site(tmp_path, scene=room_with_crate().scene(), table={"windows_deg": [10.0]})
    build_table(site, tmp_path / "t.h5", jobs=1)
    traced.clear()
    site = write_site(tmp_path, scene=room_with_crate(1.1).scene(), table={"windows_deg": [10.0]})
    (station,) = build_table(site, tmp_path / "t.h5", jobs=1).stations
    assert station.origin == "updated"
    assert sorted(traced) == [("former", "bs1"), ("new", "bs1")]
