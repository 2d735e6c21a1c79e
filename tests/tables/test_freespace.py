"""The voxel map of the free space."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_tables.freespace import FreeSpace


def test_an_l_shaped_room() -> None:
    """Seen from above, voxels of 0.5 m from (1, 2, 0); ``#`` is solid.

    ::

        y = 3.0  +---+---+
                 | # |   |
        y = 2.5  +---+---+
                 |   |   |
        y = 2.0  +---+---+
             x = 1  1.5  2
    """
    free = np.array([[[True], [False]], [[True], [True]]])
    space = FreeSpace(origin=np.array([1.0, 2.0, 0.0]), voxel_size=0.5, free=free)
    assert space.volume == 3 * 0.125
    points = np.array([[1.1, 2.1, 0.1], [1.1, 2.6, 0.1], [1.9, 2.9, 0.4], [1.9, 2.1, 0.4]])
    np.testing.assert_array_equal(space.contains(points), [True, False, True, True])
    outside = np.array([[0.99, 2.1, 0.1], [2.01, 2.1, 0.1], [1.1, 1.99, 0.1], [1.1, 2.1, -0.01], [1.1, 2.1, 0.51]])
    assert not space.contains(outside).any()
    # Low sides belong to the voxel, high sides to the next.
    assert space.contains(np.array([1.0, 2.0, 0.0]))
    assert not space.contains(np.array([2.0, 2.0, 0.0]))


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_voxel_centres_say_what_their_voxel_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.01, 2.0)
    space = FreeSpace(origin=rng.uniform(-50, 50, 3), voxel_size=size, free=rng.random(rng.integers(1, 6, 3)) < 0.5)
    index = np.stack(np.meshgrid(*(np.arange(-1, n + 1) for n in space.free.shape), indexing="ij"), axis=-1)
    jitter = rng.uniform(-0.499, 0.499, index.shape)
    found = space.contains(space.origin + (index + 0.5 + jitter) * size)
    np.testing.assert_array_equal(found, np.pad(space.free, 1))


def test_shapes_of_points() -> None:
    space = FreeSpace(origin=np.zeros(3), voxel_size=1.0, free=np.ones((1, 1, 1), bool))
    assert space.contains(np.full((4, 5, 3), 0.5)).shape == (4, 5)
    assert space.contains(np.zeros((0, 3))).shape == (0,)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_largest_deviation_is_that_of_points_drawn_anywhere(seed: int) -> None:
    rng = np.random.default_rng(seed)
    free = rng.random(rng.integers(1, 7, 3)) < 0.5
    free[0, 0, 0] = True
    space = FreeSpace(origin=rng.uniform(-50, 50, 3), voxel_size=rng.uniform(0.01, 2.0), free=free)
    # Two Gauss-Legendre points along each side of a voxel have its first and second moments.
    node = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T / np.sqrt(3.0)
    points = (np.argwhere(free)[:, None] + node).reshape(-1, 3) * space.voxel_size
    cov = np.atleast_2d(np.cov(points.T, bias=True))
    assert space.largest_stdev == pytest.approx(np.sqrt(np.linalg.eigvalsh(cov)[-1]), rel=1e-9)


def test_the_largest_deviation_of_a_long_hall() -> None:
    space = FreeSpace(origin=np.zeros(3), voxel_size=0.5, free=np.ones((40, 10, 6), bool))
    assert space.largest_stdev == pytest.approx(20.0 / np.sqrt(12.0), rel=1e-12)


@pytest.mark.parametrize(("shape", "share"), [((7, 40, 30), 0.6), ((40, 7, 30), 0.01), ((3, 4, 5), 1.0)])
def test_points_all_over_are_free_voxels_in_even_steps(shape: tuple[int, int, int], share: float) -> None:
    free = np.random.default_rng(3).random(shape) <= share
    free[2:] &= shape[0] < 40  # most layers without a voxel
    space = FreeSpace(origin=np.array([1.0, -2.0, 0.5]), voxel_size=0.25, free=free)
    every = np.argwhere(free)
    step = max(1, len(every) // 1000)
    np.testing.assert_allclose(space.points_all_over, space.origin + 0.25 * (every[::step] + 0.5))
    assert len(space.points_all_over) >= min(len(every), 1000)
