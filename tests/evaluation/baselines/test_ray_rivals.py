"""Rivals that trace rays: one without noise, and the predecessor in the plane."""

from typing import Any

import numpy as np
import pytest

from rayfix_evaluation.baselines.planar import PlanarPredecessor, plane_crossings
from rayfix_evaluation.baselines.reverse_rays import Polyline, ReverseRays, meeting_point
from rayfix_evaluation.drops.accuracy import solver_of
from rayfix_evaluation.paper.points import Launcher
from rayfix_service.fusion.measurements.report import Angle, Height, Report
from rayfix_tables.table import Table

UE = np.array([1.6, 3.4, 1.1])


def reflected(room: Table, names: str, stdev: float = 0.002) -> tuple[Angle, ...]:
    """Angles of the strongest reflected path to each station, from the forward solver."""
    solver = solver_of(room)
    found = []
    for station in room.site.stations:
        if station.id in names:
            paths = solver.paths(station.position, UE)
            (k, *_) = np.flatnonzero(paths.num_reflections == 1)
            found.append(
                Angle(
                    station_id=station.id,
                    azimuth=float(paths.azimuth[k]),
                    zenith=float(paths.zenith[k]),
                    azimuth_stdev=stdev,
                    zenith_stdev=stdev,
                )
            )
    return tuple(found)


def test_reverse_rays_meet_at_the_transmitter(room: Table, measure: Any) -> None:
    rival = ReverseRays.of_table(room)
    for measurements in (measure("aoa"), reflected(room, "abcd"), measure("aoa", "ab") + reflected(room, "cd")):
        found = rival.locate(Report(measurements=measurements))
        assert found is not None
        np.testing.assert_allclose(found, UE, rtol=0, atol=1e-3)


def test_one_ray_meets_nothing(room: Table, measure: Any) -> None:
    rival = ReverseRays.of_table(room)
    assert rival.locate(Report(measurements=measure("aoa", "a"))) is None
    assert rival.locate(Report(measurements=measure("pt"))) is None


def line(start: tuple[float, float, float], end: tuple[float, float, float]) -> Polyline:
    step = np.subtract(end, start)
    length = np.linalg.norm(step)
    return Polyline(start=np.array([start]), heading=step[None] / length, length=np.array([length]))


def test_the_meeting_point_is_nearest_in_the_mean_square() -> None:
    """Two skew lines 2 m apart, along x and along y: their middle; with a third along z the centre moves."""
    along_x, along_y = line((-5, 0, 0), (5, 0, 0)), line((0, -5, 2), (0, 5, 2))
    np.testing.assert_allclose(meeting_point([along_x, along_y]), (0, 0, 1), rtol=0, atol=1e-9)
    along_z = line((3, 3, -5), (3, 3, 5))
    # Each coordinate is fixed by two of the lines: x = (0 + 3) / 2, y = (0 + 3) / 2, z = (0 + 2) / 2.
    np.testing.assert_allclose(meeting_point([along_x, along_y, along_z]), (1.5, 1.5, 1.0), rtol=0, atol=1e-9)


def test_rays_that_end_are_met_at_their_end() -> None:
    """A ray along x that ends 1 m short of one along y: the middle of the gap, not the crossing of the lines."""
    found = meeting_point([line((-5, 0, 0), (-1, 0, 0)), line((0, -5, 0), (0, 5, 0))])
    np.testing.assert_allclose(found, (-0.5, 0, 0), rtol=0, atol=1e-9)


def test_the_piece_that_takes_part_is_chosen() -> None:
    """A bent ray, up along x = 0 and then away along y = 3; the other ray meets its second piece."""
    bent = Polyline(
        start=np.array([[0.0, 0, 0], [0, 3, 0]]), heading=np.array([[0.0, 1, 0], [1, 0, 0]]), length=np.array([3.0, 9])
    )
    found = meeting_point([bent, line((2, 0, 0.2), (2, 5, 0.2))])
    np.testing.assert_allclose(found, (2, 3, 0.1), rtol=0, atol=1e-9)


