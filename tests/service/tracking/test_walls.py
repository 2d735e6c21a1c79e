"""Ways against surfaces: the grid's kernel against all triangles."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.tracking.walls import walls_of
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.scene import Scene

Array = NDArray[np.float64]


def crossed(begin: Array, end: Array, triangles: Array) -> NDArray[np.bool_]:
    """Solve begin + t d = a + u (b - a) + v (c - a) for each way and triangle."""
    out = np.zeros(len(begin), np.bool_)
    for n, (start, stop) in enumerate(zip(begin, end, strict=True)):
        for a, b, c in triangles:
            t, u, v = np.linalg.solve(np.stack([start - stop, b - a, c - a], axis=1), start - a)
            out[n] |= 0 <= t <= 1 and u >= 0 and v >= 0 and u + v <= 1
    return out


@pytest.mark.parametrize("size", [0.8, 3.0])
def test_the_grid_finds_what_all_triangles_do(size: float, make_scene: Callable[..., Scene]):
    rng = np.random.default_rng(int(10 * size))
    triangles = rng.uniform(-4, 4, (60, 1, 3)) + rng.normal(scale=size, size=(60, 3, 3))
    begin = rng.uniform(-5, 5, (300, 3))
    end = begin + rng.normal(scale=1.5, size=(300, 3))
    expected = crossed(begin, end, triangles)
    assert 5 < expected.sum() < 295
    walls = walls_of(make_scene(triangles))
    np.testing.assert_array_equal(walls.passable(begin, end), ~expected)
    # A way is as passable backwards, and something far away changes nothing.
    np.testing.assert_array_equal(walls.passable(end, begin), ~expected)
    far = np.concatenate([triangles, triangles[:1] + 20.0])
    np.testing.assert_array_equal(walls_of(make_scene(far)).passable(begin, end), ~expected)


def test_a_sheet_stops_and_what_is_beside_it_does_not(sheet_scene: Scene):
    walls = walls_of(sheet_scene)
    begin = np.array([[-1.0, 0.0, 0.0], [-1.0, 6.0, 0.0], [-2.0, 0.0, 0.0], [-1e-9, 1.0, 1.0]])
    end = np.array([[1.0, 0.0, 0.0], [1.0, 6.0, 0.0], [-0.01, 0.0, 0.0], [1e-9, 1.0, 1.0]])
    assert walls.passable(begin, end).tolist() == [False, True, True, False]


def test_a_way_must_end_in_free_space(free_space: FreeSpace, make_scene: Callable[..., Scene]):
    free = free_space.free.copy()
    free[30:] = False
    space = FreeSpace(origin=free_space.origin, voxel_size=free_space.voxel_size, free=free)
    walls = walls_of(make_scene(np.empty((0, 3, 3)), space))
    origin = np.array([[-1.0, 0.0, 0.0]] * 3)
    assert walls.passable(origin, np.array([[-0.5, 0, 0], [0.5, 0, 0], [-99, 0, 0]])).tolist() == [True, False, False]
