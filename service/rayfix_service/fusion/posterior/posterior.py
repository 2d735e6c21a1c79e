"""The whole posterior of a report: densities for pictures, samples for what comes after.

Where a fix sums the posterior up in candidates, this is the mixture of all hypotheses itself, cut to the free space:
zero outside of it, and there the sum of the hypotheses' Gaussians and, for the case that all measurements are outliers,
the prior. Only the free fraction of each Gaussian is approximated, by points.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import Prior
from rayfix_service.fusion.stopping import NEVER, Stop
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.constants import LOG_2PI
from rayfix_tables.gaussians.definite import cholesky_factors
from rayfix_tables.gaussians.normal_points import normal_points

_NUM_POINTS = 4096
"""Points that stand for a Gaussian: its free fraction is then known to half a per cent, a sum of many better."""

_CHUNK = 2**20
"""Numbers that are handled at a time."""

_HEIGHT_BINS = 4096
_HEIGHT_REACH = 8.0

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Posterior:
    """Probability density of the UE's position given a report.

    Attributes
    ----------
    log_weight : ndarray of shape (h,)
        Of the Gaussians; weighted with their free fractions and added to ``prior_share``, they sum to 1.
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
        Of the Gaussians before they are cut to the free space.
    prior_share : float
        Probability that the report does not constrain the position: all of it is outliers, or nothing can be used.
    prior : Prior
    free_space : FreeSpace
    log_evidence : float
        Natural logarithm of the probability density of the report, for comparing reports.
    """

    log_weight: Array
    mean: Array
    cov: Array
    prior_share: float
    prior: Prior
    free_space: FreeSpace
    log_evidence: float

    def moved(self, by: Array) -> "Posterior":
        """Return the same density elsewhere, moved by a vector of shape (3,), m."""
        if not by.any():
            return self
        return replace(
            self,
            mean=self.mean + by,
            prior=self.prior.raised(float(by[2])),
            free_space=self.free_space.moved(by),
        )

    def log_density(self, points: ArrayLike) -> Array:
        """Natural logarithm of the density at points.

        Parameters
        ----------
        points : array_like of shape (n, 3), m

        Returns
        -------
        ndarray of shape (n,)
            Of a density per m3; -inf outside the free space.
        """
        places = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        log_density = np.full(len(places), -np.inf)
        free = np.flatnonzero(self.free_space.contains(places))
        roots = np.linalg.inv(np.linalg.cholesky(self.cov))
        log_scale = self.log_weight + np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
        log_scale -= 1.5 * LOG_2PI
        step = max(1, _CHUNK // (3 * max(len(self.mean), 1)))
        for begin in range(0, len(free), step):
            chunk = free[begin : begin + step]
            apart = places[chunk, None, :] - self.mean
            white = np.einsum("hij,nhj->nhi", roots, apart)
            logs = log_scale - 0.5 * (white**2).sum(axis=2)
            log_density[chunk] = np.logaddexp.reduce(logs, axis=1, initial=-np.inf)
        if self.prior_share > 0.0:
            z = places[free, 2]
            log_prior = self.prior.eta * z - 0.5 * self.prior.precision * z**2 - self.prior.log_volume
            log_density[free] = np.logaddexp(log_density[free], np.log(self.prior_share) + log_prior)
        return log_density

    def sample(self, count: int, rng: np.random.Generator, *, stop: Stop = NEVER) -> Array:
        """Draw positions.

        Parameters
        ----------
        count : int
        rng : numpy.random.Generator
        stop : Stop
            Ends it early, from another thread; then this raises a ``FixStoppedError``.

        Returns
        -------
        ndarray of shape (count, 3), m
            In the free space.
        """
        from_prior = int(rng.binomial(count, self.prior_share))
        parts = [self._sample_prior(from_prior, rng), *self._sample_gaussians(count - from_prior, rng, stop)]
        return np.asarray(rng.permutation(np.concatenate(parts)))

    def _sample_gaussians(self, count: int, rng: np.random.Generator, stop: Stop) -> Iterator[Array]:
        """Draw from the Gaussians and keep what is free, which is exact whatever their free fractions are."""
        if count == 0:
            return
        # The free fractions add up to 1 - prior_share; this is the fraction of draws that will be free.
        weight = np.exp(self.log_weight)
        free_share = (1.0 - self.prior_share) / float(weight.sum())
        weight /= weight.sum()
        roots = np.linalg.cholesky(self.cov)
        while count > 0:
            stop.check()
            tries = min(int(1.2 * count / free_share) + 16, _CHUNK)
            pick = rng.choice(len(weight), tries, p=weight)
            drawn = self.mean[pick] + np.einsum("nij,nj->ni", roots[pick], rng.standard_normal((tries, 3)))
            kept = drawn[self.free_space.contains(drawn)][:count]
            count -= len(kept)
            yield kept

    def _sample_prior(self, count: int, rng: np.random.Generator) -> Array:
        """Draw voxels and positions in them, and heights from the Gaussian of a known height."""
        space = self.free_space
        if self.prior.precision == 0.0:
            voxels = np.argwhere(space.free)[rng.integers(np.count_nonzero(space.free), size=count)]
            return np.asarray(space.origin + space.voxel_size * (voxels + rng.random((count, 3))))
        middle, stdev = self.prior.eta / self.prior.precision, self.prior.precision**-0.5
        low = max(space.origin[2], middle - _HEIGHT_REACH * stdev)
        high = min(space.origin[2] + space.voxel_size * space.free.shape[2], middle + _HEIGHT_REACH * stdev)
        # No bin reaches from one layer of voxels into the next, where another part of the plane is free.
        layers = space.origin[2] + space.voxel_size * np.arange(space.free.shape[2] + 1)
        edges = np.unique(
            np.concatenate([np.linspace(low, high, _HEIGHT_BINS + 1), layers[(layers > low) & (layers < high)]])
        )
        centre, width = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
        layer = np.clip(((centre - space.origin[2]) / space.voxel_size).astype(np.int64), 0, space.free.shape[2] - 1)
        square = ((centre - middle) / stdev) ** 2
        weight = width * np.exp(-0.5 * (square - square.min())) * np.count_nonzero(space.free, axis=(0, 1))[layer]
        bins = rng.choice(len(weight), count, p=weight / weight.sum())
        places = np.empty((count, 3))
        places[:, 2] = edges[bins] + width[bins] * rng.random(count)
        for number in np.unique(layer[bins]):
            mine = np.flatnonzero(layer[bins] == number)
            columns = np.argwhere(space.free[:, :, number])
            chosen = columns[rng.integers(len(columns), size=len(mine))]
            places[mine, :2] = space.origin[:2] + space.voxel_size * (chosen + rng.random((len(mine), 2)))
        return places


def make_posterior(hypotheses: Hypotheses | None, prior: Prior, free_space: FreeSpace, stop: Stop = NEVER) -> Posterior:
    """Posterior of hypotheses, or the prior where there are none.

    Raises
    ------
    FixStoppedError
        When ``stop`` was set before it was done.
    """
    if hypotheses is None or not len(hypotheses):
        return Posterior(
            log_weight=np.empty(0),
            mean=np.empty((0, 3)),
            cov=np.empty((0, 3, 3)),
            prior_share=1.0,
            prior=prior,
            free_space=free_space,
            log_evidence=0.0 if hypotheses is None else hypotheses.log_all_outlier,
        )
    share = free_shares(hypotheses.mean, hypotheses.cov, free_space, stop)
    keep = share > 0.0
    log_weight = hypotheses.log_weight[keep]
    log_evidence = float(np.logaddexp.reduce([*(log_weight + np.log(share[keep])), hypotheses.log_all_outlier]))
    return Posterior(
        log_weight=log_weight - log_evidence,
        mean=hypotheses.mean[keep],
        cov=hypotheses.cov[keep],
        prior_share=min(1.0, float(np.exp(hypotheses.log_all_outlier - log_evidence))),
        prior=prior,
        free_space=free_space,
        log_evidence=log_evidence,
    )


def free_shares(mean: Array, cov: Array, free_space: FreeSpace, stop: Stop = NEVER) -> Array:
    """Fraction of each Gaussian that lies in the free space, shape (h,).

    Parameters
    ----------
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
        The fraction is 0 for a Gaussian whose covariance is not positive definite.
    stop : Stop
        Ends it early.

    Raises
    ------
    FixStoppedError
        When it was.
    """
    points = normal_points(_NUM_POINTS)
    roots, definite = cholesky_factors(cov)
    shares = np.zeros(len(mean))
    for h in np.flatnonzero(definite):
        stop.check()
        shares[h] = free_space.contains(mean[h] + points @ roots[h].T).mean()
    return shares
