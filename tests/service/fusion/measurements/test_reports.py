"""Sorting a report: which measurements belong together, frames, fields of view, clocks."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.directions import (
    NO_DIRECTION,
    Direction,
    in_field_of_view,
    to_scene,
    without_bias,
)
from rayfix_service.fusion.measurements.observations import SortedReport, sort_report
from rayfix_service.fusion.measurements.report import (
    HEAVY_TAILED,
    Angle,
    Frame,
    LogRange,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_tables.errors import ReportError
from rayfix_tables.geometry.angles import direction, local_to_scene, wrap
from rayfix_tables.site import SiteInfo, Station, StationBias

ORIGIN = (0.0, 0.0, 0.0)
SITE = SiteInfo(
    name="s",
    north=0.0,
    max_path_length=50.0,
    stations=(
        Station(id="a", position=ORIGIN),
        Station(id="b", position=ORIGIN),
        Station(id="c", position=ORIGIN, orientation=(np.pi / 2, 0.0, 0.0), field_of_view=np.pi / 2),
        Station(id="d", position=ORIGIN),
    ),
)


def sort(*measurements: Measurement) -> SortedReport:
    return sort_report(Report(measurements=measurements), SITE)


def angle(station_id: str, azimuth: float = 1.0, frame: Frame = "scene") -> Angle:
    return Angle(station_id=station_id, azimuth=azimuth, zenith=1.5, azimuth_stdev=0.02, zenith_stdev=0.03, frame=frame)


def toa(station_id: str, path_length: float, stdev: float = 0.5) -> TimeOfArrival:
    return TimeOfArrival(station_id=station_id, path_length=path_length, stdev=stdev)


def tdoa(station_id: str, reference: str, difference: float, stdev: float = 1.0) -> TimeDifference:
    return TimeDifference(
        station_id=station_id, reference_station_id=reference, length_difference=difference, stdev=stdev
    )


def turned(
    azimuth_deg: float,
    zenith_deg: float | None,
    *,
    frame: Frame,
    orientation_deg: tuple[float, float, float] = ORIGIN,
    north_deg: float = 0.0,
    stdev_deg: tuple[float, float] = (1.0, 2.0),
) -> Direction:
    measured = Angle(
        station_id="a",
        azimuth=np.deg2rad(azimuth_deg),
        zenith=None if zenith_deg is None else np.deg2rad(zenith_deg),
        azimuth_stdev=np.deg2rad(stdev_deg[0]),
        zenith_stdev=None if zenith_deg is None else np.deg2rad(stdev_deg[1]),
        frame=frame,
    )
    bearing, downtilt, slant = np.deg2rad(orientation_deg)
    station = Station(id="a", position=ORIGIN, orientation=(bearing, downtilt, slant))
    return to_scene(measured, station, np.deg2rad(north_deg))


def assert_direction(found: Direction, azimuth_deg: float, zenith_deg: float, stdev_deg: tuple[float, float]) -> None:
    assert found.azimuth is not None
    assert found.zenith is not None
    assert float(wrap(found.azimuth - np.deg2rad(azimuth_deg))) == pytest.approx(0.0, abs=1e-12)
    assert found.zenith == pytest.approx(np.deg2rad(zenith_deg), abs=1e-12)
    np.testing.assert_allclose(found.cov, np.diag(np.deg2rad(stdev_deg) ** 2), rtol=1e-9, atol=1e-15)


def test_the_scene_frame_is_taken_as_it_is() -> None:
    found = turned(40.0, 80.0, frame="scene", orientation_deg=(30.0, 20.0, 10.0), north_deg=50.0)
    assert_direction(found, 40.0, 80.0, (1.0, 2.0))


def test_the_north_frame_counts_from_north() -> None:
    """North along the scene's -y axis: what is 30 degrees left of north lies at 300 degrees."""
    found = turned(30.0, 80.0, frame="north", orientation_deg=(30.0, 20.0, 10.0), north_deg=270.0)
    assert_direction(found, 300.0, 80.0, (1.0, 2.0))


