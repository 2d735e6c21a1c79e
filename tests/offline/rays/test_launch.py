"""Launched rays against closed forms: one wall, a closed room, a room with a hole, a corner."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_offline.rays.launch import launch
from rayfix_offline.rays.rays import sample_rays
from rayfix_offline.scene.walls import opaque_walls
from rayfix_offline.twin.planes import merge_coplanar
from tests.support.oracles.rays import Rows
from tests.support.scenes.shapes import quad

Launch = Callable[..., Rows]
Vectors = Callable[[int, int], NDArray[np.float64]]
SIZE = np.array([4.0, 5.0, 3.0])
STATION = np.array([3.6, 0.4, 2.6])
EXACT = 1e-9  # m


def points_at(segments: Rows, directions: NDArray[np.float64], length: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points at unfolded lengths, one per segment; NaN where there is no segment. Shape (n_rays, depth, 3), m."""
    sequences = segments.sequences
    heading = np.einsum("rdij,rj->rdi", sequences.mirrors[segments.sequence], directions)
    points = sequences.images[segments.sequence] + length[..., None] * heading
    return np.where(segments.sequence[..., None] >= 0, points, np.nan)


def assert_contiguous(segments: Rows, directions: NDArray[np.float64], station: NDArray[np.float64]) -> None:
    """Check that pieces follow each other without gaps, from the station on, and only while there is one before."""
    alive = segments.sequence >= 0
    assert alive[:, 0].all()
    assert not np.any(alive[:, 1:] & ~alive[:, :-1])
    np.testing.assert_array_equal(segments.start[:, 0], 0.0)
    assert np.all(segments.end[alive] >= segments.start[alive])
    np.testing.assert_array_equal(segments.start[:, 1:][alive[:, 1:]], segments.end[:, :-1][alive[:, 1:]])
    begin, stop = (points_at(segments, directions, length) for length in (segments.start, segments.end))
    np.testing.assert_allclose(begin[:, 0], np.broadcast_to(station, directions.shape), rtol=0, atol=0)
    gaps = (begin[:, 1:] - stop[:, :-1])[alive[:, 1:]]
    assert np.abs(gaps).max(initial=0.0) < EXACT


def assert_sequences_fit(segments: Rows) -> None:
    """Check that every sequence is its parent's with one more reflection."""
    sequences = segments.sequences
    assert (sequences.parents[0], sequences.planes[0], sequences.num_reflections[0]) == (-1, -1, 0)
    np.testing.assert_array_equal(sequences.mirrors[0], np.eye(3))
    children = np.arange(1, len(sequences.parents))
    parents = sequences.parents[children]
    assert np.all((parents >= 0) & (parents < children))
    np.testing.assert_array_equal(sequences.num_reflections[children], sequences.num_reflections[parents] + 1)
    # Two rays that meet the same planes in the same order share one image.
    assert len(set(zip(parents.tolist(), sequences.planes[children].tolist(), strict=True))) == len(children)
    sign = (-1.0) ** sequences.num_reflections
    np.testing.assert_allclose(np.linalg.det(sequences.mirrors), sign, rtol=0, atol=1e-12)
    alive = segments.sequence >= 0
    depth = np.broadcast_to(np.arange(segments.sequence.shape[1]), segments.sequence.shape)
    np.testing.assert_array_equal(sequences.num_reflections[segments.sequence[alive]], depth[alive])
    after, before = segments.sequence[:, 1:], segments.sequence[:, :-1]
    np.testing.assert_array_equal(sequences.parents[after[alive[:, 1:]]], before[alive[:, 1:]])


