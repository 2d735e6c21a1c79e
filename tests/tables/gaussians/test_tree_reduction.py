"""Merging by halves keeps what a mixture is as a whole, and each merge costs what it says."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_tables.gaussians.tree_reduction import halve_and_merge


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """Gaussians over six dimensions."""

    weight: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]
    group: NDArray[np.int64]

    def moments(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean and covariance of the whole."""
        mean = self.weight @ self.mean
        apart = self.mean - mean
        cov = np.einsum("k,kij->ij", self.weight, self.cov + apart[:, :, None] * apart[:, None, :])
        return mean, cov


def drawn(count: int, rng: np.random.Generator) -> Mixture:
    root = rng.normal(size=(count, 6, 6)) * 0.3
    weight = rng.random(count) + 0.1
    return Mixture(
        weight=weight / weight.sum(),
        mean=rng.normal(size=(count, 6)),
        cov=root @ root.transpose(0, 2, 1) + 0.01 * np.eye(6),
        group=np.zeros(count, np.int64),
    )


def merged(mixture: Mixture, max_divergence: float, noise: float = 0.0) -> Mixture:
    weight, mean, cov = (np.array(v) for v in (mixture.weight, mixture.mean, mixture.cov))
    into = halve_and_merge(weight, mean, cov, mixture.group, np.ones(6), np.full(6, noise), max_divergence)
    alive = into == np.arange(len(weight))
    np.testing.assert_allclose(np.bincount(into, mixture.weight, len(weight))[alive], weight[alive], rtol=1e-12)
    return Mixture(weight=weight[alive], mean=mean[alive], cov=cov[alive], group=mixture.group[alive])


@pytest.mark.parametrize("max_divergence", [1e-3, 1e-2, 0.1, np.inf])
def test_the_moments_of_the_whole_stay(max_divergence: float) -> None:
    mixture = drawn(200, np.random.default_rng(1))
    fewer = merged(mixture, max_divergence)
    assert fewer.weight.sum() == pytest.approx(1.0, rel=1e-12)
    for ours, theirs in zip(fewer.moments(), mixture.moments(), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12)


def test_any_divergence_leaves_one_component() -> None:
    mixture = drawn(57, np.random.default_rng(2))
    assert len(merged(mixture, np.inf).weight) == 1


def test_components_all_alike_become_one_for_nothing() -> None:
    one = drawn(1, np.random.default_rng(3))
    many = Mixture(
        weight=np.full(33, 1 / 33),
        mean=np.repeat(one.mean, 33, axis=0),
        cov=np.repeat(one.cov, 33, axis=0),
        group=np.repeat(one.group, 33),
    )
    fewer = merged(many, 1e-9)
    assert len(fewer.weight) == 1
    np.testing.assert_allclose(fewer.cov, one.cov, rtol=1e-12)


def test_two_components_merge_at_their_bound() -> None:
    """Runnalls' bound of two, worked out with NumPy's determinants, noise on top."""
    mixture = drawn(2, np.random.default_rng(4))
    noise = 0.2
    _, union = mixture.moments()
    log_dets = [np.linalg.slogdet(cov + noise * np.eye(6))[1] for cov in (*mixture.cov, union)]
    bound = 0.5 * (log_dets[2] - mixture.weight @ log_dets[:2])
    assert bound > 0.01
    assert len(merged(mixture, bound * (1.0 - 1e-9), noise).weight) == 2
    assert len(merged(mixture, bound * (1.0 + 1e-9), noise).weight) == 1


def test_groups_stay_apart() -> None:
    mixture = drawn(100, np.random.default_rng(5))
    grouped = Mixture(weight=mixture.weight, mean=mixture.mean, cov=mixture.cov, group=np.arange(100) % 3)
    fewer = merged(grouped, np.inf)
    for group in range(3):
        ours, theirs = fewer.group == group, grouped.group == group
        assert fewer.weight[ours].sum() == pytest.approx(grouped.weight[theirs].sum(), rel=1e-12)
        assert np.count_nonzero(ours) < np.count_nonzero(theirs)


def test_noise_merges_what_it_hides() -> None:
    """Two rows of components 0.1 apart in an angle; noise of 1 hides that and not the other 5."""
    place = np.zeros((40, 6))
    place[:, 1] = 0.1 * (np.arange(40) % 20)
    place[20:, 2] = 5.0
    mixture = Mixture(
        weight=np.full(40, 1 / 40),
        mean=place,
        cov=np.repeat(1e-4 * np.eye(6)[None], 40, axis=0),
        group=np.zeros(40, np.int64),
    )
    assert len(merged(mixture, 1e-2).weight) == 40
    hidden = merged(mixture, 1e-2, noise=1.0)
    assert 2 <= len(hidden.weight) <= 6
    assert set(np.round(hidden.mean[:, 2], 9)) == {0.0, 5.0}
