"""Any valid report gets a sound answer."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    HEAVY_TAILED,
    Angle,
    ErrorModel,
    Frame,
    Height,
    LogRange,
    MeasuredPath,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.locator import Locator
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table

STATIONS = ("bs1", "bs2", "bs3", "bs4")

station = st.sampled_from(STATIONS)
azimuth = st.one_of(st.floats(-math.pi, math.pi), st.sampled_from([math.pi, -3.14159, 0.0, math.pi / 2]))
zenith = st.one_of(st.floats(0.0, math.pi), st.sampled_from([0.0, math.pi, 1e-12, math.pi / 2]))
angle_stdev = st.one_of(st.floats(0.01, 60.0), st.sampled_from([0.01, 1.0, 12.0, 60.0])).map(math.radians)
time_stdev = st.one_of(st.floats(1e-3, 100.0), st.sampled_from([1e-3, 0.5, 100.0]))
frame = st.sampled_from(["scene", "north", "lcs"])

error_model = st.sampled_from([GAUSSIAN, GAUSSIAN, HEAVY_TAILED, ErrorModel(tail_share=0.5, tail_scale=20.0)])

angle = st.builds(
    Angle,
    station_id=station,
    azimuth=azimuth,
    zenith=zenith,
    azimuth_stdev=angle_stdev,
    zenith_stdev=angle_stdev,
    correlation=st.floats(-0.99, 0.99),
    frame=frame,
    error_model=error_model,
)
azimuth_only = st.builds(
    Angle, station_id=station, azimuth=azimuth, azimuth_stdev=angle_stdev, frame=frame, error_model=error_model
)
propagation_time = st.one_of(
    st.builds(Range, station_id=station, path_length=st.floats(0.01, 100.0), stdev=time_stdev, error_model=error_model),
    st.builds(LogRange, station_id=station, path_length=st.floats(0.01, 100.0), log_stdev=st.floats(0.01, 1.5)),
)


@st.composite
def arrivals(draw: st.DrawFn) -> list[Measurement]:
    """Draw times of arrival of a clock that shows anything; some of them may be far off."""
    clock = draw(st.sampled_from([0.0, 123.4, -1e8, 1e8]))
    return [
        TimeOfArrival(
            station_id=name,
            path_length=clock + draw(st.floats(0.0, 60.0)) + off,
            stdev=draw(time_stdev),
            error_model=draw(error_model),
        )
        for name in draw(st.lists(station, max_size=4))
        for off in [draw(st.sampled_from([0.0, 0.0, 0.0, 1e4, -1e8]))]
    ]


@st.composite
def differences(draw: st.DrawFn) -> list[Measurement]:
    pairs = draw(st.lists(st.tuples(station, station).filter(lambda pair: pair[0] != pair[1]), max_size=3))
    return [
        TimeDifference(
            station_id=first,
            reference_station_id=second,
            length_difference=draw(st.one_of(st.floats(-60.0, 60.0), st.sampled_from([1e4, -1e6]))),
            stdev=draw(time_stdev),
            error_model=draw(error_model),
        )
        for first, second in pairs
    ]


reports = st.builds(
    lambda *parts: Report(measurements=tuple(m for part in parts[:-1] for m in part), height=parts[-1]),
    st.lists(angle, max_size=5),
    st.lists(azimuth_only, max_size=1),
    st.lists(propagation_time, max_size=4),
    arrivals(),
    differences(),
    st.none() | st.builds(Height, z=st.floats(-0.5, 3.0), stdev=st.one_of(st.floats(0.2, 10.0), st.just(1e3))),
)


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> Locator:
    return Locator(Table.open(hall_table_path))


def assert_sound(fix: Fix, report: Report) -> None:
    assert math.isfinite(fix.log_evidence)
    assert fix.status in ("ok", "ambiguous", "inconsistent", "insufficient")
    probabilities = [candidate.probability for candidate in fix.candidates]
    assert sorted(probabilities, reverse=True) == probabilities
    assert sum(probabilities) <= 1.0 + 1e-9
    for candidate in fix.candidates:
        assert 0.0 <= candidate.probability <= 1.0
        assert np.isfinite(candidate.position).all()
        # Nothing in the table is farther away than the longest path.
        assert (np.abs(candidate.position - [4.0, 9.0, 1.25]) < 70.0).all()
        assert np.isfinite(candidate.covariance).all()
        largest = np.abs(candidate.covariance).max()
        np.testing.assert_allclose(candidate.covariance, candidate.covariance.T, rtol=0, atol=1e-12 * largest)
        assert np.linalg.eigvalsh(candidate.covariance)[0] > 0.0
    assert len(fix.outcomes) == len(report.measurements)
    for outcome in fix.outcomes:
        if outcome.used:
            assert outcome.reason is None
            assert outcome.outlier_probability is not None
            assert 0.0 <= outcome.outlier_probability <= 1.0
        else:
            assert outcome.reason
            assert outcome.outlier_probability is None
    if not any(outcome.used for outcome in fix.outcomes):
        assert (fix.status, fix.candidates) == ("insufficient", ())
    elif not fix.candidates:
        assert fix.status == "inconsistent"


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(report=reports)
def test_any_report_gets_a_sound_fix(locator: Locator, report: Report) -> None:
    """Or is told to contradict or to repeat itself."""
    try:
        fix = locator.locate(report)
    except ReportError as error:
        refusal = error
    else:
        assert_sound(fix, report)
        return
    assert re.search("contradicts|repeats|too many measurements", str(refusal))
    assert refusal.path[0] == "measurements"


@pytest.mark.parametrize("stdev_deg", [1e-6, 360.0])
@pytest.mark.parametrize("stdev", [1e-6, 1e6])
def test_the_extremes_of_the_interface_get_a_sound_fix(locator: Locator, stdev_deg: float, stdev: float) -> None:
    spread = math.radians(stdev_deg)
    angles = [
        Angle(station_id=name, azimuth=a, zenith=1.7, azimuth_stdev=spread, zenith_stdev=spread)
        for name, a in zip(STATIONS, (0.9, 2.2, -2.2, -0.9), strict=True)
    ]
    ranges = [Range(station_id=name, path_length=9.0, stdev=stdev) for name in STATIONS]
    times = [TimeOfArrival(station_id=name, path_length=1e12 + 9.0, stdev=stdev) for name in STATIONS]
    for timing in (ranges, times, [*ranges, *times]):
        report = Report(measurements=(*angles, *timing))
        assert_sound(locator.locate(report), report)


@pytest.mark.parametrize("zenith", [0.0, 6.5e-192, 1e-12, np.pi])
@pytest.mark.parametrize("frame", ["scene", "lcs", "north"])
@pytest.mark.parametrize("stdev", [1e-4, 0.02, 1.0, 5.0])
def test_a_direction_at_a_pole_has_a_sound_fix(locator: Locator, zenith: float, frame: Frame, stdev: float) -> None:
    """Straight up or down, densities over azimuth and zenith were divided by a sine of zero."""
    angle = {"azimuth": np.pi / 4.0, "azimuth_stdev": stdev, "zenith": zenith, "zenith_stdev": stdev}
    for station in locator.table.site.stations:
        measured = Angle(station_id=station.id, frame=frame, **angle)
        for others in ((), (Range(station_id=station.id, path_length=2.0, stdev=0.5),)):
            fix = locator.locate(Report(measurements=(measured, *others)))
            assert np.isfinite(fix.log_evidence)
            assert all(np.isfinite(each.position).all() for each in fix.candidates)
        if locator.table.parts[station.id].paths is not None:
            path = MeasuredPath(station_id=station.id, frame=frame, **angle)
            several = Report(measurements=(path, replace(path, azimuth=1.0)))
            assert np.isfinite(locator.locate(several).log_evidence)