@pytest.mark.parametrize(
    ("orientation_deg", "local", "scene", "stdev_deg"),
    [
        # A bearing turns azimuths.
        ((90.0, 0.0, 0.0), (30.0, 80.0), (120.0, 80.0), (1.0, 2.0)),
        # A downtilt of 30 degrees makes straight ahead point 30 degrees below the horizon. There a degree of the
        # local azimuth is a degree along the horizon, which is more of azimuth.
        ((0.0, 30.0, 0.0), (0.0, 90.0), (0.0, 120.0), (1.0 / np.sin(np.deg2rad(120.0)), 2.0)),
        # It turns about the local y axis, which stays.
        ((0.0, 30.0, 0.0), (90.0, 90.0), (90.0, 90.0), None),
        # A slant of 90 degrees turns the local y axis up, and swaps azimuth and zenith ahead.
        ((0.0, 0.0, 90.0), (90.0, 90.0), (0.0, 0.0), None),
        ((0.0, 0.0, 90.0), (0.0, 90.0), (0.0, 90.0), (2.0, 1.0)),
        ((180.0, 0.0, 90.0), (10.0, 90.0), (180.0, 80.0), None),
    ],
)
def test_the_local_frame_turns_with_the_station(
    orientation_deg: tuple[float, float, float],
    local: tuple[float, float],
    scene: tuple[float, float],
    stdev_deg: tuple[float, float] | None,
) -> None:
    found = turned(*local, frame="lcs", orientation_deg=orientation_deg)
    if stdev_deg is not None:
        assert_direction(found, *scene, stdev_deg)
    assert found.azimuth is not None
    assert found.zenith is not None
    expected = direction(*np.deg2rad(scene))
    np.testing.assert_allclose(direction(found.azimuth, found.zenith), expected, rtol=0, atol=1e-12)


unit_angles = st.floats(-3.1, 3.1)


@given(azimuth=unit_angles, zenith=st.floats(0.1, 3.0), bearing=unit_angles, downtilt=unit_angles, slant=unit_angles)
def test_turning_keeps_the_noise_of_the_direction(
    azimuth: float, zenith: float, bearing: float, downtilt: float, slant: float
) -> None:
    """The noise as seen on the unit sphere, a rotation's worth away: compared by differences of directions."""
    station = Station(id="a", position=ORIGIN, orientation=(bearing, downtilt, slant))
    measured = Angle(station_id="a", azimuth=azimuth, zenith=zenith, azimuth_stdev=0.01, zenith_stdev=0.02, frame="lcs")
    found = to_scene(measured, station, 0.0)

    def spread(at: tuple[float, float], cov: NDArray[np.float64]) -> NDArray[np.float64]:
        step = 1e-6
        slopes = np.stack(
            [
                (direction(at[0] + step, at[1]) - direction(at[0] - step, at[1])) / (2 * step),
                (direction(at[0], at[1] + step) - direction(at[0], at[1] - step)) / (2 * step),
            ],
            axis=-1,
        )
        return np.asarray(slopes @ cov @ slopes.T)

    assert found.azimuth is not None
    assert found.zenith is not None
    if np.sin(found.zenith) < 1e-2:  # there azimuths mean nothing
        return
    local = spread((azimuth, zenith), np.diag([0.01**2, 0.02**2]))
    scene = spread((found.azimuth, found.zenith), found.cov)
    np.testing.assert_allclose(np.linalg.eigvalsh(scene), np.linalg.eigvalsh(local), rtol=0, atol=1e-9)  # 1e-4


def test_an_azimuth_alone_has_a_frame_too() -> None:
    assert turned(30.0, None, frame="scene").azimuth == pytest.approx(np.deg2rad(30.0))
    assert turned(30.0, None, frame="north", north_deg=90.0).azimuth == pytest.approx(np.deg2rad(120.0))
    found = turned(30.0, None, frame="lcs", orientation_deg=(45.0, 0.0, 0.0))
    assert found.azimuth == pytest.approx(np.deg2rad(75.0))
    assert found.zenith is None
    assert found.local is None
    np.testing.assert_allclose(found.cov, np.diag([np.deg2rad(1.0) ** 2, np.inf]), rtol=1e-12)
    tilted = turned(30.0, None, frame="lcs", orientation_deg=(45.0, 20.0, 0.0))
    assert tilted.azimuth == pytest.approx(np.deg2rad(30.0))
    bearing, downtilt = np.deg2rad([45.0, 20.0])
    assert tilted.local is not None
    np.testing.assert_allclose(
        tilted.local.to_scene, local_to_scene((float(bearing), float(downtilt), 0.0)), rtol=0, atol=1e-12
    )
    assert turned(30.0, None, frame="scene", orientation_deg=(45.0, 20.0, 0.0)).local is None


