"""Runnalls' reduction against a plain one, and what merging must preserve."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_offline.fit.runnalls import LANES, merge_runnalls, new_scratch, union_log_dets

Array = NDArray[np.float64]
Mixture = tuple[Array, Array, Array]
seeds = st.integers(0, 2**32 - 1)
NEVER = -1.0
"""A divergence that no merge stays below."""


def random_mixture(seed: int, count: int, size: int = 3) -> Mixture:
    """Weights that sum to 1, means a few standard deviations apart, and covariances."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(count, size, size))
    cov = roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(size)
    return rng.dirichlet(np.ones(count)), 3.0 * rng.normal(size=(count, size)), cov


def moments(weight: Array, mean: Array, cov: Array) -> tuple[float, Array, Array]:
    """Weight, mean and covariance of a whole mixture."""
    total = float(weight.sum())
    middle = weight @ mean / total
    off = mean - middle
    return total, middle, np.einsum("n,nij->ij", weight / total, cov + off[:, :, None] * off[:, None, :])


def divergence(mixture: Mixture, i: int, j: int) -> float:
    """Runnalls' bound B(i, j)."""
    weight, mean, cov = mixture
    pair = [i, j]
    total, _, union = moments(weight[pair], mean[pair], cov[pair])
    logs = np.linalg.slogdet(np.stack([union, cov[i], cov[j]]))[1]
    return float((total * logs[0] - weight[i] * logs[1] - weight[j] * logs[2]) / 2.0)


def naive(mixture: Mixture, label: list[int], max_components: int, max_divergence: float) -> tuple[Mixture, list[int]]:
    """Merge the cheapest pair, found anew each time."""
    weight, mean, cov = (field.copy() for field in mixture)
    label = list(label)
    while len(weight) > 1:
        pairs = [(i, j) for i in range(len(weight)) for j in range(i)]
        costs = [divergence((weight, mean, cov), i, j) for i, j in pairs]
        best = int(np.argmin(costs))
        if len(weight) <= max_components and costs[best] > max_divergence:
            break
        i, j = pairs[best]
        total, middle, union = moments(weight[[i, j]], mean[[i, j]], cov[[i, j]])
        kept = label[i] if weight[i] > weight[j] else label[j]
        rest = [k for k in range(len(weight)) if k not in (i, j)]
        weight = np.append(weight[rest], total)
        mean, cov = np.append(mean[rest], middle[None], axis=0), np.append(cov[rest], union[None], axis=0)
        label = [*(label[k] for k in rest), kept]
    return (weight, mean, cov), label


def reduce(mixture: Mixture, max_components: int, max_divergence: float) -> tuple[Mixture, list[int]]:
    """Run the kernel on copies."""
    weight, mean, cov = (field.copy() for field in mixture)
    label = np.arange(len(weight))
    alive = merge_runnalls(weight, mean, cov, label, max_components, max_divergence)
    return (weight[alive], mean[alive], cov[alive]), label[alive].tolist()


def sort(mixture: Mixture, label: list[int]) -> tuple[Mixture, list[int]]:
    """Order by label, which are all different."""
    order = np.argsort(label)
    return tuple(field[order] for field in mixture), [label[k] for k in order]  # type: ignore[return-value]


def log_dets(mixture: Mixture, i: int, first: int, stop: int) -> Array:
    """Run the kernel; NaN where it must not write."""
    weight, mean, cov = mixture
    size = mean.shape[1]
    triangles = np.ascontiguousarray(cov[:, *np.tril_indices(size)].T)
    out = np.full(len(weight), np.nan)
    union_log_dets(i, first, stop, weight, np.ascontiguousarray(mean.T), triangles, new_scratch(size), out)
    return out


@settings(deadline=None)
@given(seeds, st.integers(1, 7), st.integers(1, 9))
def test_determinants_of_unions(seed: int, size: int, count: int) -> None:
    weight, mean, cov = mixture = random_mixture(seed, count, size)
    i = seed % count
    unions = [moments(weight[[i, k]], mean[[i, k]], cov[[i, k]])[2] for k in range(count)]
    found = log_dets(mixture, i, 0, count)
    np.testing.assert_allclose(found, np.linalg.slogdet(np.array(unions))[1], rtol=0, atol=1e-10)
    assert found[i] == pytest.approx(np.linalg.slogdet(cov[i])[1], abs=1e-10)


def test_determinants_of_more_unions_than_lanes() -> None:
    """Any part of the components gives the same numbers, and nothing beside it is written."""
    count = 2 * LANES + 3
    mixture = random_mixture(5, count, 6)
    whole = log_dets(mixture, 7, 0, count)
    assert np.all(np.isfinite(whole))
    for first, stop in ((0, 1), (1, LANES + 2), (LANES - 1, count), (count, count)):
        part = log_dets(mixture, 7, first, stop)
        np.testing.assert_array_equal(part[first:stop], whole[first:stop])
        assert np.isnan(np.delete(part, np.s_[first:stop])).all()


