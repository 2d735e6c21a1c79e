"""The position error bound against closed forms and finite differences of the forward solver."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix.example.hall import hall_scene, hall_stations
from rayfix_evaluation.drops.bound import path_gradients, position_error_bound
from rayfix_evaluation.drops.simulate import Noise, Timing
from rayfix_evaluation.truth.forward import ForwardSolver, Paths

Array = NDArray[np.float64]
NOISE = Noise(azimuth_stdev=0.02, zenith_stdev=0.01, range_stdev=0.3)
WALL = ForwardSolver.from_mesh(
    [(0, -50, -50), (0, 50, -50), (0, 50, 50), (0, -50, 50)], [(0, 1, 2), (0, 2, 3)], max_path_length=1000.0
)
"""A wall in the plane x = 0; in its half-space x > 0 every pair has a direct and a reflected path."""


def bound(stations: Sequence[Sequence[float]], point: Sequence[float], noise: Noise, timing: Timing) -> float:
    """Bound of the direct paths in front of the wall."""
    paths = [WALL.paths(station, point) for station in stations]
    assert all(each.num_reflections[0] == 0 for each in paths)
    return position_error_bound(stations, paths, [0] * len(paths), point, noise, timing=timing)


@pytest.fixture(scope="module")
def hall() -> ForwardSolver:
    mesh = hall_scene().to_geometry()
    return ForwardSolver.from_mesh(mesh.vertices, mesh.faces)


def wrapped(angle: Array) -> Array:
    return np.asarray(np.angle(np.exp(1j * angle)))


# Closed forms


def test_one_station_with_angles_and_time() -> None:
    """One direct path: the error is an ellipsoid of half-axes r sin(zenith) s_az, r s_ze and s_r."""
    station, point = (1.0, 2.0, 3.0), (4.0, -2.0, 1.0)
    horizontal, square = 5.0, 29.0
    expected = np.sqrt((horizontal * 0.02) ** 2 + square * 0.01**2 + 0.3**2)
    assert bound([station], point, NOISE, "pt") == pytest.approx(expected, rel=1e-12)


def test_one_station_behind_a_mirror() -> None:
    """Mirrored at the wall x = 0 the same, with the unfolded length: horizontal (5, 4), 2 m down."""
    station, point = (1.0, 2.0, 3.0), (4.0, -2.0, 1.0)
    paths = WALL.paths(station, point)
    assert paths.num_reflections[1] == 1
    expected = np.sqrt(41 * 0.02**2 + 45 * 0.01**2 + 0.3**2)
    actual = position_error_bound([station], [paths], [1], point, NOISE, timing="pt")
    assert actual == pytest.approx(expected, rel=1e-12)


def test_two_stations_with_angles_alone() -> None:
    """Stations 6 m away along x and along y at the same height: J = diag(1, 1, 2) / (6 s)^2."""
    point = (10.0, 5.0, 2.0)
    stations = [(4.0, 5.0, 2.0), (10.0, -1.0, 2.0)]
    noise = Noise(azimuth_stdev=0.01, zenith_stdev=0.01, range_stdev=None)
    assert bound(stations, point, noise, "none") == pytest.approx(6 * 0.01 * np.sqrt(2.5), rel=1e-12)


def test_direct_and_reflected_path_of_one_station_fix_a_position() -> None:
    """Angles of two paths from one corner are like those of two stations, the second one being the image."""
    station, point = (3.0, 0.0, 1.0), (3.0, 8.0, 1.0)
    paths = WALL.paths(station, point)
    noise = Noise(azimuth_stdev=0.01, zenith_stdev=0.01, range_stdev=None)
    actual = position_error_bound([station, station], [paths, paths], [0, 1], point, noise, timing="none")
    # Directions (0, 1) over 8 m and, from the image at (-3, 0), (0.6, 0.8) over 10 m; errors lie across them.
    across = np.array([[1.0, 0.0], [-0.8, 0.6]]) / np.array([[8.0], [10.0]])
    horizontal = np.trace(np.linalg.inv(across.T @ across))
    assert actual == pytest.approx(0.01 * np.sqrt(horizontal + 1 / (1 / 64 + 1 / 100)), rel=1e-12)


TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
BLIND = 1e9  # rad; angles that tell nothing


def test_tetrahedron_of_ranges() -> None:
    """Four ranges from a regular tetrahedron around the point: J = (4/3) / s^2, with or without a clock."""
    point = np.array([10.0, 5.0, 2.0])
    stations = (point + 3.0 * TETRAHEDRON).tolist()
    noise = Noise(azimuth_stdev=BLIND, zenith_stdev=BLIND, range_stdev=0.2)
    timings: tuple[Timing, ...] = ("pt", "toa", "tdoa")
    for timing in timings:
        assert bound(stations, point.tolist(), noise, timing) == pytest.approx(0.2 * 1.5, rel=1e-9)


def test_clock_offset_is_projected_out() -> None:
    """Five stations; ToA against the 4 x 4 information with the clock, TDoA against its full covariance."""
    rng = np.random.default_rng(1)
    point = np.array([10.0, 5.0, 2.0])
    stations = rng.uniform(1, 20, (5, 3))
    noise = Noise(azimuth_stdev=BLIND, zenith_stdev=BLIND, range_stdev=0.2)
    rows = (point - stations) / np.linalg.norm(point - stations, axis=1, keepdims=True)

    with_clock = np.column_stack([rows, np.ones(5)])
    toa = np.sqrt(np.trace(np.linalg.inv(with_clock.T @ with_clock / 0.2**2)[:3, :3]))
    differences = rows[1:] - rows[0]
    covariance = 0.2**2 * (np.eye(4) + np.ones((4, 4)))
    tdoa = np.sqrt(np.trace(np.linalg.inv(differences.T @ np.linalg.solve(covariance, differences))))
    assert toa == pytest.approx(tdoa, rel=1e-9)  # a theorem, and a check of this test

    assert bound(stations.tolist(), point.tolist(), noise, "toa") == pytest.approx(toa, rel=1e-9)
    assert bound(stations.tolist(), point.tolist(), noise, "tdoa") == pytest.approx(tdoa, rel=1e-9)
    assert bound(stations.tolist(), point.tolist(), noise, "pt") < 0.9 * toa


def test_directions_that_stay_open_are_infinite() -> None:
    point = (4.0, -2.0, 1.0)
    one, two = [(1.0, 2.0, 3.0)], [(1.0, 2.0, 3.0), (7.0, 2.0, 3.0)]
    assert bound(one, point, NOISE, "none") == np.inf
    for timing in ("toa", "tdoa"):
        # The clock takes the only time there is.
        assert bound(one, point, NOISE, timing) == np.inf
    assert bound(two, point, NOISE, "none") < 1.0
    paths = WALL.paths(one[0], point)
    assert position_error_bound(one, [paths], [-1], point, NOISE, timing="pt") == np.inf


def test_station_that_hears_nothing_adds_nothing() -> None:
    point = (4.0, -2.0, 1.0)
    stations = [(1.0, 2.0, 3.0), (7.0, 2.0, 3.0)]
    paths = [WALL.paths(station, point) for station in stations]
    alone = position_error_bound(stations[:1], paths[:1], [0], point, NOISE, timing="pt")
    unheard = position_error_bound(stations, paths, [0, -1], point, NOISE, timing="pt")
    assert unheard == pytest.approx(alone, rel=1e-12)
    assert position_error_bound(stations, paths, [0, 0], point, NOISE, timing="pt") < 0.9 * alone


def test_station_straight_above_has_no_azimuth() -> None:
    """Its zenith has no gradient either at the pole; the range still counts."""
    gradients = path_gradients(WALL.paths((3.0, 0.0, 5.0), (3.0, 0.0, 1.0)), 0)
    np.testing.assert_allclose(gradients, [[0, 0, 0], [0, 0, 0], [0, 0, -1]], rtol=0, atol=1e-12)


# Finite differences


def test_gradients_agree_with_the_forward_solver() -> None:
    """Central differences of length, azimuth and zenith of every path, in a hall tilted at random."""
    rng = np.random.default_rng(2)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    mesh = hall_scene().to_geometry()
    tilted = ForwardSolver.from_mesh(np.asarray(mesh.vertices) @ turn.T, mesh.faces)
    step = 1e-5
    checked = np.zeros(4, dtype=int)
    for _, position in hall_stations():
        station = tilted.station(turn @ np.array(position))
        for point in rng.uniform((0.3, 0.3, 1.5), (7.7, 17.7, 2.4), (8, 3)) @ turn.T:
            paths = station.paths(point)
            moves = [[station.paths(point + sign * step * axis) for sign in (1, -1)] for axis in np.eye(3)]
            for i in range(len(paths)):
                pairs = [[_same_path(paths, i, other, 100 * step) for other in pair] for pair in moves]
                if any(match is None for pair in pairs for match in pair):
                    continue  # the path ends at an edge nearby
                numeric = np.empty((3, 3))
                for column, ((forward, backward), (j, k)) in enumerate(zip(moves, pairs, strict=True)):
                    numeric[0, column] = wrapped(forward.azimuth[j] - backward.azimuth[k]) / (2 * step)
                    numeric[1, column] = (forward.zenith[j] - backward.zenith[k]) / (2 * step)
                    numeric[2, column] = (forward.path_length[j] - backward.path_length[k]) / (2 * step)
                analytic = path_gradients(paths, i)
                # Rounding of 1e-15 rad or m over the step, and the third derivative times its square.
                np.testing.assert_allclose(numeric, analytic, rtol=1e-6, atol=1e-8)
                checked[paths.num_reflections[i]] += 1
    assert (checked > 5).all(), checked


def _same_path(paths: Paths, i: int, other: Paths, tolerance: float) -> int | None:
    """Index in ``other`` of the path whose vertices lie next to those of path i."""
    if len(other) == 0:
        return None
    gaps = np.abs(other.vertices - paths.vertices[i]).max(axis=(1, 2))
    gaps[other.num_reflections != paths.num_reflections[i]] = np.inf
    nearest = int(gaps.argmin())
    return nearest if gaps[nearest] < tolerance else None


def test_more_knowledge_never_hurts(hall: ForwardSolver) -> None:
    """In the hall: no time, a time with an unknown clock, a known clock, in this order."""
    rng = np.random.default_rng(3)
    stations = [position for _, position in hall_stations()]
    compared = 0
    for point in rng.uniform((0.3, 0.3, 0.3), (7.7, 17.7, 2.4), (12, 3)):
        paths = [hall.paths(station, point) for station in stations]
        selected = [0 if len(each) else -1 for each in paths]
        if selected.count(0) < 2:
            continue
        none, toa, tdoa, pt = (
            position_error_bound(stations, paths, selected, point, NOISE, timing=timing)
            for timing in ("none", "toa", "tdoa", "pt")
        )
        assert 0 < pt < toa <= none
        assert tdoa == pytest.approx(toa, rel=1e-12)
        compared += 1
    assert compared >= 4


def test_arguments_that_do_not_belong_together() -> None:
    stations, point = [(1.0, 2.0, 3.0), (7.0, 2.0, 3.0)], (4.0, -2.0, 1.0)
    paths = [WALL.paths(station, point) for station in stations]
    angles_only = Noise(azimuth_stdev=0.01, zenith_stdev=0.01, range_stdev=None)
    with pytest.raises(ValueError, match="2 stations, 1 sets of paths"):
        position_error_bound(stations, paths[:1], [0, 0], point, NOISE, timing="pt")
    with pytest.raises(ValueError, match=r"paths\[0\] lead from"):
        position_error_bound(stations, paths[::-1], [0, 0], point, NOISE, timing="pt")
    with pytest.raises(ValueError, match="range_stdev is None"):
        position_error_bound(stations, paths, [0, 0], point, angles_only, timing="toa")
    with pytest.raises(ValueError, match="the timing is 'rtt'"):
        position_error_bound(stations, paths, [0, 0], point, NOISE, timing="rtt")  # type: ignore[arg-type]