def test_one_wall(launch_rows: Launch) -> None:
    r"""A wall in the plane x = 0; the second ray misses it and ends where the scene does.

    ::

          |     * station (1, 0, 1)
     hit  o  .    \
          |         *  leaves the wall's bounding box

    image (-1, 0, 1)
    """
    wall = quad((0, -10, -10), (0, 10, -10), (0, 10, 10), (0, -10, 10))
    frame = quad((0, 20, 0), (9, 20, 0), (9, 20.1, 0), (0, 20.1, 0))
    directions = np.array([(-0.6, 0.8, 0.0), (0.8, -0.6, 0.0)])
    segments = launch_rows(np.concatenate([wall, frame]), (1, 0, 1), directions, max_reflections=2)
    sequences = segments.sequences
    assert segments.sequence.tolist() == [[0, 1, -1], [0, -1, -1]]
    np.testing.assert_allclose(sequences.images, [(1, 0, 1), (-1, 0, 1)], rtol=0, atol=1e-15)
    np.testing.assert_allclose(sequences.mirrors, [np.eye(3), np.diag((-1, 1, 1))], rtol=0, atol=1e-15)
    assert sequences.num_reflections.tolist() == [0, 1]
    # The first ray meets the wall after 1 / 0.6 m and leaves at x = 9, the second leaves at y = -10 or x = 9.
    np.testing.assert_allclose(segments.end[0, :2], [1 / 0.6, 10 / 0.6], rtol=0, atol=1e-14)
    np.testing.assert_allclose(segments.end[1, 0], 8 / 0.8, rtol=0, atol=1e-14)
    assert segments.lost_ray_share == 1.0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_empty_room(launch_rows: Launch, room: NDArray[np.float64], seed: int) -> None:
    """Unfolded, a ray is a straight line through a lattice of rooms; it is mirrored wherever it crosses a wall.

    ::

        +-------+-------+---.---+
        |       |       | .     |      crossings of x = i a, y = j b and z = k c, sorted by length
        |       |     . |       |
        |   * . | .     |       |
        +-------+-------+-------+
    """
    rng = np.random.default_rng(seed)
    station = SIZE * rng.uniform(0.02, 0.98, 3)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    segments = launch_rows(room, station, directions, max_reflections=4)
    walls = np.arange(-6, 7)[:, None] * SIZE
    with np.errstate(divide="ignore"):
        crossings = (walls - station) / directions[:, None, :]
    lengths = np.where(crossings > 0.0, crossings, np.inf).reshape(300, -1)
    order = np.argsort(lengths, axis=1)[:, :6]
    expected = np.take_along_axis(lengths, order, axis=1)
    # Single precision cannot tell which of two walls comes first within a few micrometres of their edge.
    clear = np.all(np.diff(expected, axis=1, prepend=0.0) > 1e-4, axis=1)
    assert clear.mean() > 0.98
    np.testing.assert_allclose(segments.end[clear], expected[clear, :5], rtol=0, atol=EXACT)
    # The others may pass between two walls.
    assert segments.lost_ray_share <= np.mean(~clear)
    # The image after the reflections at i walls across x, ... is the lattice point of the room that the ray is in.
    axis = order[:, :5] % 3
    for depth in range(5):
        crossed = np.stack([(axis[:, :depth] == a).sum(axis=1) for a in range(3)], axis=1) * np.sign(directions)
        # Folding the line back mirrors it an odd or even number of times along each axis.
        turns = np.where(crossed % 2 == 0, 1.0, -1.0)
        home = np.where(crossed % 2 == 0, station - crossed * SIZE, (crossed + 1.0) * SIZE - station)
        found = segments.sequences.mirrors[segments.sequence[:, depth]]
        np.testing.assert_allclose(found[clear], (np.eye(3) * turns[:, None])[clear], rtol=0, atol=1e-12)
        images = segments.sequences.images[segments.sequence[:, depth]]
        np.testing.assert_allclose(images[clear], home[clear], rtol=0, atol=EXACT)
    assert_contiguous(segments, directions, station)
    assert_sequences_fit(segments)


def test_hits_lie_on_their_planes(launch_rows: Launch, clutter: NDArray[np.float64], unit_vectors: Vectors) -> None:
    """In the clutter, every mirror point lies in the plane of a triangle and within the triangle's bounds."""
    directions = unit_vectors(5000, 5)
    segments = launch_rows(clutter, STATION, directions, max_reflections=3)
    assert_contiguous(segments, directions, STATION)
    assert_sequences_fit(segments)
    hits = points_at(segments, directions, segments.end).reshape(-1, 3)
    assert len(hits) == 20_000
    low, high = clutter.min(axis=1), clutter.max(axis=1)
    gap = np.full(len(hits), np.inf)
    for lower, upper in zip(low, high, strict=True):
        outside = np.maximum(np.maximum(lower - hits, hits - upper), 0.0)
        flat = np.flatnonzero(upper - lower == 0.0)
        assert len(flat) == 1
        beside = np.delete(outside, flat, axis=1).max(axis=1)
        # Across an edge single precision decides; off the plane there is no excuse.
        gap = np.minimum(gap, np.where(beside < 1e-5, outside[:, flat[0]], np.inf))
    assert gap.max() < EXACT
    assert segments.lost_ray_share <= 1e-3  # a ray or two may pass between two walls


