"""Angles that a constant turn makes agree: of one station or of all, in the bundled hall at a place that three see."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rayfix_service.fusion.diagnosis.common_turn import common_turns
from rayfix_service.fusion.diagnosis.turned import find_turns, turned_report
from rayfix_service.fusion.measurements.directions import to_scene
from rayfix_service.fusion.measurements.report import Angle, Frame, Measurement, Range, Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from rayfix_tables.geometry.angles import angles_of, local_to_scene
from rayfix_tables.site import Station
from rayfix_tables.table import Table

UE = np.array([7.0, 4.0, 1.5])
DEG = np.pi / 180
ERRORS = {"bs1": (0.6, -0.4, 0.2), "bs2": (-0.5, 0.8, -0.3), "bs3": (0.2, 0.5, 0.4)}
"""Of azimuth and zenith, deg, and of the length, m."""


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> Locator:
    return Locator(Table.open(hall_table_path))


def heard(station: Station, turn: float, frame: Frame = "scene") -> list[Measurement]:
    """Angle and propagation time of the straight path to a station whose angles lack a turn, deg."""
    apart = UE - np.array(station.position)
    azimuth_error, zenith_error, length_error = ERRORS[station.id]
    local = apart @ local_to_scene(station.orientation) if frame == "lcs" else apart
    azimuth, zenith = (float(angle) for angle in angles_of(local))
    return [
        Angle(
            station_id=station.id,
            azimuth=azimuth + (azimuth_error - turn) * DEG,
            zenith=zenith + zenith_error * DEG,
            azimuth_stdev=DEG,
            zenith_stdev=DEG,
            frame=frame,
        ),
        Range(station_id=station.id, path_length=float(np.linalg.norm(apart)) + length_error, stdev=0.5),
    ]


def report_of(locator: Locator, turns: dict[str, float], frame: Frame = "scene") -> Report:
    stations = locator.table.site.station_by_id
    return Report(measurements=tuple(m for name, turn in turns.items() for m in heard(stations[name], turn, frame)))


@pytest.mark.parametrize("frame", ["scene", "lcs"])
@pytest.mark.parametrize("turn", [40.0, -75.0])
def test_a_turn_of_all_stations_is_told(locator: Locator, turn: float, frame: Frame) -> None:
    fix = locator.locate(report_of(locator, dict.fromkeys(ERRORS, turn), frame))
    assert fix.status == "inconsistent"
    told = [text for text in fix.warnings if "would agree" in text]
    assert len(told) == 1
    assert "the angles of all stations by" in told[0]
    assert "north_deg" in told[0]
    stated = float(told[0].split("all stations by ")[1].split(" ")[0])
    assert stated == pytest.approx(turn, abs=3.0)  # deg


def test_a_turn_of_one_station_is_told(locator: Locator) -> None:
    """Of two, as of more the others outvote it."""
    fix = locator.locate(report_of(locator, {"bs1": 0.0, "bs2": 120.0}))
    assert fix.status == "inconsistent"
    told = next(text for text in fix.warnings if "would agree" in text)
    assert "the angles of station 'bs2' by +1" in told


def test_consistent_reports_take_no_further_fix(locator: Locator) -> None:
    report = report_of(locator, dict.fromkeys(ERRORS, 0.0))
    fix = locator.locate(report)
    assert (fix.status, fix.warnings) == ("ok", ())
    assert locator.explain(report, fix) is fix


def test_nothing_is_told_of_contradictions_that_no_turn_mends(locator: Locator) -> None:
    report = report_of(locator, dict.fromkeys(ERRORS, 40.0))
    late = [replace(m, path_length=m.path_length + 9.0) if isinstance(m, Range) else m for m in report.measurements]
    fix = locator.locate(replace(report, measurements=tuple(late)))
    assert fix.status == "inconsistent"
    assert not any("would agree" in text for text in fix.warnings)


def test_the_search_is_bounded(locator: Locator) -> None:
    report = report_of(locator, dict.fromkeys(ERRORS, 40.0))
    fix = locator.fuse(report).fix
    for most in (0, 1, 5):
        calls: list[Report] = []

        def relocate(changed: Report, turns: Mapping[str, float], calls: list[Report] = calls) -> Fix:
            calls.append(changed)
            return locator.fuse(turned_report(changed, locator.table.site, turns)[0]).fix

        assert len(find_turns(report, fix, locator.table.site, relocate, most_fixes=most)) <= 1
        assert len(calls) <= most
    assert Locator(locator.table, FusionSettings(most_turn_fixes=0)).explain(report, fix) is fix


def test_too_few_measurements_propose_no_turn(locator: Locator) -> None:
    """Two angles have four quantities, which a position and a turn can always meet."""
    site = locator.table.site
    report = report_of(locator, {"bs1": 40.0, "bs2": 40.0})
    angles = tuple(m for m in report.measurements if isinstance(m, Angle))
    assert common_turns(Report(measurements=angles), site, most=3) == []
    proposed = common_turns(report, site, most=3)
    assert proposed[0].angle == pytest.approx(40 * DEG, abs=3 * proposed[0].stdev)


@pytest.mark.parametrize("frame", ["scene", "north", "lcs"])
def test_a_turn_is_about_the_vertical_in_every_frame(locator: Locator, frame: Frame) -> None:
    site = locator.table.site
    tilted = tuple(replace(s, orientation=(s.orientation[0], 0.3, -0.2)) for s in site.stations)
    site = replace(site, stations=tilted)
    angle = Angle(station_id="bs2", azimuth=0.4, zenith=1.3, azimuth_stdev=0.01, zenith_stdev=0.01, frame=frame)
    before = to_scene(angle, site.station_by_id["bs2"], site.north)
    report, turned = turned_report(Report(measurements=(angle,)), site, {"bs2": 0.5})
    (moved,) = report.measurements
    assert isinstance(moved, Angle)
    after = to_scene(moved, turned.station_by_id["bs2"], turned.north)
    assert before.azimuth is not None
    assert after.azimuth is not None
    assert np.exp(1j * after.azimuth) == pytest.approx(np.exp(1j * (before.azimuth + 0.5)), abs=1e-12)
    assert after.zenith == pytest.approx(before.zenith, abs=1e-12)
