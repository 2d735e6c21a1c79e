"""The image method: changes of the scene that leave the paths as they are, or move them along."""

import itertools

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.truth.forward import ForwardSolver, Paths
from tests.support.oracles.forward_paths import (
    EXACT,
    assert_same_paths,
    bounces,
    direction,
    hall_pairs,
    rotation,
    solver_of,
)
from tests.support.scenes.shapes import box

Array = NDArray[np.float64]


def moved(paths: Paths, turn: Array, shift: Array) -> Paths:
    """Move paths along with everything else."""
    along = direction(paths) @ turn.T
    return Paths(
        path_length=paths.path_length,
        azimuth=np.arctan2(along[:, 1], along[:, 0]),
        zenith=np.arctan2(np.hypot(along[:, 0], along[:, 1]), along[:, 2]),
        num_reflections=paths.num_reflections,
        gain_db=paths.gain_db,
        vertices=paths.vertices @ turn.T + shift,
        crossings=paths.crossings @ turn.T + shift,
        num_walls=paths.num_walls,
    )


def test_rigid_motion_moves_the_paths(hall: ForwardSolver, hall_triangles: Array) -> None:
    rng = np.random.default_rng(1)
    found = 0
    for station, point in hall_pairs(16, seed=2):
        turn, shift = rotation(rng), rng.uniform(-20, 20, 3)
        expected = hall.paths(station, point)
        actual = solver_of(hall_triangles @ turn.T + shift).paths(turn @ station + shift, turn @ point + shift)
        assert_same_paths(actual, moved(expected, turn, shift))
        found += len(expected)
    assert found > 50


def test_order_and_orientation_of_triangles_do_not_matter(hall: ForwardSolver, hall_triangles: Array) -> None:
    rng = np.random.default_rng(3)
    shuffled = rng.permutation(hall_triangles)
    shuffled[::2] = shuffled[::2, ::-1]
    shuffled[1::3] = np.roll(shuffled[1::3], 1, axis=1)
    other = solver_of(shuffled)
    assert other.num_planes == hall.num_planes
    for station, point in hall_pairs(8, seed=4):
        assert_same_paths(other.paths(station, point), hall.paths(station, point))


def test_splitting_triangles_does_not_matter(hall: ForwardSolver, hall_triangles: Array) -> None:
    a, b, c = (hall_triangles[:, i] for i in range(3))
    share = np.random.default_rng(5).uniform(0.2, 0.8, (len(a), 1))
    middle = share * a + (1 - share) * b
    split = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    other = solver_of(split)
    assert other.num_planes == hall.num_planes
    for station, point in hall_pairs(8, seed=6):
        assert_same_paths(other.paths(station, point), hall.paths(station, point))


def test_far_object_does_not_matter(hall: ForwardSolver, hall_triangles: Array) -> None:
    other = solver_of(hall_triangles, box((100, 100, 100), (101, 103, 104)))
    assert other.num_planes == hall.num_planes + 6
    for station, point in hall_pairs(8, seed=7):
        assert_same_paths(other.paths(station, point), hall.paths(station, point))


def test_reciprocity(hall: ForwardSolver) -> None:
    """Swapping the ends turns every path round."""
    found = 0
    for station, point in hall_pairs(12, seed=8):
        there, back = hall.paths(station, point), hall.paths(point, station)
        np.testing.assert_allclose(there.path_length, back.path_length, rtol=0, atol=EXACT)
        ways = {tuple(np.round(bounces(there, i), 6).ravel()) for i in range(len(there))}
        ways_back = {tuple(np.round(bounces(back, i)[::-1], 6).ravel()) for i in range(len(back))}
        assert ways == ways_back
        found += len(there)
    assert found > 50


def test_paths_in_the_hall_obey_the_law_of_reflection(hall: ForwardSolver) -> None:
    """Lengths are the polyline's, angles those of its first segment, and the mirrors are axis-aligned."""
    orders = np.zeros(4, dtype=int)
    for station, point in hall_pairs(24, seed=9):
        paths = hall.paths(station, point)
        segments = np.diff(paths.vertices, axis=1)
        np.testing.assert_allclose(np.linalg.norm(segments, axis=2).sum(axis=1), paths.path_length, rtol=0, atol=EXACT)
        for i, order in enumerate(paths.num_reflections):
            along = segments[i, : order + 1] / np.linalg.norm(segments[i, : order + 1], axis=1, keepdims=True)
            np.testing.assert_allclose(along[0], direction(paths)[i], rtol=0, atol=EXACT)
            np.testing.assert_array_equal(paths.vertices[i, order + 1 :], np.tile(point, (4 - order, 1)))
            for incoming, outgoing in itertools.pairwise(along):
                change = np.abs(outgoing + incoming) < EXACT
                assert change.sum() == 1  # one component turns round,
                np.testing.assert_allclose(outgoing[~change], incoming[~change], rtol=0, atol=EXACT)
            orders[order] += 1
        assert (np.diff(paths.gain_db) <= 0).all()
    assert (orders[:4] > 5).all()
