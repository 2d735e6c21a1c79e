"""Sorting a report: which measurements belong together, frames, fields of view, clocks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_service.fusion.lookup import NO_DIRECTION, Direction
from rayfix_service.fusion.observations import SortedReport, in_field_of_view, sort_report, to_scene
from rayfix_service.fusion.report import Angle, Frame, Measurement, Range, Report, TimeDifference, TimeOfArrival
from rayfix_tables.angles import direction, wrap
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station

ORIGIN = (0.0, 0.0, 0.0)
SITE = SiteInfo(
    name="s",
    north=0.0,
    max_path_length=50.0,
    stations=(
        Station(id="a", position=ORIGIN),
        Station(id="b", position=ORIGIN),
        Station(id="c", position=ORIGIN, orientation=(np.pi / 2, 0.0, 0.0), field_of_view=np.pi / 2),
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
    np.testing.assert_array_equal(found.cov, np.diag([np.deg2rad(1.0) ** 2, np.inf]))


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
    assert [length for length, _ in second.lengths] == [4.0]


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
    assert [length for length, _ in first.lengths] == [3.0, 5.0]
    assert first.lengths[0][1] == pytest.approx(0.01)
    assert len(first.readings) == 1
    assert not second.readings


def test_times_of_arrival_are_counted_from_their_middle() -> None:
    found = sort(toa("a", 1e8 + 3.0), toa("b", 1e8 + 9.0), toa("c", 1e8 + 5.0))
    offsets = {o.station_id: o.readings[0].offset for o in found.observations}
    assert found.num_clocks == 1
    assert offsets == {"a": -2.0, "b": 4.0, "c": 0.0}


def test_time_differences_share_the_noise_of_their_reference() -> None:
    found = sort(tdoa("a", "c", 2.0, 1.0), tdoa("b", "c", 5.0, 2.0), tdoa("a", "b", 1.0))
    assert found.num_clocks == 2
    readings = {(o.station_id, r.clock): r for o in found.observations for r in o.readings}
    assert {key: r.variance for key, r in readings.items()} == {
        ("c", 0): 0.5,
        ("a", 0): 0.5,
        ("b", 0): 3.5,
        ("b", 1): 0.5,
        ("a", 1): 0.5,
    }
    assert readings["a", 0].offset - readings["c", 0].offset == 2.0
    assert readings["b", 0].offset - readings["c", 0].offset == 5.0
    assert readings["a", 1].offset - readings["b", 1].offset == 1.0
    reference = next(o for o in found.observations if o.station_id == "c")
    assert reference.timing_indices == ()
    assert reference.reference_of == (0, 1)


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
    assert offsets == {"b": 0.0, "c": 2.0}


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
    with pytest.raises(ReportError, match="station 'x' is not in the table; it has a, b, c") as caught:
        sort(angle("a"), measurement)
    assert caught.value.path == ("measurements", 1, field)
