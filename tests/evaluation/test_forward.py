"""The image method against closed forms, a naive oracle and an exhaustive tree."""

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from rayfix.evaluation.forward import ForwardSolver, Paths, StationSolver
from rayfix.evaluation.images import ImageTree
from rayfix.example.hall import HALL_SIZE, hall_scene, hall_stations
from rayfix_tables.errors import SceneError

Array = NDArray[np.float64]
EXACT = 1e-9  # m and rad
SIX_DB = 6.0


def quad(*corners: ArrayLike) -> Array:
    """Return two triangles, of shape (2, 3, 3), m; their common diagonal joins corners 0 and 2."""
    a, b, c, d = np.array(corners, dtype=float)
    return np.array([[a, b, c], [a, c, d]])


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Array:
    """Return the twelve triangles of an axis-aligned box."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return np.concatenate(
        [
            quad((x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)),
            quad((x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)),
            quad((x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)),
            quad((x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1)),
            quad((x0, y0, z0), (x0, y1, z0), (x0, y1, z1), (x0, y0, z1)),
            quad((x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)),
        ]
    )


def solver_of(*parts: Array, max_reflections: int = 3, max_path_length: float = 60.0) -> ForwardSolver:
    """Build the solver of triangles, each with vertices of its own."""
    triangles = np.concatenate(parts)
    return ForwardSolver.from_mesh(
        triangles.reshape(-1, 3),
        np.arange(3 * len(triangles)).reshape(-1, 3),
        max_reflections=max_reflections,
        max_path_length=max_path_length,
        reflection_loss_db=SIX_DB,
    )


def rotation(rng: np.random.Generator) -> Array:
    """Draw a rotation uniformly."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def direction(paths: Paths) -> Array:
    """Return the unit vectors of the paths' angles at the station."""
    ring = np.sin(paths.zenith)
    return np.stack([ring * np.cos(paths.azimuth), ring * np.sin(paths.azimuth), np.cos(paths.zenith)], axis=1)


def bounces(paths: Paths, i: int) -> Array:
    """Return the reflection points of path i, of shape (num_reflections, 3), m."""
    return paths.vertices[i, 1 : 1 + paths.num_reflections[i]]


def assert_same_paths(actual: Paths, expected: Paths, atol: float = EXACT) -> None:
    """Check that both hold the same paths; those of equal gain may be in any order."""
    assert len(actual) == len(expected)
    np.testing.assert_allclose(actual.gain_db, expected.gain_db, rtol=0, atol=1e-7)
    if len(actual) == 0:
        return
    # Match by all vertices at once, so that a duplicate cannot stand for a missing path.
    gaps = np.abs(actual.vertices[:, None] - expected.vertices[None]).max(axis=(2, 3))
    match = gaps.argmin(axis=1)
    assert sorted(match) == list(range(len(expected)))
    assert gaps[np.arange(len(actual)), match].max() < atol
    np.testing.assert_allclose(actual.path_length, expected.path_length[match], rtol=0, atol=atol)
    np.testing.assert_allclose(direction(actual), direction(expected)[match], rtol=0, atol=atol)
    np.testing.assert_array_equal(actual.num_reflections, expected.num_reflections[match])


@pytest.fixture(scope="module")
def hall_triangles() -> Array:
    mesh = hall_scene().to_geometry()
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)]


@pytest.fixture(scope="module")
def hall(hall_triangles: Array) -> ForwardSolver:
    return solver_of(hall_triangles)


def hall_pairs(count: int, seed: int) -> Iterator[tuple[Array, Array]]:
    """Yield stations and points in the hall; some points are inside solids, where only leaks would lead."""
    rng = np.random.default_rng(seed)
    stations = [np.array(position) for _, position in hall_stations()]
    for i in range(count):
        yield stations[i % 4], rng.uniform((0.1, 0.1, 0.1), np.array(HALL_SIZE) - 0.1)


# Closed forms


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
        np.testing.assert_array_equal(solver.paths((1, 0.0, 0), (-1, y, 0)).azimuth, [np.pi, np.pi])


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


# Metamorphic


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


# Oracles