def test_the_field_of_view_is_a_cone_around_the_stations_axis() -> None:
    station = SITE.stations[2]  # 45 degrees to each side of +y

    def seen(azimuth_deg: float, zenith_deg: float | None) -> bool:
        return in_field_of_view(station, turned(azimuth_deg, zenith_deg, frame="scene"))

    assert seen(90.0, 90.0)
    assert seen(134.9, 90.0)
    assert not seen(135.1, 90.0)
    assert seen(90.0, 45.1)
    assert not seen(90.0, 44.9)
    assert not seen(130.0, 50.0)  # the corners of a square are outside of its circle
    assert not seen(-90.0, 90.0)
    assert seen(-90.0, None)


def test_what_lies_outside_the_field_of_view_is_unused_and_the_rest_of_its_path_is_not() -> None:
    found = sort(
        angle("c", -1.5),
        angle("c", 1.5),
        Range(station_id="c", path_length=3.0, stdev=0.1),
        Range(station_id="c", path_length=4.0, stdev=0.1),
    )
    assert found.unused == {0: "the angle lies outside the field of view of station 'c'"}
    first, second = found.observations
    assert first.direction is NO_DIRECTION
    assert first.angle_index is None
    assert first.timing_indices == (2,)
    assert second.angle_index == 1
    assert [term.value for (term,) in second.lengths] == [4.0]


def test_the_kth_angle_and_the_kth_time_are_one_path() -> None:
    found = sort(
        Range(station_id="a", path_length=3.0, stdev=0.1),
        angle("b"),
        angle("a", 0.1),
        Range(station_id="a", path_length=4.0, stdev=0.2),
        angle("a", 0.2),
        Range(station_id="a", path_length=5.0, stdev=0.3),
        toa("a", 7.0),
        toa("b", 8.0),
    )
    first, second = (o for o in found.observations if o.station_id == "a")
    assert (first.angle_index, first.timing_indices) == (2, (0, 5, 6))
    assert (second.angle_index, second.timing_indices) == (4, (3,))
    assert [term.value for (term,) in first.lengths] == [3.0, 5.0]
    assert first.lengths[0][0].variance == pytest.approx(0.01)
    assert len(first.readings) == 1
    assert not second.readings


def test_times_of_arrival_are_counted_from_their_middle() -> None:
    found = sort(toa("a", 1e8 + 3.0), toa("b", 1e8 + 9.0), toa("c", 1e8 + 5.0))
    offsets = {o.station_id: o.readings[0].offset for o in found.observations}
    assert found.num_clocks == 1
    assert offsets == {"a": -2.0, "b": 4.0, "c": 0.0}


def arrivals_of(found: SortedReport) -> dict[str, tuple[float, float]]:
    """Offset [m] and variance [m2] of each station's reading of the only clock."""
    assert found.num_clocks == 1
    return {o.station_id: (o.readings[0].offset, o.readings[0].variance) for o in found.observations}


def test_time_differences_share_the_noise_of_their_reference() -> None:
    found = sort(tdoa("a", "c", 2.0, 1.0), tdoa("b", "c", 5.0, 2.0))
    expected = {"a": (0.0, 0.5), "b": (3.0, 3.5), "c": (-2.0, 0.5)}
    assert arrivals_of(found) == {name: pytest.approx(pair) for name, pair in expected.items()}
    differences = {o.station_id: o.differences for o in found.observations}
    assert differences == {"a": (0,), "b": (1,), "c": (0, 1)}
    assert all(o.timing_indices == () for o in found.observations)


@pytest.mark.parametrize(
    "pairs", [("ab", "bc"), ("ba", "bc"), ("ac", "bc"), ("ab", "ca"), ("ab", "bc", "ca"), ("ab", "ba", "bc", "ac")]
)
def test_whichever_differences_tell_how_far_the_arrivals_are_apart(pairs: tuple[str, ...]) -> None:
    """Three arrivals of one deviation, as chains, stars and loops of differences."""
    times = {"a": 1.0, "b": 4.0, "c": 2.5}
    stdev = float(np.sqrt(2.0) * 0.7)
    found = arrivals_of(sort(*(tdoa(s, r, times[s] - times[r], stdev) for s, r in pairs)))
    assert {name: variance for name, (_, variance) in found.items()} == pytest.approx(dict.fromkeys("abc", 0.49))
    for name, (offset, _) in found.items():
        assert offset - found["a"][0] == pytest.approx(times[name] - times["a"], abs=1e-12)