def test_nothing_lies_between_the_ends_of_a_piece(
    launch_rows: Launch, clutter: NDArray[np.float64], unit_vectors: Vectors
) -> None:
    """No point along a ray is in a box or outside the room."""
    directions = unit_vectors(2000, 6)
    segments = launch_rows(clutter, STATION, directions, max_reflections=3)
    for share in np.linspace(0.0, 1.0, 23):
        points = points_at(segments, directions, segments.start + share * (segments.end - segments.start))
        assert np.all((points > -EXACT) & (points < SIZE + EXACT))
        for box in (clutter[12:24], clutter[24:]):
            depth = np.minimum(points - box.min(axis=(0, 1)), box.max(axis=(0, 1)) - points).min(axis=-1)
            assert depth.max() < 1e-6 * 4  # m


def test_the_longest_path(launch_rows: Launch, room: NDArray[np.float64], unit_vectors: Vectors) -> None:
    directions = unit_vectors(2000, 7)
    free, cut = (
        launch_rows(room, STATION, directions, max_reflections=5, max_path_length=length) for length in (1000.0, 7.0)
    )
    np.testing.assert_array_equal(cut.sequence >= 0, (free.sequence >= 0) & (free.start < 7.0))
    alive = cut.sequence >= 0
    np.testing.assert_allclose(cut.end[alive], np.minimum(free.end[alive], 7.0), rtol=0, atol=EXACT)
    assert cut.lost_ray_share <= 1e-3  # a ray or two may pass between two walls
    assert cut.end.max() == 7.0


def test_no_reflections(launch_rows: Launch, room: NDArray[np.float64], unit_vectors: Vectors) -> None:
    directions = unit_vectors(100, 8)
    none, one = (launch_rows(room, STATION, directions, max_reflections=n) for n in (0, 1))
    assert none.sequence.shape == (100, 1)
    np.testing.assert_array_equal(none.end[:, 0], one.end[:, 0])
    assert len(none.sequences.images) == 1


def test_a_missing_wall_loses_its_share_of_the_rays(launch_rows: Launch) -> None:
    """A cube without its wall at x = 2, seen from its middle: one sixth of the sphere.

    Rays stand for solid angles that differ by a thousandth from ring to ring, and 500 of 126,000 lie on the rim.
    """
    cube = np.concatenate([_side(axis, value) for axis in range(3) for value in (0.0, 2.0)])
    open_cube = cube[np.any(cube[:, :, 0] != 2.0, axis=1)]
    rays = sample_rays(0.01, np.random.default_rng(0))
    segments = launch_rows(open_cube, (1, 1, 1), rays.directions, max_reflections=0)
    assert segments.lost_ray_share == pytest.approx(1 / 6, abs=5e-4)
    # They end where the scene ends.
    lost = points_at(segments, rays.directions, segments.end)[:, 0, 0] > 2.0 - EXACT
    assert lost.mean() == pytest.approx(segments.lost_ray_share, abs=1e-9)  # one ray is 8e-6
    # After one reflection, those are lost that hit the wall first or second when it is there.
    closed = launch_rows(cube, (1, 1, 1), rays.directions, max_reflections=1)
    assert closed.lost_ray_share <= 1e-4  # few rays may pass between two walls
    gone = np.any(points_at(closed, rays.directions, closed.end)[:, :, 0] > 2.0 - EXACT, axis=1)
    assert gone.mean() > 0.19
    segments = launch_rows(open_cube, (1, 1, 1), rays.directions, max_reflections=1)
    assert segments.lost_ray_share == pytest.approx(gone.mean(), abs=2e-5)


def _side(axis: int, value: float) -> NDArray[np.float64]:
    """Give one side of the cube [0, 2]^3."""
    square = np.array([(0, 0), (2, 0), (2, 2), (0, 2)], dtype=float)
    return quad(*np.insert(square, axis, value, axis=1))


