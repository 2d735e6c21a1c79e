"""The launcher against the image method, which shares no code with it; and what must not matter to it."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_tables.geometry.angles import direction
from tests.support.oracles.rays import Rows
from tests.support.scenes.shapes import box, cut_in_three, random_rotation

Launch = Callable[..., Rows]
Vectors = Callable[[int, int], NDArray[np.float64]]
STATION = np.array([3.6, 0.4, 2.6])
LOW, HIGH = np.array([0.05, 0.05, 0.05]), np.array([3.95, 4.95, 2.95])
EXACT = 1e-9  # m


def points_at(
    segments: Rows,
    directions: NDArray[np.float64],
    ray: NDArray[np.int64],
    depth: NDArray[np.int64],
    length: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Points of chosen pieces at unfolded lengths, shape (n, 3), m."""
    sequence = segments.sequence[ray, depth]
    heading = np.einsum("nij,nj->ni", segments.sequences.mirrors[sequence], directions[ray])
    return segments.sequences.images[sequence] + length[:, None] * heading


@pytest.fixture(scope="module")
def clutter(clutter: NDArray[np.float64]) -> NDArray[np.float64]:
    """Add a crate that hangs askew in the cluttered room, since reflections at right angles can be swapped."""
    crate = Rotation.from_euler("xyz", (15, 25, 40), degrees=True).apply(box((0, 0, 0), (0.8, 0.7, 0.6)).reshape(-1, 3))
    return np.concatenate([clutter, crate.reshape(-1, 3, 3) + np.array((1.8, 2.0, 1.4))])


@pytest.fixture(scope="module")
def solver(clutter: NDArray[np.float64]) -> ForwardSolver:
    """Image method in the cluttered room."""
    return ForwardSolver.from_mesh(
        clutter.reshape(-1, 3), np.arange(3 * len(clutter)).reshape(-1, 3), max_reflections=3
    )


def test_every_path_is_launched(clutter: NDArray[np.float64], launch_rows: Launch, solver: ForwardSolver) -> None:
    """Aimed along a path's angles, a ray meets its mirror points and goes through its end, at the path's length."""
    station = solver.station(STATION)
    targets = np.random.default_rng(0).uniform(LOW, HIGH, (60, 3))
    count = np.zeros(4, int)
    for target in targets:
        paths = station.paths(target)
        if not len(paths):
            continue
        directions = direction(paths.azimuth, paths.zenith)
        segments = launch_rows(clutter, STATION, directions, max_reflections=3)
        ray, depth = np.arange(len(paths)), paths.num_reflections
        assert np.all(segments.sequence[ray, depth] >= 0)
        assert np.all(segments.start[ray, depth] < paths.path_length)
        assert np.all(segments.end[ray, depth] > paths.path_length)
        ends = points_at(segments, directions, ray, depth, paths.path_length)
        np.testing.assert_allclose(ends, np.broadcast_to(target, ends.shape), rtol=0, atol=EXACT)
        np.testing.assert_array_equal(
            segments.sequences.num_reflections[segments.sequence[ray, depth]], paths.num_reflections
        )
        for bounce in range(3):
            on = ray[depth > bounce]
            bounces = points_at(segments, directions, on, np.full(len(on), bounce), segments.end[on, bounce])
            np.testing.assert_allclose(bounces, paths.vertices[on, bounce + 1], rtol=0, atol=EXACT)
        count += np.bincount(depth, minlength=4)
    assert np.all(count > (20, 100, 200, 200))


def test_every_launched_piece_is_a_path(
    clutter: NDArray[np.float64], launch_rows: Launch, solver: ForwardSolver, unit_vectors: Vectors
) -> None:
    """At a random place of each piece, the image method finds a path of that length, angle and number of bounces."""
    directions = unit_vectors(150, 1)
    segments = launch_rows(clutter, STATION, directions, max_reflections=3)
    station = solver.station(STATION)
    ray, depth = (index.ravel() for index in np.indices(segments.sequence.shape))
    start, end = segments.start[ray, depth], segments.end[ray, depth]
    length = start + np.random.default_rng(2).uniform(0.05, 0.95, len(ray)) * (end - start)
    places = points_at(segments, directions, ray, depth, length)
    for n in range(len(ray)):
        paths = station.paths(places[n])
        same = paths.num_reflections == depth[n]
        gaps = np.linalg.norm(
            direction(paths.azimuth[same], paths.zenith[same]) * paths.path_length[same, None]
            - directions[ray[n]] * length[n],
            axis=1,
        )
        assert gaps.min() < 1e-8  # m; the image method merges planes within 10 micrometres


