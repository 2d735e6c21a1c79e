"""Summarise the hypotheses of a report, in one compiled kernel: there are few of them, but many steps for each."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.posterior.cut_by_walls import cut_to_free_space
from rayfix_service.fusion.posterior.modes import find_modes
from rayfix_service.fusion.posterior.points import DrawnPoints, Points, draw_points
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.outliers import OutlierIndex, outlier_probabilities
from rayfix_service.fusion.stopping import NEVER, Stop
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.cholesky import log_sum
from rayfix_tables.gaussians.normal_points import normal_points, unit_points

_NUM_POINTS = 1024
"""Points that stand for the posterior in credible regions."""


class Summary(NamedTuple):
    """Summary of the hypotheses of a report.

    Attributes
    ----------
    log_evidence : float
        Natural logarithm of the probability density of the report.
    lost : float
        Posterior probability that all of it is outliers.
    probability : ndarray of shape (m,)
        Of the posterior's modes, the most probable first, were not all of it outliers.
    position : ndarray of shape (m, 3), m
    moment : ndarray of shape (m, 3, 3), m2
        Second moment of each mode about its position.
    outlier : ndarray of shape (count,)
        Posterior probability of each measurement of the index to be an outlier.
    half_bad : float
        Posterior probability that at least half of the observations are outliers altogether.
    points : Points
    """

    log_evidence: float
    lost: float
    probability: NDArray[np.float64]
    position: NDArray[np.float64]
    moment: NDArray[np.float64]
    outlier: NDArray[np.float64]
    half_bad: float
    points: Points


class ReportPosterior(Protocol):
    """The posterior of a report's position, whatever it is made of."""

    @property
    def log_all_outlier(self) -> float:
        """Log evidence of the case that all measurements are outliers."""

    def summary(self, index: OutlierIndex, free_space: FreeSpace, floor: float, stop: Stop = NEVER) -> Summary | None:
        """Sum it up, cut to the free space; None where nothing but outliers is left.

        Parameters
        ----------
        floor : float
            Hypotheses whose posterior probability is below this are left out of the modes.

        Raises
        ------
        FixStoppedError
            When ``stop`` was set.
        """

    def hypotheses(self) -> Hypotheses:
        """Return it as Gaussians, not yet cut to the free space."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianPosterior:
    """The posterior as a sum of Gaussians."""

    gaussians: Hypotheses

    @property
    def log_all_outlier(self) -> float:
        """Log evidence of the case that all measurements are outliers."""
        return self.gaussians.log_all_outlier

    def summary(self, index: OutlierIndex, free_space: FreeSpace, floor: float, stop: Stop = NEVER) -> Summary | None:
        """Sum it up, cut to the free space; None where nothing but outliers is left."""
        return sum_up(self.gaussians, index, free_space, floor, stop) if len(self.gaussians) else None

    def hypotheses(self) -> Hypotheses:
        """Return it as Gaussians, not yet cut to the free space."""
        return self.gaussians


def sum_up(
    hypotheses: Hypotheses, outlier_index: OutlierIndex, free_space: FreeSpace, floor: float, stop: Stop = NEVER
) -> Summary:
    """Summarise hypotheses, cut to the free space.

    Parameters
    ----------
    hypotheses : Hypotheses
        At least one. One whose covariance is not positive definite has no weight; where no other is, there are no
        modes and everything is outliers.
    floor : float
        Hypotheses whose posterior probability is below this are left out of the modes.
    stop : Stop
        Ends it early.

    Raises
    ------
    FixStoppedError
        When it was.
    """
    log_evidence, lost, modes, outlier, half_bad, drawn = _sum_up(
        (hypotheses.log_weight, hypotheses.mean, hypotheses.cov),
        hypotheses.outlier,
        hypotheses.log_all_outlier,
        (outlier_index.rows, len(outlier_index.places)),
        math.log(floor),
        (unit_points(), normal_points(_NUM_POINTS)),
        (free_space.origin, free_space.voxel_size, free_space.free),
        stop.cell,
    )
    stop.check()
    probability, position, moment = modes
    mean, root, owner = drawn
    points = DrawnPoints(mean=mean, root=root, owner=owner)
    return Summary(log_evidence, lost, probability, position, moment, outlier, half_bad, points)


@numba.njit(cache=True, nogil=True)
def _sum_up(
    gaussians: Any,
    outlier: Any,
    log_all_outlier: Any,
    index: Any,
    log_floor: Any,
    points: Any,
    space: Any,
    stop: Any,
) -> Any:
    """Give the entries of a :class:`Summary`.

    Parameters
    ----------
    gaussians : tuple
        ``log_weight``, ``mean`` and ``cov`` of the hypotheses. Plain tuples, since it takes numba 4 us to find out what
        a named one is.
    outlier : ndarray of int8, shape (h, n)
    log_all_outlier : float
    index : tuple
        ``rows`` of an :class:`OutlierIndex`, and the number of its measurements.
    log_floor : float
        Logarithm of the probability below which a hypothesis is left out of the modes.
    points : tuple of 2 ndarrays
        Points that stand for a standard normal: few for the cut, more for regions.
    space : tuple
        ``origin``, ``voxel_size`` and ``free`` of the free space.
    stop : ndarray of uint8, shape (1,)
    """
    log_weight, mean, cov = gaussians
    rows, count = index
    unit, normal = points
    origin, voxel_size, free = space
    log_cut, cut_mean, cut_cov = cut_to_free_space(log_weight, mean, cov, unit, origin, voxel_size, free)
    log_found = log_sum(log_cut)
    log_evidence = np.logaddexp(log_found, log_all_outlier)
    lost = np.exp(log_all_outlier - log_evidence)
    if log_found > -np.inf:
        log_cut -= log_found
    keep = np.flatnonzero(log_cut > log_floor)
    kept = log_cut[keep], cut_mean[keep], cut_cov[keep]
    probability, position, moment, _ = find_modes(*kept, origin, voxel_size, free, stop)
    weight = (1.0 - lost) * np.exp(log_cut)
    totals, half_bad = outlier_probabilities(outlier, weight, lost, rows, count)
    drawn = draw_points(log_weight, mean, cov, normal, origin, voxel_size, free)
    return log_evidence, lost, (probability, position, moment), totals, half_bad, drawn
