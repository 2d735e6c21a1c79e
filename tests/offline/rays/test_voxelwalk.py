"""The walk through a voxel map against sampled points, and what it does at faces, edges and outside."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from rayfix_offline.rays.voxelwalk import RAY_RANGES, new_crossings, over_ray_ranges, power, walk

ORIGIN, VOXEL, SHAPE = np.array([-1.0, 2.0, 0.5]), 0.3, (7, 5, 4)
HIGH = ORIGIN + VOXEL * np.array(SHAPE)


def parts_of(
    image: ArrayLike, heading: ArrayLike, begin: float, stop: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Walk, and return the ends of the parts and their voxels."""
    lengths, voxels = new_crossings(SHAPE)
    direction = tuple(float(value) for value in np.asarray(heading))
    count = walk(np.array(image, float), direction, begin, stop, ORIGIN, VOXEL, SHAPE, lengths, voxels)
    return lengths[: count + 1], voxels[:count]


def voxel_at(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Voxel of each point, -1 outside."""
    index = np.floor((points - ORIGIN) / VOXEL).astype(int)
    inside = np.all((index >= 0) & (index < SHAPE), axis=-1)
    place = np.ravel_multi_index(tuple(np.clip(index, 0, np.array(SHAPE) - 1).T), SHAPE)
    return np.where(inside, place, -1)


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), axis_parallel=st.booleans())
def test_every_part_lies_in_its_voxel(seed: int, axis_parallel: bool) -> None:
    """Pieces that begin and end anywhere, inside or outside."""
    rng = np.random.default_rng(seed)
    image = ORIGIN + rng.uniform(-1.0, 3.0, 3)
    heading = rng.normal(size=3)
    if axis_parallel:
        heading[rng.permutation(3)[: rng.integers(1, 3)]] = 0.0
    heading /= np.linalg.norm(heading)
    begin, stop = np.sort(rng.uniform(-3.0, 3.0, 2))
    lengths, voxels = parts_of(image, heading, begin, stop)
    assert (lengths[0], lengths[-1]) == (begin, stop)
    assert np.all(np.diff(lengths) >= 0.0)
    share = np.linspace(0.01, 0.99, 9)
    for k in np.flatnonzero(np.diff(lengths) > 1e-9):
        points = image + (lengths[k] + share * (lengths[k + 1] - lengths[k]))[:, None] * heading
        np.testing.assert_array_equal(voxel_at(points), voxels[k])
    # No voxel is left and entered again, and none is passed over: each differs from the next by one step.
    inside = voxels[voxels >= 0]
    assert len(np.unique(inside)) == len(inside)
    if len(inside) > 1:
        steps = np.abs(np.diff(np.array(np.unravel_index(inside, SHAPE)), axis=1)).sum(axis=0)
        np.testing.assert_array_equal(steps, 1)


def test_a_diagonal_through_corners() -> None:
    """Where three faces meet, the walk goes through neighbours in parts of no length."""
    heading = np.ones(3) / np.sqrt(3.0)
    lengths, voxels = parts_of(ORIGIN, heading, 0.0, 4 * VOXEL * np.sqrt(3.0))
    long = np.flatnonzero(np.diff(lengths) > 1e-9)
    np.testing.assert_allclose(np.diff(lengths)[long], VOXEL * np.sqrt(3.0), rtol=1e-12)
    np.testing.assert_array_equal(voxels[long], np.ravel_multi_index((np.arange(4),) * 3, SHAPE))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_along_a_face(sign: float) -> None:
    """In a plane between voxels, either side is right, but only one of them."""
    start = (ORIGIN[0] if sign > 0 else HIGH[0], ORIGIN[1] + 2 * VOXEL, ORIGIN[2] + 0.1)
    lengths, voxels = parts_of(start, (sign, 0.0, 0.0), 0.0, SHAPE[0] * VOXEL)
    x, y, z = np.unravel_index(voxels[np.diff(lengths) > 1e-9], SHAPE)
    np.testing.assert_array_equal(np.sort(x), np.arange(SHAPE[0]))
    assert len(np.unique(y)) == 1
    assert y[0] in (1, 2)
    np.testing.assert_array_equal(z, 0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_from_a_face_of_the_map(sign: float) -> None:
    """A ray that starts on the map's border, as reflected ones do, is inside from the start when it goes inwards."""
    start = (ORIGIN[0] if sign > 0 else HIGH[0], 2.1, 0.6)
    lengths, voxels = parts_of(start, (sign, 0.0, 0.0), 0.0, 5.0)
    inner = np.flatnonzero(np.diff(lengths) > 1e-9)
    assert len(inner) == SHAPE[0] + 1
    assert voxels[inner[0]] >= 0
    assert voxels[inner[-1]] == -1
    outwards = parts_of(start, (-sign, 0.0, 0.0), 0.0, 5.0)
    assert np.diff(outwards[0])[outwards[1] >= 0].sum() == pytest.approx(0.0, abs=1e-12)


def test_a_piece_that_misses_the_map() -> None:
    for heading in ((1.0, 0.0, 0.0), (0.6, 0.8, 0.0)):
        lengths, voxels = parts_of((-5.0, 2.5, 9.0), heading, 1.0, 7.0)
        assert (lengths.tolist(), voxels.tolist()) == ([1.0, 7.0], [-1])


@settings(deadline=None)
@given(st.floats(1e-3, 1e3), st.one_of(st.integers(0, 10).map(float), st.floats(0.0, 20.0)))
def test_power(base: float, exponent: float) -> None:
    assert power(base, exponent) == pytest.approx(base**exponent, rel=1e-14)


@pytest.mark.parametrize("count", [0, 3, 1000])
def test_ranges_cover_all_rays_in_order(count: int) -> None:
    for jobs in (1, 2):
        ranges = over_ray_ranges(lambda first, stop: list(range(first, stop)), count, jobs)
        assert len(ranges) == RAY_RANGES
        assert [ray for some in ranges for ray in some] == list(range(count))