def test_rays_cross_a_plane_where_unfolding_says(room: Table) -> None:
    """From (1, 1, 2) in steps of (3, 1, -0.5): the wall x = 4 after one; after two at x = 7, mirrored to 1, and z = 1.

    After three, mirrored at x = 0 as well, it is at (2, 4, 0.5). It only descends: z = 2.5 is crossed nowhere.
    """
    heading = np.array([3.0, 1.0, -0.5])
    directions = (heading / np.linalg.norm(heading))[None]
    launcher = Launcher.of_table(room)
    station = np.array([1.0, 1.0, 2.0])
    np.testing.assert_allclose(plane_crossings(launcher, station, directions, 1.0), [[1.0, 3.0]], rtol=0, atol=1e-6)
    np.testing.assert_allclose(plane_crossings(launcher, station, directions, 0.5), [[2.0, 4.0]], rtol=0, atol=1e-6)
    assert plane_crossings(launcher, station, directions, 2.5).shape == (0, 2)


def test_rays_within_the_plane_cross_it_nowhere(room: Table) -> None:
    launcher = Launcher.of_table(room)
    level = np.array([[1.0, 0.0, 0.0]])
    assert plane_crossings(launcher, np.array([1.0, 1.0, 2.0]), level, 2.0).shape == (0, 2)


def test_the_predecessor_finds_the_transmitter_at_its_height(room: Table, measure: Any) -> None:
    precise = tuple(
        Angle(station_id=m.station_id, azimuth=m.azimuth, zenith=m.zenith, azimuth_stdev=0.002, zenith_stdev=0.002)
        for m in measure("aoa")
    )
    rival = PlanarPredecessor.of_table(room)
    for measurements in (precise, reflected(room, "abcd")):
        found = rival.locate(Report(measurements=measurements, height=Height(z=1.1, stdev=0.1)))
        assert found is not None
        # 2 mrad over 3 m, the plane crossed at a slant, two or more stations: about 1 cm.
        np.testing.assert_allclose(found, UE, rtol=0, atol=0.04)
        assert found[2] == pytest.approx(1.1, abs=1e-12)
    with_default = PlanarPredecessor.of_table(room, height=1.1)
    again = with_default.locate(Report(measurements=measurements))
    np.testing.assert_allclose(again, found, rtol=0, atol=1e-9)


def test_the_predecessor_needs_a_height_and_angles(room: Table, measure: Any) -> None:
    rival = PlanarPredecessor.of_table(room)
    assert rival.locate(Report(measurements=measure("aoa"))) is None
    assert rival.locate(Report(measurements=measure("pt"), height=Height(z=1.1, stdev=0.1))) is None


def test_a_wrong_height_moves_the_fix(room: Table, measure: Any) -> None:
    """One station 1.5 m above the true plane: told that the plane is 0.5 m lower, the fix is a third farther away."""
    (angle,) = measure("aoa", "a")
    narrow = Angle(station_id="a", azimuth=angle.azimuth, zenith=angle.zenith, azimuth_stdev=0.001, zenith_stdev=0.001)
    station = np.array([0.5, 0.6, 2.6])
    rival = PlanarPredecessor.of_table(room)
    found = rival.locate(Report(measurements=(narrow,), height=Height(z=0.6, stdev=0.1)))
    assert found is not None
    far = (found - station)[:2] / (UE - station)[:2]
    np.testing.assert_allclose(far, 4.0 / 3.0, rtol=0.01)


@pytest.mark.parametrize("make", [ReverseRays.of_table, PlanarPredecessor.of_table])
def test_the_same_report_gives_the_same_position(room: Table, measure: Any, make: Any) -> None:
    report = Report(measurements=measure("aoa"), height=Height(z=1.1, stdev=0.1))
    rival = make(room)
    first = rival.locate(report)
    rival.locate(Report(measurements=measure("aoa", "ab"), height=Height(z=0.9, stdev=0.1)))
    np.testing.assert_array_equal(rival.locate(report), first)
