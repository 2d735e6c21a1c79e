"""When a fix is ambiguous, inconsistent or insufficient, and that it lies in free space, on tables by hand."""

from dataclasses import replace

import numpy as np
import pytest

from rayfix_service.fusion.measurements.report import Measurement
from rayfix_service.locator import Locator
from rayfix_tables.geometry.angles import angles_of
from tests.support.messages.hand_reports import angle_of, report_of
from tests.support.tables.hand_tables import ORIGIN, POSITIONS, SIDE, UE, MakeTable, line_of_sight


def test_two_symmetric_rooms_are_ambiguous(make_table: MakeTable) -> None:
    """One station, a mirror behind it: what it hears from either side looks the same."""
    left = right = line_of_sight("a", length_stdev=0.3, log_mass=12.0)
    right = replace(right, x_mean=right.x_mean + np.array([-9.0, 2.0, 0.0]), log_mass=left.log_mass - 0.5)
    fix = Locator(make_table(left, right)).locate(report_of([angle_of(left)]))
    assert fix.status == "ambiguous"
    odds = fix.candidates[0].probability / fix.candidates[1].probability
    assert odds == pytest.approx(np.exp(0.5), rel=1e-5)
    np.testing.assert_allclose(
        fix.candidates[0].position - fix.candidates[1].position, [9.0, -2.0, 0.0], rtol=0, atol=1e-5
    )


def test_two_stations_that_contradict_each_other_are_inconsistent(make_table: MakeTable) -> None:
    near, far = (UE, UE + np.array([6.0, 8.0, 0.0]))
    tubes = [
        line_of_sight("a", near, length_stdev=0.3, log_mass=12.0),
        line_of_sight("b", far, length_stdev=0.3, log_mass=12.0),
    ]
    fix = Locator(make_table(*tubes)).locate(report_of([angle_of(tube) for tube in tubes]))
    assert fix.status == "inconsistent"
    assert sum(outcome.outlier_probability or 0.0 for outcome in fix.outcomes) == pytest.approx(1.0, abs=0.1)


def test_a_long_tube_alone_is_insufficient(make_table: MakeTable) -> None:
    tube = line_of_sight("a", length_stdev=5.0, log_mass=12.0)
    assert Locator(make_table(tube)).locate(report_of([angle_of(tube)])).status == "insufficient"


def test_what_is_as_wide_as_the_room_is_insufficient(make_table: MakeTable) -> None:
    """In a closet the 3 m that are wide in a hall say nothing: one angle told no more than that the UE is there."""
    tube = line_of_sight("a", length_stdev=2.0, width=0.5, log_mass=12.0)
    in_hall = Locator(make_table(tube)).locate(report_of([angle_of(tube)]))
    assert in_hall.status == "ok"
    free = np.zeros((SIDE,) * 3, np.bool_)
    x, y, z = np.floor(UE - ORIGIN).astype(int)  # voxels of 1 m
    free[x - 1 : x + 2, y - 1 : y + 2, z - 1 : z + 2] = True
    in_closet = Locator(make_table(tube, free=free)).locate(report_of([angle_of(tube)]))
    assert in_closet.status == "insufficient"


def test_a_candidate_moves_out_of_a_solid(make_table: MakeTable) -> None:
    """All but the lower half of the cube is solid, and the UE seems to be 0.2 m inside."""
    free = np.ones((SIDE,) * 3, np.bool_)
    free[:, :, 32:] = False  # z > 1.2
    tubes = [line_of_sight(name, UE + np.array([0.0, 0.0, 0.2]), width=0.01) for name in POSITIONS]
    aimed: list[Measurement] = []
    for tube in tubes:
        azimuth, zenith = angles_of(tube.x_mean - np.array(POSITIONS[tube.station_id]))
        precise = angle_of(tube, stdev=(1e-3, 1e-3))
        aimed.append(replace(precise, azimuth=float(azimuth), zenith=float(zenith)))
    fix = Locator(make_table(*tubes, free=free)).locate(report_of(aimed))
    np.testing.assert_allclose(fix.candidates[0].position, [9.0, 8.0, 1.2], rtol=0, atol=0.03)  # m
    assert fix.candidates[0].position[2] < 1.2
    unmoved = Locator(make_table(*tubes)).locate(report_of(aimed))
    assert unmoved.candidates[0].position[2] == pytest.approx(1.4, abs=0.03)