def test_differences_of_unlike_noise_keep_it() -> None:
    """A chain of two: the middle has half of the lesser variance, the ends have the rest."""
    found = arrivals_of(sort(tdoa("a", "b", 1.0, 1.0), tdoa("b", "c", 1.0, 2.0)))
    assert {name: variance for name, (_, variance) in found.items()} == {"a": 0.5, "b": 0.5, "c": 3.5}


def test_a_noisy_difference_between_arrivals_known_well_is_not_taken_for_a_better_one() -> None:
    """A chain of four with a noisy middle: no arrivals have just these deviations, so the ends get more."""
    chain = (tdoa("a", "b", 1.0, 1.0), tdoa("b", "c", 1.0, 3.0), tdoa("c", "d", 1.0, 1.0))
    found = arrivals_of(sort(*chain))
    for (first, second), stated in zip(itertools.pairwise("abcd"), (1.0, 9.0, 1.0), strict=True):
        assert found[first][1] + found[second][1] >= stated - 1e-12


def test_stations_that_no_difference_connects_are_on_clocks_of_their_own() -> None:
    found = sort(tdoa("a", "b", 1.0), tdoa("c", "d", 7.0))
    assert found.num_clocks == 2
    clocks = {o.station_id: o.readings[0].clock for o in found.observations}
    assert clocks["a"] == clocks["b"] != clocks["c"] == clocks["d"]


def test_differences_that_contradict_each_other_are_refused() -> None:
    """The second has the wrong sign."""
    with pytest.raises(ReportError, match=r"contradicts the other .* by 2 m; .* check signs") as caught:
        sort(tdoa("a", "b", 2.0, 0.1), tdoa("b", "a", 2.0, 0.1), tdoa("c", "a", 1.0, 0.1))
    assert caught.value.path in (("measurements", 0), ("measurements", 1))
    with pytest.raises(ReportError, match="contradicts"):
        sort(tdoa("a", "b", 2.0, 0.1), tdoa("b", "c", 2.0, 0.1), tdoa("a", "c", 1.0, 0.1))
    assert not sort(tdoa("a", "b", 2.0, 1.0), tdoa("b", "a", 2.0, 1.0)).unused


@pytest.mark.parametrize(
    "twice",
    [
        angle("a"),
        Range(station_id="a", path_length=3.0, stdev=0.5),
        LogRange(station_id="a", path_length=3.0, log_stdev=0.5),
        toa("a", 3.0),
    ],
)
def test_a_measurement_sent_twice_is_refused(twice: Measurement) -> None:
    with pytest.raises(ReportError, match=r"measurements\[2\] repeats measurements\[0\]") as caught:
        sort(twice, toa("b", 4.0), twice)
    assert caught.value.path == ("measurements", 2)


def test_two_paths_may_be_of_one_length() -> None:
    same = Range(station_id="a", path_length=3.0, stdev=0.5)
    found = sort(angle("a", 0.1), same, angle("a", 0.2), same)
    assert [len(o.lengths) for o in found.observations] == [1, 1]
    with pytest.raises(ReportError, match="repeats"):
        sort(angle("a", 0.1), same, angle("a", 0.2), same, same)


def test_many_heavy_tails_of_one_path_are_refused() -> None:
    heavy = [Range(station_id="a", path_length=float(n), stdev=0.5, error_model=HEAVY_TAILED) for n in range(9)]
    assert len(sort(*heavy[:8]).observations) == 1
    with pytest.raises(ReportError, match="too many measurements of one path to station 'a'") as caught:
        sort(*heavy)
    assert caught.value.path == ("measurements", 8)


def test_a_reference_of_heavy_tailed_differences_has_heavy_tails() -> None:
    """Unless one of its differences has none."""
    heavy = [replace(tdoa(name, "c", 1.0), error_model=HEAVY_TAILED) for name in "ab"]
    assert all(len(o.readings[0].spreads) == 2 for o in sort(*heavy).observations)
    mixed = {o.station_id: len(o.readings[0].spreads) for o in sort(heavy[0], tdoa("b", "c", 1.0)).observations}
    assert mixed == {"a": 2, "b": 1, "c": 1}


