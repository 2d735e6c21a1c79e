"""Gaussian mixtures fitted to points, their product, and its maximum."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture
from threadpoolctl import threadpool_limits

_POINTS_PER_COMPONENT = 10
"""Smallest number of points per component."""

_FLOOR = 0.02
"""Standard deviation that is added to every component along each axis, m."""

_MAX_ITERATIONS = 200


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """A Gaussian mixture.

    Attributes
    ----------
    log_weight : ndarray of shape (k,)
        Natural logarithms; need not sum to 1.
    mean : ndarray of shape (k, d), m
    cov : ndarray of shape (k, d, d), m2
    """

    log_weight: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of components."""
        return len(self.log_weight)

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density at points of shape (n, d), shape (n,)."""
        logs = self.log_weight + _log_normal(points[:, None, :] - self.mean, self.cov)
        top = logs.max(axis=1)
        return np.asarray(top + np.log(np.exp(logs - top[:, None]).sum(axis=1)))

    def moments(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean, shape (d,), and covariance, shape (d, d), of the whole mixture."""
        share = np.exp(self.log_weight - self.log_weight.max())
        share /= share.sum()
        mean = share @ self.mean
        apart = self.mean - mean
        cov = np.einsum("k,kij->ij", share, self.cov + apart[:, :, None] * apart[:, None, :])
        return mean, cov


def fit_mixture(samples: NDArray[np.float64], num_components: int, seed: int) -> Mixture:
    """Fit a mixture by expectation-maximisation (scikit-learn, full covariances, started by k-means).

    Parameters
    ----------
    samples : ndarray of shape (n, d), m
        At least two.
    num_components : int
        Fewer are fitted if there are fewer than ten samples for each.
    """
    num_components = max(1, min(num_components, len(samples) // _POINTS_PER_COMPONENT))
    model = GaussianMixture(num_components, reg_covar=_FLOOR**2, max_iter=_MAX_ITERATIONS, random_state=seed)
    with threadpool_limits(limits=1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model.fit(samples)
    return Mixture(
        log_weight=np.log(np.maximum(model.weights_, 1e-300)),
        mean=np.asarray(model.means_),
        cov=np.asarray(model.covariances_),
    )


def condition_on_last(mixture: Mixture, value: float, variance: float) -> Mixture:
    """Condition a mixture on a measurement of its last coordinate, and remove that coordinate.

    Parameters
    ----------
    mixture : Mixture
        Over (x, y, z, path length).
    value, variance : float, m and m2
    """
    across, own = mixture.cov[:, :-1, -1], mixture.cov[:, -1, -1] + variance
    apart = value - mixture.mean[:, -1]
    gain = across / own[:, None]
    return Mixture(
        log_weight=mixture.log_weight - 0.5 * (apart**2 / own + np.log(2.0 * np.pi * own)),
        mean=mixture.mean[:, :-1] + gain * apart[:, None],
        cov=mixture.cov[:, :-1, :-1] - gain[:, :, None] * across[:, None, :],
    )


def where_all_meet(mixture: Mixture) -> Mixture:
    """Condition a mixture over several positions (x1, x2, ...) on their equality, x1 = x2 = ... = x.

    Parameters
    ----------
    mixture : Mixture
        Its dimension is 3 times the number of positions.
    """
    dimension = mixture.mean.shape[1]
    same = np.tile(np.eye(3), (dimension // 3, 1))
    precision = np.linalg.inv(mixture.cov)
    information = same.T @ precision @ same
    eta = np.einsum("ji,kjl,kl->ki", same, precision, mixture.mean)
    cov = np.asarray(np.linalg.inv(information), np.float64)
    mean = np.einsum("kij,kj->ki", cov, eta)
    # The maximum of N(same x; mean, cov) over x, times the volume of a Gaussian of that width.
    height = _log_normal(mean @ same.T - mixture.mean, mixture.cov)
    log_volume = 0.5 * np.linalg.slogdet(2.0 * np.pi * cov)[1]
    return Mixture(log_weight=mixture.log_weight + height + log_volume, mean=mean, cov=cov)


def multiply(mixtures: Sequence[Mixture], most: int) -> Mixture:
    """Multiply mixtures: all combinations of one component of each.

    Parameters
    ----------
    mixtures : sequence of Mixture
        At least one.
    most : int
        Number of combinations that are kept after each factor, those with the largest weights.
    """
    product = mixtures[0]
    for factor in mixtures[1:]:
        one, other = (n.ravel() for n in np.indices((len(product), len(factor))))
        total = product.cov[one] + factor.cov[other]
        apart = factor.mean[other] - product.mean[one]
        log_weight = product.log_weight[one] + factor.log_weight[other] + _log_normal(apart, total)
        keep = np.argsort(-log_weight, kind="stable")[:most]
        gain = product.cov[one[keep]] @ np.linalg.inv(total[keep])
        product = Mixture(
            log_weight=log_weight[keep],
            mean=product.mean[one[keep]] + np.einsum("kij,kj->ki", gain, apart[keep]),
            cov=gain @ factor.cov[other[keep]],
        )
    return product


def arg_max(mixtures: Sequence[Mixture], candidates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Candidate, of shape (3,), m, at which the product of mixtures is largest.

    Parameters
    ----------
    candidates : ndarray of shape (n, 3), m
    """
    log_density = np.sum([mixture.log_density(candidates) for mixture in mixtures], axis=0)
    return np.asarray(candidates[int(np.argmax(log_density))])


def _log_normal(apart: NDArray[np.float64], cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log density of N(0, cov) at vectors; ``apart`` of shape (..., k, d), ``cov`` of shape (k, d, d)."""
    precision = np.linalg.inv(cov)
    square = np.einsum("...ki,kij,...kj->...k", apart, precision, apart)
    return np.asarray(-0.5 * (square + np.linalg.slogdet(2.0 * np.pi * cov)[1]))
