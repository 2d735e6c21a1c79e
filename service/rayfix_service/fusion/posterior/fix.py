"""What comes out of a fix, in SI units.

The JSON of the HTTP interface is written by :mod:`rayfix_service.wire`.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.report import CONFIDENCE

if TYPE_CHECKING:
    from rayfix_service.fusion.posterior.credible import CredibleRegions


Status = Literal["ok", "ambiguous", "inconsistent", "insufficient"]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One position that the UE may have.

    Attributes
    ----------
    probability : float
        Posterior probability that the UE is there.
    position : ndarray of shape (3,), m
        Mean of the posterior over one of its modes.
    covariance : ndarray of shape (3, 3), m2
        Second moment of the posterior about ``position``.
    """

    probability: float
    position: NDArray[np.float64]
    covariance: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of one measurement of the report.

    Attributes
    ----------
    used : bool
        False for a measurement that could not contribute; ``reason`` then gives the cause.
    outlier_probability : float or None
        Posterior probability that this measurement has nothing to do with the position; None when not used.
    """

    used: bool
    outlier_probability: float | None = None
    reason: str | None = None


@dataclass(frozen=True, kw_only=True)
class Fix:
    """The answer to a report.

    Attributes
    ----------
    status : {"ok", "ambiguous", "inconsistent", "insufficient"}
        Whether the position can be trusted; docs/how-it-works.md defines each.
    candidates : tuple of Candidate
        Most probable first; empty when no measurement could be used or all contradict the table.
    outcomes : tuple of Outcome
        One per measurement of the report, in its order.
    log_evidence : float
        Natural logarithm of the probability density of the report, for comparing reports.
    regions : CredibleRegions or None
        Regions around the position that hold the UE with any probability; None where there is no position.
    confidence : float
        Probability that the report wants regions of.
    simplified : tuple of str
        What was worked out more coarsely than the report says, since the work per report is bounded or because
        rounding made covariances singular; mostly empty.
    warnings : tuple of str
        Of an inconsistent fix: which measurements contradict the others, and which turn of stations would make them
        agree.
    """

    status: Status
    candidates: tuple[Candidate, ...]
    outcomes: tuple[Outcome, ...]
    log_evidence: float
    table_id: str
    regions: "CredibleRegions | None" = None
    confidence: float = CONFIDENCE
    simplified: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    target_id: str | None = None
    timestamp: str | None = None

    def moved(self, by: NDArray[np.float64]) -> "Fix":
        """Return the same fix elsewhere, moved by a vector of shape (3,), m."""
        if not by.any():
            return self
        candidates = tuple(replace(each, position=each.position + by) for each in self.candidates)
        return replace(self, candidates=candidates, regions=self.regions and self.regions.moved(by))

    @property
    def position(self) -> NDArray[np.float64] | None:
        """Position of the most probable candidate, shape (3,), m."""
        return self.candidates[0].position if self.candidates else None

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Covariance of the most probable candidate, shape (3, 3), m2."""
        return self.candidates[0].covariance if self.candidates else None