@settings(max_examples=40, deadline=None)
@given(seed=seeds, count=st.integers(1, 12), size=st.sampled_from([1, 2, 6]), most=st.integers(1, 12))
def test_reduction_to_a_number(seed: int, count: int, size: int, most: int) -> None:
    mixture = random_mixture(seed, count, size)
    found, label = sort(*reduce(mixture, most, NEVER))
    expected, its_label = sort(*naive(mixture, list(range(count)), most, NEVER))
    assert len(found[0]) == min(count, most)
    assert label == its_label
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9)


def test_a_merged_component_can_become_the_best_partner_of_another() -> None:
    """One of a thousand random mixtures in the plane where that decides what is merged; found by search."""
    rng = np.random.default_rng(304)
    count, size = int(rng.integers(4, 14)), int(rng.choice([1, 2]))
    weight = rng.dirichlet(np.full(count, rng.choice([0.2, 1.0, 5.0])))
    mean = rng.normal(size=(count, size)) * rng.choice([0.5, 1.0, 3.0])
    roots = rng.normal(size=(count, size, size))
    cov = roots @ np.swapaxes(roots, 1, 2) * rng.choice([1.0, 0.1]) + 0.05 * np.eye(size)
    found, label = sort(*reduce((weight, mean, cov), 2, NEVER))
    expected, its_label = sort(*naive((weight, mean, cov), list(range(count)), 2, NEVER))
    assert label == its_label
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)


@settings(max_examples=40, deadline=None)
@given(seed=seeds, count=st.integers(2, 12), most=st.integers(1, 12), limit=st.floats(1e-4, 1.0))
def test_reduction_to_a_cost(seed: int, count: int, most: int, limit: float) -> None:
    mixture = random_mixture(seed, count)
    found, label = sort(*reduce(mixture, most, limit))
    expected, its_label = sort(*naive(mixture, list(range(count)), most, limit))
    assert label == its_label
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9)
    # It stops because what is left is few enough and any merge would cost more.
    left = len(label)
    assert left <= most
    costs = [divergence(found, i, j) for i in range(left) for j in range(i)]
    assert min(costs, default=np.inf) > limit


@settings(max_examples=40, deadline=None)
@given(seed=seeds, count=st.integers(1, 40), most=st.integers(1, 40))
def test_moments_are_preserved(seed: int, count: int, most: int) -> None:
    mixture = random_mixture(seed, count, 6)
    found, _ = reduce(mixture, most, 0.05)
    for mine, theirs in zip(moments(*found), moments(*mixture), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-10, atol=1e-10)
    for cov in found[2]:
        assert np.linalg.eigvalsh(cov).min() > 0.0


@settings(deadline=None)
@given(seeds)
def test_a_merge_costs_at_least_nothing_and_twins_cost_nothing(seed: int) -> None:
    weight, mean, cov = random_mixture(seed, 2)
    assert divergence((weight, mean, cov), 0, 1) > 0.0
    twins = (np.array([0.3, 0.7]), np.tile(mean[:1], (2, 1)), np.tile(cov[:1], (2, 1, 1)))
    (merged, label) = reduce(twins, 2, 1e-9)
    assert label == [1]
    np.testing.assert_allclose(merged[1][0], mean[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(merged[2][0], cov[0], rtol=0, atol=1e-12)


def test_far_components_stay() -> None:
    """Two clusters of three, 100 standard deviations apart, become two components of the heaviest labels."""
    mean = np.array([[0.0], [0.1], [0.2], [100.0], [100.1], [100.2]])
    weight = np.array([0.1, 0.2, 0.15, 0.15, 0.1, 0.3])
    (merged, label) = reduce((weight, mean, np.ones((6, 1, 1))), 6, 0.01)
    assert sorted(label) == [1, 5]
    np.testing.assert_allclose(np.sort(merged[0]), [0.45, 0.55], rtol=1e-12)


def test_order_does_not_matter() -> None:
    mixture = random_mixture(7, 20, 6)
    order = np.random.default_rng(8).permutation(20)
    found, label = sort(*reduce(mixture, 5, NEVER))
    shuffled, its_label = reduce(tuple(field[order] for field in mixture), 5, NEVER)  # type: ignore[arg-type]
    other, its_label = sort(shuffled, [int(order[k]) for k in its_label])
    assert label == its_label
    np.testing.assert_allclose(found[1], other[1], rtol=0, atol=1e-10)