def crosses(start: Array, end: Array, triangles: Array) -> bool:
    """Tell whether a segment crosses a triangle strictly between its ends (Moeller and Trumbore)."""
    along = end - start
    e1, e2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(along, e2)
    det = np.einsum("fi,fi->f", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = start - triangles[:, 0]
        u = np.einsum("fi,fi->f", s, p) / det
        q = np.cross(s, e1)
        v = q @ along / det
        t = np.einsum("fi,fi->f", e2, q) / det
        margin = 1e-6 / np.linalg.norm(along)
        return bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > margin) & (t < 1 - margin)).any())


def naive_paths(planes: list[Array], station: Array, point: Array, max_reflections: int) -> list[tuple[int, ...]]:
    """Try all sequences of planes, each given by its triangles; return those that carry a path."""
    triangles = np.concatenate(planes)
    normals = [np.cross(t[0, 1] - t[0, 0], t[0, 2] - t[0, 0]) for t in planes]
    normals = [n / np.linalg.norm(n) for n in normals]
    anchors = [t[0, 0] for t in planes]
    found = []
    for order in range(max_reflections + 1):
        for sequence in itertools.product(range(len(planes)), repeat=order):
            if any(a == b for a, b in itertools.pairwise(sequence)):
                continue
            # Mirror the point from the last plane to the first; walk from the station towards the images.
            images = [point]
            for k in reversed(sequence):
                images.append(images[-1] - 2 * ((images[-1] - anchors[k]) @ normals[k]) * normals[k])
            vertices = [station]
            for k, image in zip(sequence, reversed(images[1:]), strict=True):
                start, stop = ((x - anchors[k]) @ normals[k] for x in (vertices[-1], image))
                if start * stop >= 0:
                    break
                hit = vertices[-1] + start / (start - stop) * (image - vertices[-1])
                across = 0.01 * normals[k]
                if not crosses(hit - across, hit + across, planes[k]):
                    break
                vertices.append(hit)
            else:
                vertices.append(point)
                sides = [
                    ((vertices[i] - anchors[k]) @ normals[k]) * ((vertices[i + 2] - anchors[k]) @ normals[k])
                    for i, k in enumerate(sequence)
                ]
                clear = not any(crosses(a, b, triangles) for a, b in itertools.pairwise(vertices))
                if clear and all(side > 0 for side in sides):
                    found.append(sequence)
    return found


