"""Mixtures of ray tubes: packing, slicing, types."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_tables.mixture import FIELD_DTYPES, FIELD_SHAPES, TubeMixture, joint_cov, pack, unpack, widening_cov

shapes = st.lists(st.integers(0, 3), max_size=2).map(tuple)
seeds = st.integers(0, 2**32 - 1)


def random_mixture(seed: int, count: int) -> TubeMixture:
    """Numbers of no meaning in double precision."""
    rng = np.random.default_rng(seed)
    fields = {name: rng.normal(size=(count, *shape)) for name, shape in FIELD_SHAPES.items()}
    fields["num_reflections"] = rng.integers(0, 9, count).astype(np.int8)
    fields["num_walls"] = rng.integers(0, 9, count).astype(np.int8)
    return TubeMixture(**fields)


def test_packing_by_hand() -> None:
    matrix = np.array([[1, 2, 3], [2, 4, 5], [3, 5, 6]])
    np.testing.assert_array_equal(pack(matrix), [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(unpack(np.arange(1, 7)), matrix)


@settings(deadline=None)
@given(seeds, shapes)
def test_packing_is_undone(seed: int, shape: tuple[int, ...]) -> None:
    packed = np.random.default_rng(seed).normal(size=(*shape, 6))
    matrices = unpack(packed)
    assert matrices.shape == (*shape, 3, 3)
    np.testing.assert_array_equal(matrices, np.swapaxes(matrices, -1, -2))
    np.testing.assert_array_equal(pack(matrices), packed)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_packing_keeps_the_type(dtype: type[np.generic]) -> None:
    assert pack(np.zeros((2, 3, 3), dtype)).dtype == dtype
    assert unpack(np.zeros((2, 6), dtype)).dtype == dtype


@settings(deadline=None)
@given(seeds, st.integers(0, 5), st.integers(0, 5))
def test_concatenated_parts_come_back_as_slices(seed: int, first: int, second: int) -> None:
    parts = [random_mixture(seed, first), random_mixture(seed + 1, second)]
    whole = TubeMixture.concatenate(parts)
    assert len(whole) == first + second
    for part, again in zip(parts, (whole[:first], whole[first:]), strict=True):
        for name in FIELD_SHAPES:
            np.testing.assert_array_equal(getattr(again, name), getattr(part, name))


def test_a_slice_is_a_view() -> None:
    mixture = random_mixture(0, 4)
    assert all(np.shares_memory(getattr(mixture[1:3], name), getattr(mixture, name)) for name in FIELD_SHAPES)


def test_nothing_is_an_empty_mixture() -> None:
    for mixture in (TubeMixture.empty(), TubeMixture.concatenate([])):
        assert len(mixture) == 0
        for name, shape in FIELD_SHAPES.items():
            assert getattr(mixture, name).shape == (0, *shape)
            assert getattr(mixture, name).dtype == FIELD_DTYPES[name]


@settings(deadline=None)
@given(seeds, st.integers(0, 5))
def test_stored_types(seed: int, count: int) -> None:
    """28 single-precision numbers and one small integer a component."""
    mixture = random_mixture(seed, count)
    stored = mixture.as_stored()
    for name, shape in FIELD_SHAPES.items():
        array = getattr(stored, name)
        assert array.shape == (count, *shape)
        assert array.flags.c_contiguous
        np.testing.assert_array_equal(array, getattr(mixture, name).astype(FIELD_DTYPES[name]))
    assert sum(getattr(stored, name).nbytes for name in FIELD_SHAPES) == count * (28 * 4 + 2)


def test_joint_moments_agree_with_sampling() -> None:
    """Of a million draws from the definition of a component; the sample's own deviation is some thousandths."""
    rng = np.random.default_rng(7)
    root, x_root = np.tril(rng.normal(size=(3, 3))) + 2.0 * np.eye(3), np.tril(rng.normal(size=(3, 3))) + np.eye(3)
    mixture = TubeMixture(
        log_weight=np.zeros(1),
        u_mean=np.array([[6.0, 0.3, -0.2]]),
        u_cov=pack((root @ root.T)[None]),
        x_mean=np.zeros((1, 3)),
        jacobian=rng.normal(size=(1, 3, 3)),
        x_cov=pack((x_root @ x_root.T)[None]),
        num_reflections=np.zeros(1, np.int8),
        num_walls=np.zeros(1, np.int8),
    )
    d = rng.standard_normal((1_000_000, 3)) @ root.T
    slopes = mixture.jacobian[0]
    x = d @ slopes.T + (d[:, :1] * d[:, 1:]) @ slopes[:, 1:].T / 6.0 + rng.standard_normal(d.shape) @ x_root.T
    found = joint_cov(mixture)[0]
    np.testing.assert_allclose(found, np.cov(np.column_stack([d, x]).T), rtol=0, atol=0.01 * np.trace(found) / 6.0)


def test_widening_of_a_straight_tube_by_hand() -> None:
    """Rays from the origin along +x: a step da at length L moves a place by L da, so dL da is what is not linear."""
    u_mean = np.array([[10.0, 0.0, 0.0]])
    u_cov = np.diag([4.0, 1e-4, 9e-4])[None]
    jacobian = np.array([[[1.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, -10.0]]])
    np.testing.assert_allclose(widening_cov(u_mean, u_cov, jacobian)[0], np.diag([0.0, 4e-4, 36e-4]), rtol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_widening_agrees_with_sampling(seed: int) -> None:
    """Of a million Gaussian ray coordinates; the sample's own deviation is some thousandths."""
    rng = np.random.default_rng(seed)
    root = np.tril(rng.normal(size=(3, 3))) + np.diag([2.0, 1.0, 1.0])
    jacobian, length = rng.normal(size=(3, 3)), 7.0
    d = rng.standard_normal((1_000_000, 3)) @ root.T
    moved = (d[:, :1] * d[:, 1:]) @ jacobian[:, 1:].T / length
    found = widening_cov(np.array([[length, 0.0, 0.0]]), (root @ root.T)[None], jacobian[None])[0]
    np.testing.assert_allclose(found, np.cov(moved.T), rtol=0, atol=0.01 * np.trace(found))
