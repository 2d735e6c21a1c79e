"""The state of a target's track after a report."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rayfix_service.fusion.posterior.credible import CredibleRegions

TrackState = Literal["started", "updated", "restarted", "predicted", "late"]
"""What a report did to its target's track; docs/tracking.md defines each."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Where a target is and how it moves.

    Attributes
    ----------
    probability : float
        That the target is at this position rather than at another one.
    position : ndarray of shape (3,), m
    covariance : ndarray of shape (3, 3), m2
    velocity : ndarray of shape (3,), m / s
    velocity_covariance : ndarray of shape (3, 3), m2 / s2
    """

    probability: float
    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    velocity: NDArray[np.float64]
    velocity_covariance: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class TrackedPosition:
    """A target's track after a report.

    Attributes
    ----------
    state : {"started", "updated", "restarted", "predicted", "late"}
    timestamp : str
        Time that the track is of: that of the last report that it was updated or predicted with.
    num_reports : int
        Reports since the track's start that constrained the position.
    estimate : Estimate
    regions : CredibleRegions
        Regions around the estimate's position that hold the target with any probability.
    """

    state: TrackState
    timestamp: str
    num_reports: int
    estimate: Estimate
    regions: "CredibleRegions"

    def moved(self, by: NDArray[np.float64]) -> "TrackedPosition":
        """Return the same track elsewhere, moved by a vector of shape (3,), m."""
        if not by.any():
            return self
        moved = replace(self.estimate, position=self.estimate.position + by)
        return replace(self, estimate=moved, regions=self.regions.moved(by))