def test_a_corner_sends_rays_back(launch_rows: Launch) -> None:
    """Two walls at a right angle: after both, a ray runs against its first direction.

    ::

        |   /.    ray (-1, -1, 0) / sqrt(2) from (4, 2, 1): hits y = 0 at (2, 0, 1), then x = 0 at (0, 2, 1)
        | /.
        +------
    """
    walls = np.concatenate(
        [
            quad((0, 0, -5), (9, 0, -5), (9, 0, 5), (0, 0, 5)),
            quad((0, 0, -5), (0, 9, -5), (0, 9, 5), (0, 0, 5)),
        ]
    )
    direction = np.array([(-1.0, -1.0, 0.0)]) / np.sqrt(2.0)
    segments = launch_rows(walls, (4, 2, 1), direction, max_reflections=4)
    assert (segments.sequence[0] >= 0).tolist() == [True, True, True, False, False]
    np.testing.assert_allclose(segments.end[0, :2], np.sqrt(2.0) * np.array([2.0, 4.0]), rtol=0, atol=1e-14)
    last = segments.sequence[0, 2]
    np.testing.assert_allclose(segments.sequences.images[last], (-4, -2, 1), rtol=0, atol=1e-14)
    np.testing.assert_allclose(segments.sequences.mirrors[last], np.diag((-1, -1, 1)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(points_at(segments, direction, segments.end)[0, 2], (7, 9, 1), rtol=0, atol=1e-13)
    assert segments.lost_ray_share == 1.0


class Misled:
    """An engine that takes the first triangle for hit by every ray, as single precision may at an edge."""

    origin = np.zeros(3)

    def first_hit(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.int32]:
        """Say so."""
        return np.zeros(len(origins), np.int32)


def test_a_hit_behind_the_ray_is_a_loss() -> None:
    """The wall at x = 0 is ahead of the first ray, behind the second and parallel to the third."""
    wall = quad((0, -9, -9), (0, 9, -9), (0, 9, 9), (0, -9, 9))
    directions = np.array([(-1.0, 0, 0), (1.0, 0, 0), (0, 1.0, 0)])
    rows = Rows.of(
        launch(
            np.array([1.0, 0.0, 0.0]),
            directions,
            engine=Misled(),
            planes=merge_coplanar(wall),
            walls=opaque_walls(len(wall), loss_db=6.0),
            bounds=np.array([(0, -9, -9), (5, 9, 9)]),
            max_reflections=1,
            max_path_length=100.0,
        )
    )
    # Mirrored, the first ray is told of the same wall again, which is now behind it.
    assert (rows.sequence >= 0).tolist() == [[True, True], [True, False], [True, False]]
    np.testing.assert_allclose(rows.end, [(1, 6), (4, 0), (9, 0)], rtol=0, atol=1e-14)
    assert rows.lost_ray_share == 1.0


def test_a_thin_sheet_reflects_on_both_sides(launch_rows: Launch) -> None:
    sheet = quad((0, -9, -9), (0, 9, -9), (0, 9, 9), (0, -9, 9))
    frame = np.concatenate([quad((x, 9, 9), (x, 9, 8), (x, 8, 8), (x, 8, 9)) for x in (-3, 3)])
    for side in (1.0, -1.0):
        direction = np.array([(-side, 0.0, 0.0)])
        segments = launch_rows(np.concatenate([sheet, frame]), (side, 0.1, 0.2), direction, max_reflections=1)
        np.testing.assert_allclose(segments.end[0], [1.0, 4.0], rtol=0, atol=1e-14)
        stop = points_at(segments, direction, segments.end)[0, 1]
        np.testing.assert_allclose(stop, (3 * side, 0.1, 0.2), rtol=0, atol=1e-14)


@pytest.mark.parametrize("shift", [(448250.0, 5412330.0, 512.0), (-3.0e6, 40.0, 0.0)])
def test_map_coordinates_change_nothing(
    shift: tuple[float, float, float],
    clutter: NDArray[np.float64],
    launch_rows: Callable[..., Rows],
    unit_vectors: Vectors,
) -> None:
    """A scene on map coordinates has the same mirrors and lengths, and its images where the map has them."""
    directions, station = unit_vectors(2000, 5), np.array((3.6, 0.4, 2.6))
    here = launch_rows(clutter, station, directions)
    there = launch_rows(clutter + shift, station + shift, directions)
    assert there.lost_ray_share == here.lost_ray_share == 0.0
    same = (here.sequence >= 0).sum(axis=1) == (there.sequence >= 0).sum(axis=1)
    same &= np.abs(here.end - there.end).max(axis=1) < 1e-5
    assert same.mean() > 0.995  # the others run into an edge
    images = there.sequences.images[there.sequence[same]] - np.asarray(shift)
    np.testing.assert_allclose(images, here.sequences.images[here.sequence[same]], rtol=0, atol=1e-6)
