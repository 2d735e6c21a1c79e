"""The forward solver beside Sionna RT, and the comparison itself."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from benchmarks.truth.sionna_reports import reported_share, strongest
from benchmarks.truth.sionna_rt import NOTHING_COMPARED, FoundPaths, compare, shortest_segment, sionna_paths
from rayfix_evaluation.truth.forward import ForwardSolver, Paths
from rayfix_evaluation.truth.walls import Walls
from rayfix_tables.geometry.angles import direction

STATIONS = np.array([[0.5, 0.6, 2.6], [3.6, 4.4, 2.3]])
POINTS = np.array([[1.6, 3.4, 1.1], [3.0, 1.2, 0.4]])


@pytest.fixture(scope="module")
def room() -> trimesh.Trimesh:
    """Make a room with a screen in it."""
    walls = trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)])
    screen = trimesh.creation.box(bounds=[(1.9, 0.5, 0.2), (2.1, 3.5, 2.0)])
    return trimesh.util.concatenate([walls, screen])


def solver_of(room: trimesh.Trimesh) -> ForwardSolver:
    return ForwardSolver.from_mesh(room.vertices, room.faces, max_reflections=2, max_path_length=1e4)


def test_all_paths_are_those_of_sionna_rt(room: trimesh.Trimesh) -> None:
    pytest.importorskip("sionna.rt", reason="Sionna RT is not here; install the extra 'sionna' and LLVM")
    solver = solver_of(room)
    theirs = sionna_paths(room.vertices, room.faces, STATIONS, POINTS, max_reflections=2)
    total = NOTHING_COMPARED
    for point, by_station in zip(POINTS, theirs, strict=True):
        for station, found in zip(STATIONS, by_station, strict=True):
            total += compare(solver.paths(station, point), found)
    assert total.num_common > 40
    assert (total.only_ours, total.only_theirs) == (0, 0)
    assert total.largest_length < 1e-4
    assert total.largest_angle < np.deg2rad(0.01)


def found_like(ours: Paths, order: NDArray[np.int64], *, longer: float) -> FoundPaths:
    """Return the solver's own paths in another order, longer by the same for all."""
    return FoundPaths(
        path_length=ours.path_length[order] + longer,
        direction=direction(ours.azimuth, ours.zenith)[order],
        gain_db=ours.gain_db[order],
        num_reflections=ours.num_reflections[order],
        num_walls=ours.num_walls[order],
        others=np.zeros(len(order), np.int64),
    )


def test_paths_are_matched_one_to_one(room: trimesh.Trimesh) -> None:
    ours = solver_of(room).paths(STATIONS[0], POINTS[0])
    order = np.random.default_rng(1).permutation(len(ours))
    same = found_like(ours, order, longer=2e-4)
    told = compare(ours, same)
    assert told.num_common == len(ours)
    assert told.largest_length == pytest.approx(2e-4, abs=1e-9)
    assert told.largest_angle < 1e-9
    assert (told.short_segments, told.only_ours, told.only_theirs) == (0, 0, 0)

    twice = same.chosen(np.array([0, 0]))
    told = compare(ours, twice)
    assert (told.num_common, told.only_ours, told.only_theirs) == (1, len(ours) - 1, 1)
    assert compare(ours, found_like(ours, order, longer=2.2e-3)).num_common < len(ours)
    nothing = same.chosen(np.empty(0, np.int64))
    assert compare(ours, nothing).only_ours == len(ours)
    both = told + compare(ours, nothing)
    assert (both.num_common, both.only_ours, both.only_theirs) == (1, 2 * len(ours) - 1, 1)


def test_short_segments_are_told_apart() -> None:
    """A point 4 mm before a wall: the reflection there has a segment of about that length."""
    wall = ForwardSolver.from_mesh(
        [(0, -50, -50), (0, 50, -50), (0, 50, 50), (0, -50, 50)], [(0, 1, 2), (0, 2, 3)], max_path_length=1e4
    )
    paths = wall.paths((3.0, 0.0, 0.0), (0.004, 0.1, 0.0))
    assert paths.num_reflections.tolist() == [0, 1]
    assert shortest_segment(paths, 1) == pytest.approx(0.004 * np.hypot(1.0, 0.1 / 3.004), rel=1e-3)
    direct = found_like(paths, np.array([0]), longer=0.0)
    told = compare(paths, direct)
    assert (told.num_common, told.short_segments, told.only_ours) == (1, 1, 0)


def test_weak_paths_may_be_missing_and_gains_are_compared(room: trimesh.Trimesh) -> None:
    ours = solver_of(room).paths(STATIONS[0], POINTS[0])
    strong = np.flatnonzero(ours.gain_db >= ours.gain_db[0] - 10.0)
    weak = np.flatnonzero(ours.gain_db < ours.gain_db[0] - 10.0)
    assert len(weak) > 3
    theirs = found_like(ours, strong, longer=0.0)
    assert compare(ours, theirs).only_ours == len(weak)
    told = compare(ours, theirs, range_db=10.0)
    assert (told.num_common, told.only_ours, told.only_theirs) == (len(strong), 0, 0)
    louder = replace(theirs, gain_db=theirs.gain_db - 0.3)
    assert compare(ours, louder, range_db=10.0).gains_apart == pytest.approx([0.3] * len(strong))
    assert told.share_within(0.1) == 1.0
    assert compare(ours, louder, range_db=10.0).share_within(0.1) == 0.0


def test_paths_of_one_length_and_direction_are_told_apart_by_their_gains(room: trimesh.Trimesh) -> None:
    ours = solver_of(room).paths(STATIONS[0], POINTS[0]).chosen(np.array([2, 2]))
    ours = replace(ours, gain_db=np.array([-20.0, -33.0]))
    theirs = found_like(ours, np.array([1, 0]), longer=0.0)
    assert compare(ours, theirs).gains_apart == pytest.approx([0.0, 0.0])


def test_walls_cut_segments(room: trimesh.Trimesh) -> None:
    """A sheet 6 mm before the transmitter."""
    walls = Walls.sheets(np.full(2, 3.0 + 0j), np.full(2, 0.01), carrier_ghz=3.5)
    sheet = ForwardSolver.from_mesh(
        [(2, -5, -5), (2, 5, -5), (2, 5, 5), (2, -5, 5)], [(0, 1, 2), (0, 2, 3)], max_reflections=0, walls=walls
    )
    paths = sheet.paths((0, 0, 0), (2.006, 0, 0))
    assert paths.num_walls.tolist() == [1]
    assert shortest_segment(paths, 0) == pytest.approx(0.006, abs=1e-9)


def test_reports_come_from_the_strongest_paths_of_stations_that_hear_enough() -> None:
    """Station 0 is the best, 1 is 39 dB and 2 is 41 dB below it, 3 hears nothing."""
    silent = -np.inf
    drops = {
        "position": np.zeros((1, 3)),
        "gain_db": np.array([[[-30.0, -20.0], [-59.0, silent], [-61.0, -70.0], [silent, silent]]]),
        "num_reflections": np.array([[[0, 1], [0, 0], [0, 0], [0, 0]]]),
        "num_walls": np.array([[[0, 2], [1, 0], [0, 0], [0, 0]]]),
        "others": np.zeros((1, 4, 2), int),
    }
    assert strongest(drops, 0) == {0: 1, 1: 0}
    told = reported_share(drops)
    assert "50.0% straight through walls" in told
    assert "50.0% reflected and through walls" in told
    assert "0.0% unobstructed" in told
