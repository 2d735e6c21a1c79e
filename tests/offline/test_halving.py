"""Merging by halves keeps what a mixture is as a whole, and each merge costs what it says."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_offline.halving import halve_and_merge


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """Gaussians over six dimensions."""

    weight: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]
    label: NDArray[np.int8]

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
        label=rng.integers(0, 4, count).astype(np.int8),
    )


def merged(mixture: Mixture, max_divergence: float, noise: float = 0.0) -> Mixture:
    weight, mean, cov, label = (np.array(v) for v in (mixture.weight, mixture.mean, mixture.cov, mixture.label))
    alive = np.empty(len(weight), np.bool_)
    halve_and_merge(weight, mean, cov, label, np.ones(6), np.full(6, noise), max_divergence, alive)
    return Mixture(weight=weight[alive], mean=mean[alive], cov=cov[alive], label=label[alive])


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
        label=np.repeat(one.label, 33),
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


def test_the_heavier_label_stays() -> None:
    mixture = drawn(2, np.random.default_rng(5))
    weighted = Mixture(weight=np.array([0.4, 0.6]), mean=mixture.mean, cov=mixture.cov, label=np.array([3, 1], np.int8))
    assert merged(weighted, np.inf).label.tolist() == [1]


def test_noise_merges_what_it_hides() -> None:
    """Two rows of components 0.1 apart in an angle; noise of 1 hides that and not the other 5."""
    place = np.zeros((40, 6))
    place[:, 1] = 0.1 * (np.arange(40) % 20)
    place[20:, 2] = 5.0
    mixture = Mixture(
        weight=np.full(40, 1 / 40),
        mean=place,
        cov=np.repeat(1e-4 * np.eye(6)[None], 40, axis=0),
        label=np.zeros(40, np.int8),
    )
    assert len(merged(mixture, 1e-2).weight) == 40
    hidden = merged(mixture, 1e-2, noise=1.0)
    assert 2 <= len(hidden.weight) <= 6
    assert set(np.round(hidden.mean[:, 2], 9)) == {0.0, 5.0}