def sequences_of(planes: list[Array], paths: Paths) -> list[tuple[int, ...]]:
    """Name the paths' sequences in terms of the given planes, from where the bounces lie."""
    normals = np.array([np.cross(t[0, 1] - t[0, 0], t[0, 2] - t[0, 0]) for t in planes])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    anchors = np.array([t[0, 0] for t in planes])
    return [
        tuple(int(np.abs(((x - anchors) * normals).sum(axis=1)).argmin()) for x in bounces(paths, i))
        for i in range(len(paths))
    ]


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_naive_oracle_on_tilted_quads(seed: int) -> None:
    """Seven tilted parallelograms around the ends, with gaps and overlaps; every sequence is tried."""
    rng = np.random.default_rng(seed)
    planes = []
    for outward in rng.permutation(np.concatenate([np.eye(3), -np.eye(3), np.ones((1, 3))])):
        tilted = np.linalg.qr(np.column_stack([outward, rng.standard_normal((3, 2))]) + 0.2 * rng.random((3, 3)))[0]
        centre = rng.uniform(2.0, 3.0) * outward
        along, across = tilted[:, 1] * rng.uniform(1.5, 3.5), tilted[:, 2] * rng.uniform(1.5, 3.5)
        corners = [centre + a * along + b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        planes.append(quad(*corners))
    solver = solver_of(*planes, max_path_length=1000.0)
    assert solver.num_planes == 7
    orders = np.zeros(4, dtype=int)
    for _ in range(6):
        station, point = rng.uniform(-2, 2, (2, 3))
        expected = naive_paths(planes, station, point, 3)
        actual = sequences_of(planes, solver.paths(station, point))
        assert sorted(actual) == sorted(expected)
        for sequence in expected:
            orders[len(sequence)] += 1
    assert orders[1] > 5
    assert orders[2:].sum() > 5


def test_agrees_with_naive_oracle_in_a_cluttered_room() -> None:
    """A room with one box on its floor, which also shares the floor's plane: eleven planes, two bounces."""
    room, crate = box((0, 0, 0), (6, 5, 3)), box((2, 2, 0), (3.5, 3, 2))
    sides = [room[i : i + 2] for i in range(0, 12, 2)] + [crate[i : i + 2] for i in range(0, 12, 2)]
    planes = [np.concatenate([sides[0], sides[6]]), *sides[1:6], *sides[7:]]
    solver = solver_of(room, crate, max_reflections=2)
    assert solver.num_planes == 11
    rng = np.random.default_rng(11)
    counts = set()
    for _ in range(6):
        station, point = rng.uniform((0.1, 0.1, 0.1), (5.9, 4.9, 2.9), (2, 3))
        expected = naive_paths(planes, station, point, 2)
        assert sorted(sequences_of(planes, solver.paths(station, point))) == sorted(expected)
        counts.add(len(expected))
    assert max(counts) > 10


def exhaustive_tree(solver: ForwardSolver, station: Array) -> ImageTree:
    """Mirror a station at all sequences of planes, with windows without bounds."""
    normals, offsets = solver.scene.normals, solver.scene.offsets
    images, planes, parents = [station], [-1], [-1]
    level = [0]
    for _ in range(solver.max_reflections - 1):
        following = []
        for node in level:
            heights = normals @ images[node] - offsets
            mirrored = images[node] - 2.0 * heights[:, None] * normals
            for k in range(len(normals)):
                if k != planes[node]:
                    following.append(len(images))
                    images.append(mirrored[k])
                    planes.append(k)
                    parents.append(node)
        level = following
    infinite = np.full((len(images), 3), np.inf)
    return ImageTree(np.array(images), np.array(planes), np.array(parents), -infinite, infinite)


def test_pruned_tree_finds_what_the_exhaustive_one_finds(hall: ForwardSolver) -> None:
    rng = np.random.default_rng(12)
    found = 0
    for position in (hall_stations()[0][1], (4.6, 7.9, 2.2)):
        pruned = hall.station(position)
        full = StationSolver(solver=hall, position=pruned.position, tree=exhaustive_tree(hall, pruned.position))
        assert len(full.tree.planes) == 1 + hall.num_planes + hall.num_planes * (hall.num_planes - 1)
        assert len(pruned.tree.planes) < len(full.tree.planes) / 3
        for point in rng.uniform((0.1, 0.1, 0.1), np.array(HALL_SIZE) - 0.1, (12, 3)):
            assert_same_paths(pruned.paths(point), full.paths(point), atol=1e-12)
            found += len(full.paths(point))
    assert found > 100


def test_line_of_sight_agrees_with_plain_numpy(hall: ForwardSolver, hall_triangles: Array) -> None:
    rng = np.random.default_rng(13)
    points = rng.uniform((0.1, 0.1, 0.1), np.array(HALL_SIZE) - 0.1, (150, 3))
    for _, position in hall_stations():
        station = np.array(position)
        expected = [not crosses(station, point, hall_triangles) for point in points]
        np.testing.assert_array_equal(hall.line_of_sight(station, points), expected)
        assert 0 < sum(expected) < len(points)


# Errors


def test_meshes_that_cannot_be_used() -> None:
    with pytest.raises(SceneError, match="no triangle with an area"):
        solver_of(np.array([[[0.0, 0, 0], [1, 1, 1], [2, 2, 2]]]))
    with pytest.raises(SceneError, match="not finite"):
        solver_of(np.array([[[0.0, 0, 0], [1, np.nan, 1], [2, 2, 0]]]))


def test_arguments_that_cannot_be_used() -> None:
    floor = quad((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0))
    with pytest.raises(ValueError, match="max_reflections is -1"):
        solver_of(floor, max_reflections=-1)
    with pytest.raises(ValueError, match="max_path_length is nan"):
        solver_of(floor, max_path_length=float("nan"))
    with pytest.raises(ValueError, match="the point is"):
        solver_of(floor).paths((0, 0, 1), (0, np.inf, 1))
    with pytest.raises(ValueError, match="the station is"):
        solver_of(floor).line_of_sight((0, 0), [(0, 0, 1)])


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