def test_biases_are_taken_off_and_widen_the_noise() -> None:
    bias = StationBias(range=0.25, range_stdev=0.3, azimuth=0.05, zenith=-0.02, angle_stdev=0.04)
    site = replace(SITE, stations=(replace(SITE.stations[0], bias=bias), *SITE.stations[1:]))
    measured = (
        angle("a"),
        Range(station_id="a", path_length=3.0, stdev=0.4),
        LogRange(station_id="a", path_length=3.0, log_stdev=0.2),
        toa("a", 7.0, 0.4),
        toa("b", 9.0, 0.4),
        tdoa("a", "b", 1.0, 1.0),
    )
    first, second = sort_report(Report(measurements=measured), site).observations
    assert first.direction.azimuth == pytest.approx(0.95)
    assert first.direction.zenith == pytest.approx(1.52)
    np.testing.assert_allclose(first.direction.cov, np.diag([0.02**2 + 0.04**2, 0.03**2 + 0.04**2]), rtol=1e-12)
    plain = sort(*measured).observations[0]
    assert first.lengths[0] == ((0.0, 2.75, plain.lengths[0][0].variance),)
    assert first.lengths[1] == plain.lengths[1]  # a signal strength knows no clock
    assert first.length_bias_variance == pytest.approx(0.09)
    # Of the times of arrival and of the differences.
    apart = [mine.offset - other.offset for mine, other in zip(first.readings, second.readings, strict=True)]
    assert apart == pytest.approx([-2.25, 0.75])
    assert [r.variance for r in first.readings] == pytest.approx([0.16 + 0.09, 0.5 + 0.09])
    assert [r.variance for r in second.readings] == pytest.approx([0.16, 0.5])


def test_a_bias_may_push_a_zenith_over_the_pole() -> None:
    station = replace(SITE.stations[0], bias=StationBias(zenith=0.05))
    measured = replace(angle("a", 0.3), zenith=0.02, correlation=0.5)
    found = without_bias(measured, station)
    assert found.zenith == pytest.approx(0.03)
    assert float(wrap(found.azimuth - 0.3)) == pytest.approx(np.pi)
    assert found.correlation == -0.5


@pytest.mark.parametrize("measurements", [(toa("a", 3.0),), (toa("a", 3.0), toa("a", 4.0))])
def test_times_of_arrival_at_one_station_say_nothing(measurements: tuple[TimeOfArrival, ...]) -> None:
    found = sort(*measurements)
    assert not found.observations
    assert found.num_clocks == 0
    assert set(found.unused) == set(range(len(measurements)))
    assert all("unknown" in reason for reason in found.unused.values())


def test_a_time_that_no_path_can_explain_is_unused() -> None:
    """Three clocks agree; the fourth is off by a kilometre. Alone it would spoil the numbers, not only the fix."""
    found = sort(toa("a", 3.0), toa("b", 1004.0), toa("c", 5.0), tdoa("b", "a", 1e6), tdoa("c", "a", 2.0))
    assert set(found.unused) == {1, 3}
    assert all("farther" in reason for reason in found.unused.values())
    assert {o.station_id for o in found.observations} == {"a", "c"}
    assert sort(tdoa("b", "a", 1e6)).unused.keys() == {0}


def test_a_time_with_much_noise_may_be_far_off() -> None:
    assert not sort(toa("a", 3.0), toa("b", 1004.0, stdev=300.0), toa("c", 5.0)).unused


def test_a_reference_that_is_far_off_leaves_its_differences_to_each_other() -> None:
    found = sort(tdoa("b", "a", 5e4 + 3.0), tdoa("c", "a", 5e4 + 5.0))
    assert not found.unused
    offsets = {o.station_id: o.readings[0].offset for o in found.observations}
    assert offsets == pytest.approx({"b": 0.0, "c": 2.0}, abs=1e-9)


@pytest.mark.parametrize(
    ("measurement", "field"),
    [
        (angle("x"), "station_id"),
        (Range(station_id="x", path_length=1.0, stdev=1.0), "station_id"),
        (toa("x", 1.0), "station_id"),
        (tdoa("x", "a", 1.0), "station_id"),
        (tdoa("a", "x", 1.0), "reference_station_id"),
    ],
)
def test_an_unknown_station_is_refused_with_its_place(measurement: Measurement, field: str) -> None:
    with pytest.raises(ReportError, match="station 'x' is not in the table; it has a, b, c, d") as caught:
        sort(angle("a"), measurement)
    assert caught.value.path == ("measurements", 1, field)


def test_a_difference_between_two_lost_arrivals_may_connect_the_others() -> None:
    """Of c - a - b - d the clock is that of c and d; a and b are far from it, and what connects them is used."""
    found = sort(tdoa("a", "b", 0.0), tdoa("a", "c", 1e4), tdoa("b", "d", 1e4))
    assert not found.unused
    assert {o.station_id: o.differences for o in found.observations} == {"c": (1, 0), "d": (2, 0)}
