"""The image method against closed forms."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.oracles.forward_paths import SIX_DB, bounces, direction, rotation, solver_of
from tests.support.scenes.shapes import box, quad


def test_one_wall() -> None:
    """A wall in the plane x = 0; the image of the station is as far behind it.

    ::

         |  ..*  point (3, 4, 2.5)
         |.. /
    hit  o  /
        .| /
       . |*  station (1, 0, 1)
      *  |
    image (-1, 0, 1)
    """
    solver = solver_of(quad((0, -10, -10), (0, 10, -10), (0, 10, 10), (0, -10, 10)))
    paths = solver.paths((1, 0, 1), (3, 4, 2.5))
    direct, reflected = np.sqrt(4 + 16 + 2.25), np.sqrt(16 + 16 + 2.25)
    np.testing.assert_allclose(paths.path_length, [direct, reflected], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(paths.num_reflections, [0, 1])
    # Seen from the station, the ray leaves towards the image of the point, (-3, 4, 2.5).
    np.testing.assert_allclose(paths.azimuth, [np.arctan2(4, 2), np.arctan2(4, -4)], rtol=0, atol=1e-15)
    np.testing.assert_allclose(paths.zenith, np.arccos([1.5 / direct, 1.5 / reflected]), rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        paths.gain_db, [-20 * np.log10(direct), -20 * np.log10(reflected) - SIX_DB], rtol=0, atol=1e-13
    )
    assert paths.vertices.shape == (2, 5, 3)
    point = [3, 4, 2.5]
    expected = [[[1, 0, 1], point, point, point, point], [[1, 0, 1], [0, 1, 1.375], point, point, point]]
    np.testing.assert_allclose(paths.vertices, expected, rtol=0, atol=1e-15)


def test_thin_wall_reflects_on_both_sides_and_lets_nothing_through() -> None:
    """The wall of :func:`test_one_wall` with the station on its right, its left, and the point across."""
    solver = solver_of(quad((0, -10, -10), (0, 10, -10), (0, 10, 10), (0, -10, 10)))
    right, left = solver.paths((1, 0, 0), (1, 6, 0)), solver.paths((-1, 0, 0), (-1, 6, 0))
    for paths in (right, left):
        np.testing.assert_allclose(paths.path_length, [6, np.sqrt(40)], rtol=0, atol=1e-14)
    np.testing.assert_allclose(left.vertices[1, 1], [0, 3, 0], rtol=0, atol=1e-15)
    assert len(solver.paths((1, 0, 0), (-1, 6, 0))) == 0
    assert len(solver.paths((1, 0, 0), (-1, 25, 0))) == 1  # past the wall's end: the direct path only


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_empty_box_has_the_lattice_of_images(seed: int) -> None:
    """In a closed box the images of the point form a lattice, and each is one path.

    ::

        +-------+-------+-------+
        |    *  |  *    |    *  |      cell i along x holds the point's image at i a + x (i even)
        +-------+=======+-------+      or i a + (a - x) (i odd), after abs(i) reflections
                |  * s  |
                +=======+

    With at most 3 reflections: 1 + 6 + 18 + 38 = 63 images.
    """
    rng = np.random.default_rng(seed)
    size = rng.uniform(2.0, 9.0, 3)
    station, point = size * rng.uniform(0.05, 0.95, (2, 3))
    paths = solver_of(box((0, 0, 0), tuple(size)), max_path_length=1000.0).paths(station, point)
    cells = np.array([c for c in itertools.product(range(-3, 4), repeat=3) if np.abs(c).sum() <= 3])
    assert len(paths) == len(cells) == 63
    offsets = cells * size + np.where(cells % 2 == 0, point, size - point) - station
    lengths = np.linalg.norm(offsets, axis=1)
    orders = np.abs(cells).sum(axis=1)
    gaps = np.linalg.norm((direction(paths) * paths.path_length[:, None])[:, None] - offsets[None], axis=2)
    match = gaps.argmin(axis=1)
    assert sorted(match) == list(range(63))
    assert gaps[np.arange(63), match].max() < 1e-12
    np.testing.assert_allclose(paths.path_length, lengths[match], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(paths.num_reflections, orders[match])
    assert (np.diff(paths.gain_db) <= 0).all()


def test_corner_has_one_double_bounce() -> None:
    """Two walls at a right angle: direct, one bounce off each, one double bounce (the other order misses).

    ::

    |   * point (2, 3, 0)
    |
    |         * station (4, 1, 0)
    +-----------
    """
    solver = solver_of(
        quad((0, 0, -5), (9, 0, -5), (9, 0, 5), (0, 0, 5)), quad((0, 0, -5), (0, 9, -5), (0, 9, 5), (0, 0, 5))
    )
    paths = solver.paths((4, 1, 0), (2, 3, 0))
    squares = [4 + 4, 4 + 16, 36 + 4, 36 + 16]
    np.testing.assert_allclose(paths.path_length, np.sqrt(squares), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(paths.num_reflections, [0, 1, 1, 2])
    # Straight from (4, 1) towards (-2, -3): it meets y = 0 at x = 2.5 before x = 0.
    np.testing.assert_allclose(bounces(paths, 3)[0], [2.5, 0, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(bounces(paths, 3)[1], [0, 5 / 3, 0], rtol=0, atol=1e-15)


def test_path_through_the_very_edge_of_a_corner_is_none() -> None:
    """Station and point on one line through the edge, turned at random.

    Both orders of the double bounce shrink to the edge, and rounding must not bring back one or both.
    """
    walls = np.concatenate(
        [
            quad((0, 0, -5), (9, 0, -5), (9, 0, 5), (0, 0, 5)),
            quad((0, 0, -5), (0, 9, -5), (0, 9, 5), (0, 0, 5)),
        ]
    )
    rng = np.random.default_rng(14)
    for turn in (np.eye(3), *(rotation(rng) for _ in range(20))):
        paths = solver_of(walls @ turn.T).paths(turn @ (4, 2, 0), turn @ (2, 1, 0))
        np.testing.assert_array_equal(paths.num_reflections, [0, 1, 1])


def test_screen_blocks_up_to_its_edge() -> None:
    """A screen in x = 2 up to z = 1; the shadow on x = 4 of a station at z = 0 ends at z = 2.

    ::

          |
    * s   |   o  z = 2 + 1e-5
          #   .  z = 2 - 1e-5
          #
    """
    solver = solver_of(quad((2, -1, -1), (2, 1, -1), (2, 1, 1), (2, -1, 1)))
    points = [(4, 0, 2 + 1e-5), (4, 0, 2 - 1e-5), (4, 0, 0), (1.9, 0, 0), (4, 2 + 1e-5, 0), (4, 2 - 1e-5, 0)]
    seen = solver.line_of_sight((0, 0, 0), points)
    np.testing.assert_array_equal(seen, [True, False, False, True, True, False])
    assert [len(solver.paths((0, 0, 0), point)) for point in points] == [1, 0, 0, 2, 1, 0]


def test_screen_blocks_one_leg_of_a_reflection() -> None:
    """A floor and a screen standing on it: each path by itself is hidden or not.

    ::

    s *          * p        direct: above the screen
          #                 reflected: hits the floor at x = 2; a screen at x = 1.5 as high as the ray there
    ______#_____________    is in its way
    """
    floor = quad((-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0))

    def kinds(height: float) -> list[int]:
        screen = quad((1.5, -1, 0), (1.5, 1, 0), (1.5, 1, height), (1.5, -1, height))
        paths = solver_of(floor, screen).paths((0, 0, 1), (4, 0, 1))
        return sorted(paths.num_reflections.tolist())

    # The ray from (0, 0, 1) to the floor at x = 2 is 0.25 m high at x = 1.5.
    assert kinds(0.25 - 1e-5) == [0, 1]
    assert kinds(0.25 + 1e-5) == [0]
    assert kinds(1.0 + 1e-5) == []


def test_gap_between_coplanar_walls_reflects_nothing() -> None:
    """Two walls in the plane y = 0, with a gap from x = 4 to x = 5; the bounce is half-way between the ends.

    ::

    s *   * p
    _______   ________
          4   5
    """
    left = quad((0, 0, -2), (4, 0, -2), (4, 0, 2), (0, 0, 2))
    right = quad((5, 0, -2), (9, 0, -2), (9, 0, 2), (5, 0, 2))
    solver = solver_of(left, right)
    assert solver.num_planes == 1

    def bounce_at(x: float) -> int:
        return int(solver.paths((x - 1, 1, 0), (x + 1, 1, 0)).num_reflections.sum())

    expected = {2.0: 1, 4 - 1e-5: 1, 4 + 1e-5: 0, 4.5: 0, 5 - 1e-5: 0, 5 + 1e-5: 1, 7.0: 1}
    assert {x: bounce_at(x) for x in expected} == expected


@pytest.mark.parametrize("where", [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.5, 0.5)])
def test_hit_on_an_edge_counts_once(where: tuple[float, float]) -> None:
    """Two walls side by side in z = 0, joined at x = 2; diagonals run from their lower left corners.

    ::

      +-------+-------+  y = 2
      |    /  |    /  |
      |  /    |  /    |
      +-------+-------+  y = -2
    x=-2      2       6
    """
    solver = solver_of(
        quad((-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)),
        quad((2, -2, 0), (6, -2, 0), (6, 2, 0), (2, 2, 0)),
    )
    x, y = where
    paths = solver.paths((x - 1, y, 1), (x + 1, y, 1))
    np.testing.assert_array_equal(paths.num_reflections, [0, 1])
    # And seen from above, nothing passes through the joints.
    assert not solver.line_of_sight((x, y, 1), [(x, y, -1), (x, y, -1e-3)]).any()


def test_nothing_slips_through_edges_and_corners_of_a_box() -> None:
    """Lines from outside to the centre of a box, exactly through corners, edge middles and face diagonals."""
    solver = solver_of(box((-1, -1, -1), (1, 1, 1)))
    aims = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    aims = aims[np.abs(aims).max(axis=1) > 0]
    for aim in aims:
        assert not solver.line_of_sight(3.0 * aim, [(0.0, 0.0, 0.0)]).any()


def test_flat_reflection_is_not_blocked_by_its_own_mirror() -> None:
    """A bounce in the middle of a long tiled floor, 25 m away from both ends and 0.1 mm below them.

    Every other tile lies 4 micrometres higher, as rounded vertices do: the ray meets that height a metre
    before and after its bounce.
    """
    xs = np.linspace(-30, 30, 41).tolist()
    tiles = [quad((a, -1, 0), (b, -1, 0), (b, 1, 0), (a, 1, 0)) for a, b in itertools.pairwise(xs)]
    floor = np.concatenate([tile + np.array([0, 0, 4e-6 * (i % 2)]) for i, tile in enumerate(tiles)])
    solver = solver_of(floor)
    assert solver.num_planes == 1
    for x in (0.2, 1.7):
        paths = solver.paths((x - 25, 0, 1e-4), (x + 25, 0, 1e-4))
        np.testing.assert_array_equal(paths.num_reflections, [0, 1])


def test_station_on_a_wall() -> None:
    """A station in the plane of a ceiling sees below it, and that ceiling sends nothing back to it."""
    paths = solver_of(box((0, 0, 0), (8, 6, 3)), max_reflections=1).paths((2, 2, 3), (5, 4, 1))
    # Direct, four walls and the floor.
    assert len(paths) == 6
    assert not np.isclose(bounces(paths, 0), 3.0).any()
    assert paths.path_length[0] == pytest.approx(np.sqrt(9 + 4 + 4), abs=1e-14)


def test_point_at_the_station_hears_its_echoes() -> None:
    paths = solver_of(box((0, 0, 0), (8, 6, 3)), max_reflections=1).paths((2, 2, 1), (2, 2, 1))
    np.testing.assert_allclose(np.sort(paths.path_length), [2, 4, 4, 4, 8, 12], rtol=0, atol=1e-14)


def test_azimuth_is_in_the_half_open_range() -> None:
    """Towards -x the azimuth is pi, never -pi, whatever the sign of the zero in y."""
    solver = solver_of(quad((-9, -9, -3), (9, -9, -3), (9, 9, -3), (-9, 9, -3)))
    for y in (0.0, -0.0):
        azimuth = solver.paths((1, 0.0, 0), (-1, y, 0)).azimuth
        np.testing.assert_allclose(azimuth, [np.pi, np.pi], rtol=0, atol=1e-12)
        assert azimuth.max() <= np.pi


def test_limits_of_length_and_reflections() -> None:
    room = box((0, 0, 0), (8, 6, 3))
    everything = solver_of(room, max_reflections=3, max_path_length=1000.0).paths((1, 1, 1), (6.5, 4.2, 1.7))
    for limit in (5.0, 10.0, 20.0):
        shorter = solver_of(room, max_reflections=3, max_path_length=limit).paths((1, 1, 1), (6.5, 4.2, 1.7))
        expected = everything.path_length[everything.path_length <= limit]
        np.testing.assert_allclose(shorter.path_length, expected, rtol=0, atol=1e-13)
    for most, count in ((0, 1), (1, 7), (2, 25), (3, 63), (4, 129)):
        solver = solver_of(room, max_reflections=most, max_path_length=1000.0)
        paths = solver.paths((1, 1, 1), (6.5, 4.2, 1.7))
        assert len(paths) == count
        assert paths.vertices.shape == (count, most + 2, 3)


def test_nearly_coplanar_walls_are_one_mirror() -> None:
    """Rounding of vertices does not make two mirrors of one wall, a visible step does."""
    left = quad((0, 0, -2), (4, 0, -2), (4, 0, 2), (0, 0, 2))
    right = left + np.array([4.0, 0.0, 0.0])
    assert solver_of(left, right + np.array([0.0, 5e-6, 0.0])).num_planes == 1
    assert solver_of(left, right + np.array([0.0, 1e-3, 0.0])).num_planes == 2


def test_sliver_across_a_plane_is_no_part_of_it() -> None:
    """A triangle of a micrometre's height standing on the floor must not reflect beside itself."""
    floor = quad((0, -1, 0), (4, -1, 0), (4, 1, 0), (0, 1, 0))
    sliver = np.array([[[5.0, 0.0, 0.0], [6.0, 0.0, 0.0], [5.5, 0.0, 5e-6]]])
    paths = solver_of(floor, sliver).paths((5.0, 0.3, 1), (6.0, 0.3, 1))
    np.testing.assert_array_equal(paths.num_reflections, [0])


def test_one_path_is_left_whole() -> None:
    solver = solver_of(box((0, 0, 0), (4, 5, 3)), max_reflections=1)
    paths = solver.paths((0.5, 0.6, 2.6), (1.6, 3.4, 1.1))
    assert len(paths) == 7  # the direct one and one for each side of the box
    for index in range(7):
        one = paths.only(index)
        assert len(one) == 1
        assert one.path_length[0] == paths.path_length[index]
        assert one.gain_db[0] == paths.gain_db[index]
        np.testing.assert_array_equal(one.vertices[0], paths.vertices[index])