# What must not matter


def lengths(segments: Rows) -> NDArray[np.float64]:
    """Give the ends of the pieces [m]; 0 where there is none."""
    return np.where(segments.sequence >= 0, segments.end, 0.0)


def assert_same_rays(actual: Rows, expected: Rows, *, atol: float = EXACT) -> None:
    """Check lengths and images; the numbers of sequences and planes may differ."""
    np.testing.assert_array_equal(actual.sequence >= 0, expected.sequence >= 0)
    np.testing.assert_allclose(lengths(actual), lengths(expected), rtol=0, atol=atol)
    alive = actual.sequence >= 0
    for name in ("images", "mirrors"):
        mine, theirs = (getattr(s.sequences, name)[s.sequence[alive]] for s in (actual, expected))
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=atol)
    assert len(actual.sequences.images) == len(expected.sequences.images)


@pytest.fixture(scope="module")
def rays(unit_vectors: Vectors) -> NDArray[np.float64]:
    """Directions of 1,000 rays."""
    return unit_vectors(1000, 3)


@pytest.fixture(scope="module")
def reference(clutter: NDArray[np.float64], launch_rows: Launch, rays: NDArray[np.float64]) -> Rows:
    """Launch the rays in the room as it is."""
    return launch_rows(clutter, STATION, rays)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_order_of_triangles_and_vertices(
    clutter: NDArray[np.float64], launch_rows: Launch, rays: NDArray[np.float64], reference: Rows, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    shuffled = clutter[rng.permutation(len(clutter))]
    corners = np.array([rng.permutation(3) for _ in shuffled])
    shuffled = shuffled[np.arange(len(shuffled))[:, None], corners]
    assert_same_rays(launch_rows(shuffled, STATION, rays), reference)


def test_splitting_triangles(
    clutter: NDArray[np.float64], launch_rows: Launch, rays: NDArray[np.float64], reference: Rows
) -> None:
    assert_same_rays(launch_rows(cut_in_three(clutter), STATION, rays), reference)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rigid_motion(
    clutter: NDArray[np.float64], launch_rows: Launch, rays: NDArray[np.float64], reference: Rows, seed: int
) -> None:
    """Moved by up to 50 m, single precision rounds edges to 4 micrometres: a ray in a thousand may take another way."""
    rng = np.random.default_rng(seed)
    rotation, shift = random_rotation(rng), rng.uniform(-50, 50, 3)
    moved = rotation.apply(clutter.reshape(-1, 3)).reshape(-1, 3, 3) + shift
    segments = launch_rows(moved, rotation.apply(STATION) + shift, rotation.apply(rays))
    same = np.abs(lengths(segments) - lengths(reference)).max(axis=1) < EXACT
    assert np.count_nonzero(~same) <= 3
    images = segments.sequences.images[segments.sequence[same]]
    expected = reference.sequences.images[reference.sequence[same]].reshape(-1, 3)
    np.testing.assert_allclose(images.reshape(-1, 3), rotation.apply(expected) + shift, rtol=0, atol=EXACT)


def test_a_far_object(
    clutter: NDArray[np.float64],
    launch_rows: Launch,
    rays: NDArray[np.float64],
    reference: Rows,
) -> None:
    """Behind the walls, 40 m away and askew, so that it shares no plane with the room.

    In the larger scene a mirrored ray starts 0.4 instead of 0.06 mm off its mirror, and may then miss an edge.
    """
    crate = Rotation.from_euler("xyz", (10, 20, 30), degrees=True).apply(box((0, 0, 0), (1, 1, 1)).reshape(-1, 3))
    scene = np.concatenate([clutter, crate.reshape(-1, 3, 3) + 40.0])
    segments = launch_rows(scene, STATION, rays)
    same = np.abs(lengths(segments) - lengths(reference)).max(axis=1) < EXACT
    assert np.count_nonzero(~same) <= 2
    images = segments.sequences.images[segments.sequence[same]]
    np.testing.assert_allclose(images, reference.sequences.images[reference.sequence[same]], rtol=0, atol=EXACT)


def test_rays_do_not_know_of_each_other(
    clutter: NDArray[np.float64], launch_rows: Launch, rays: NDArray[np.float64], reference: Rows
) -> None:
    order = np.random.default_rng(4).permutation(len(rays))
    segments = launch_rows(clutter, STATION, rays[order])
    np.testing.assert_array_equal(segments.end, reference.end[order])
    np.testing.assert_array_equal(
        segments.sequences.images[segments.sequence], reference.sequences.images[reference.sequence[order]]
    )
