"""Calibration of the stated uncertainty: how often ellipsoids contain the truth, and kinds of failures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from rayfix_evaluation.drops.accuracy import LocatedDrop
from rayfix_service.fusion.posterior.fix import Candidate, Fix

GROSS_BOUNDS, GROSS_ERROR = 5.0, 1.0
"""A fix is a gross failure if its error exceeds this many bounds and this many metres."""

OPEN_BOUND = 10.0
"""Above this bound, m, the measurements do not determine a position, and errors are not compared."""

_RIVAL_PROBABILITY = 0.99


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Figures of located drops.

    Attributes
    ----------
    count : int
        Fixes with a position.
    covered : mapping of float to int
        Fixes with the truth in the credible ellipsoid of that probability.
    gross : int
        Gross failures.
    rival_right : int
        Gross failures where the truth lies in the 99 % ellipsoid of a listed rival.
    rms_ratio : float
        RMS error over RMS bound, of the fixes that are within five bounds and have a bound below 10 m.
    """

    count: int
    covered: Mapping[float, int]
    gross: int
    rival_right: int
    rms_ratio: float


def ellipsoid_holds(fix: Fix, probability: float, point: NDArray[np.float64]) -> bool:
    """Whether a fix's credible ellipsoid contains a point of shape (3,), m; False if the fix has no position."""
    return fix.regions is not None and fix.regions.ellipsoid(probability).holds(point)


def calibrate(located: Sequence[LocatedDrop], probabilities: Sequence[float]) -> Calibration:
    """Compare the stated uncertainty of fixes with their errors.

    Parameters
    ----------
    located : sequence of LocatedDrop
    probabilities : sequence of float
        Probabilities of the ellipsoids, between 0 and 1.
    """
    fixed = [item for item in located if item.fix.candidates]
    truth = [item.drop.position for item in fixed]
    error = np.array([item.error for item in fixed])
    bound = np.array([item.bound for item in fixed])
    failed = (error > GROSS_BOUNDS * bound) & (error > GROSS_ERROR)
    fair = (bound < OPEN_BOUND) & (error < GROSS_BOUNDS * bound)
    covered = {
        p: sum(ellipsoid_holds(item.fix, p, x) for item, x in zip(fixed, truth, strict=True)) for p in probabilities
    }
    rival_right = sum(
        any(_within(rival, _RIVAL_PROBABILITY, truth[n]) for rival in fixed[n].fix.candidates[1:])
        for n in np.flatnonzero(failed)
    )
    ratio = float(np.sqrt(np.mean(error[fair] ** 2) / np.mean(bound[fair] ** 2))) if fair.any() else float("inf")
    return Calibration(
        count=len(fixed),
        covered=covered,
        gross=int(failed.sum()),
        rival_right=rival_right,
        rms_ratio=ratio,
    )


def wilson_interval(hits: int, total: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of a binomial proportion (Wilson's score interval); (0, 1) if ``total`` is 0.

    Parameters
    ----------
    hits, total : int
    confidence : float
        Probability that the interval contains the proportion.
    """
    if total == 0:
        return 0.0, 1.0
    z = float(norm.ppf(0.5 + 0.5 * confidence))
    share = hits / total
    middle = share + 0.5 * z**2 / total
    half = z * float(np.sqrt(share * (1.0 - share) / total + 0.25 * (z / total) ** 2))
    scale = 1.0 + z**2 / total
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def _within(candidate: Candidate, probability: float, point: NDArray[np.float64]) -> bool:
    """Whether a point lies in the ellipsoid that contains a Gaussian candidate with a probability."""
    apart = point - candidate.position
    return bool(apart @ np.linalg.solve(candidate.covariance, apart) <= chi2.ppf(probability, 3))
