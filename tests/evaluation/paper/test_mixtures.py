"""Mixtures of the paper's method against sums over a grid."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_evaluation.paper.mixtures import (
    Mixture,
    arg_max,
    condition_on_last,
    fit_mixture,
    multiply,
    where_all_meet,
)

Array = NDArray[np.float64]


def random_mixture(seed: int, dimension: int, count: int = 3) -> Mixture:
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(count, dimension, dimension)) * 0.3
    cov = roots @ roots.transpose(0, 2, 1) + 0.2 * np.eye(dimension)
    return Mixture(log_weight=np.log(rng.uniform(0.2, 1.0, count)), mean=rng.normal(size=(count, dimension)), cov=cov)


def grid(half: float = 5.0, step: float = 0.25) -> tuple[Array, float]:
    axis = np.arange(-half, half, step)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3), step**3


def assert_matches(mixture: Mixture, log_density: Array, points: Array, cell: float) -> None:
    """Compare total mass, mean and covariance with those of densities at the points of a grid."""
    density = np.exp(log_density) * cell
    mean = density @ points / density.sum()
    cov = (points - mean).T @ ((points - mean) * density[:, None]) / density.sum()
    found_mean, found_cov = mixture.moments()
    assert np.exp(mixture.log_weight).sum() == pytest.approx(density.sum(), rel=1e-3)
    np.testing.assert_allclose(found_mean, mean, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found_cov, cov, rtol=0, atol=2e-3)


def test_product_is_the_product_of_the_densities() -> None:
    factors = [random_mixture(seed, 3) for seed in (1, 2, 3)]
    points, cell = grid()
    product = multiply(factors, most=1000)
    assert len(product) == 27
    assert_matches(product, np.sum([f.log_density(points) for f in factors], axis=0), points, cell)


def test_the_heaviest_products_are_kept() -> None:
    factors = [random_mixture(seed, 3) for seed in (1, 2)]
    everything, few = multiply(factors, most=1000), multiply(factors, most=4)
    best = np.argsort(-everything.log_weight)[:4]
    np.testing.assert_allclose(few.mean, everything.mean[best], rtol=0, atol=1e-12)


def test_conditioning_slices_the_joint_density() -> None:
    joint = random_mixture(4, 4)
    points, cell = grid()
    # Of a measurement 0.7 with variance 0.3: the integral over the last coordinate.
    last = np.arange(-2.5, 4.0, 0.2)
    likelihood = np.exp(-0.5 * (last - 0.7) ** 2 / 0.3) / np.sqrt(2.0 * np.pi * 0.3)
    density = np.zeros(len(points))
    for value, weight in zip(last, likelihood, strict=True):
        there = np.column_stack([points, np.full(len(points), value)])
        density += 0.2 * weight * np.exp(joint.log_density(there))
    with np.errstate(divide="ignore"):
        assert_matches(condition_on_last(joint, 0.7, 0.3), np.log(density), points, cell)


def test_meeting_is_the_joint_density_on_the_diagonal() -> None:
    joint = random_mixture(5, 6)
    points, cell = grid()
    assert_matches(where_all_meet(joint), joint.log_density(np.tile(points, 2)), points, cell)


def test_of_independent_positions_meeting_is_the_product() -> None:
    one, other = random_mixture(6, 3, count=1), random_mixture(7, 3, count=1)
    cov = np.zeros((1, 6, 6))
    cov[:, :3, :3], cov[:, 3:, 3:] = one.cov, other.cov
    joint = Mixture(
        log_weight=one.log_weight + other.log_weight, mean=np.concatenate([one.mean, other.mean], axis=1), cov=cov
    )
    met, product = where_all_meet(joint), multiply([one, other], most=1)
    np.testing.assert_allclose(met.log_weight, product.log_weight, rtol=0, atol=1e-12)
    np.testing.assert_allclose(met.mean, product.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(met.cov, product.cov, rtol=0, atol=1e-12)


def test_the_fit_finds_the_mixture_that_samples_come_from() -> None:
    rng = np.random.default_rng(8)
    means = np.array([[0.0, 0.0, 0.0], [4.0, 1.0, 2.0]])
    which = (rng.random(20_000) < 0.3).astype(int)
    samples = means[which] + rng.normal(size=(20_000, 3)) * [0.5, 0.3, 0.2]
    fitted = fit_mixture(samples, 2, seed=1)
    order = np.argsort(fitted.mean[:, 0])
    np.testing.assert_allclose(fitted.mean[order], means, rtol=0, atol=0.03)
    np.testing.assert_allclose(np.exp(fitted.log_weight[order]), [0.7, 0.3], rtol=0, atol=0.015)
    for cov in fitted.cov:
        np.testing.assert_allclose(cov, np.diag([0.25, 0.09, 0.04]), rtol=0, atol=0.02)


def test_few_samples_get_few_components() -> None:
    samples = np.random.default_rng(9).normal(size=(35, 3))
    assert len(fit_mixture(samples, 10, seed=1)) == 3
    assert len(fit_mixture(samples[:4], 10, seed=1)) == 1


def test_arg_max_is_the_best_candidate_under_the_product() -> None:
    factors = [random_mixture(seed, 3) for seed in (1, 2)]
    candidates = np.random.default_rng(1).normal(size=(50, 3))
    density = [sum(float(f.log_density(c[None])[0]) for f in factors) for c in candidates]
    np.testing.assert_array_equal(arg_max(factors, candidates), candidates[int(np.argmax(density))])
