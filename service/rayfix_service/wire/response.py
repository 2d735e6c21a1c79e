"""From a fix to its JSON."""

import math
from statistics import NormalDist
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from rayfix_service.fusion.report import Fix, Status

CONFIDENCE = 0.68
"""Probability that the accuracy figures of a fix hold."""

# Midpoints: the trapezoidal rule of a periodic function, kept away from g = 0 of a degenerate Gaussian.
_COS_TWO_PHI = np.cos((np.arange(256) + 0.5) * (np.pi / 256))


class Point(BaseModel):
    """A position in the scene frame, m."""

    x: float
    y: float
    z: float


_Matrix = Annotated[list[Annotated[list[float], Field(min_length=3, max_length=3)]], Field(min_length=3, max_length=3)]


class CandidateDocument(BaseModel):
    """One place where the target may be."""

    model_config = ConfigDict(title="Candidate")

    probability: float = Field(description="posterior probability that the target is there")
    position: Point
    covariance_m2: _Matrix = Field(description="covariance of the position, m2, rows in the order x, y, z")


class OutcomeDocument(BaseModel):
    """What became of one measurement."""

    model_config = ConfigDict(title="Outcome")

    index: int = Field(description="index of the measurement in the report")
    used: bool
    outlier_probability: float | None = Field(
        description="posterior probability that it has nothing to do with the position; null when not used"
    )
    reason: str | None = Field(default=None, description="why it was not used; absent when it was")


class FixDocument(BaseModel):
    """The answer to a report."""

    model_config = ConfigDict(title="Fix")

    target_id: str | None
    timestamp: str | None
    status: Status
    position: Point | None = Field(description="most probable position, null when no measurement could be used")
    covariance_m2: _Matrix | None = Field(description="covariance of that position, m2")
    horizontal_accuracy_m: float | None = Field(
        description="radius of the horizontal circle around the position that holds the target with "
        "probability `confidence`, given that this candidate is the right one"
    )
    vertical_accuracy_m: float | None = Field(description="half the height of the layer that does, likewise")
    confidence: float = Field(description="probability that each of the two accuracies holds")
    candidates: list[CandidateDocument] = Field(description="the position and its rivals, most probable first")
    measurements: list[OutcomeDocument]
    table_id: str
    compute_ms: float = Field(description="time the fix itself took, ms")


def horizontal_accuracy(covariance: NDArray[np.float64], confidence: float = CONFIDENCE) -> float:
    """Radius of the circle around the mean that holds `confidence` of a Gaussian's horizontal marginal.

    In polar coordinates of the whitened plane the probability outside radius r is the mean over the angle phi
    of exp(-r^2 / (2 g)), g = l1 cos^2 phi + l2 sin^2 phi with the eigenvalues l1 >= l2. Newton's method
    solves it for r^2; the result is exact to about 1e-9 of the radius.

    Parameters
    ----------
    covariance : ndarray of shape (3, 3), m2
        Covariance of the position; only its upper left 2 x 2 block counts.
    confidence : float
        Probability inside the circle, between 0 and 1.

    Returns
    -------
    float
        The radius, m.
    """
    (xx, xy), (_, yy) = covariance[:2, :2].tolist()
    mean, half_gap = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    largest = mean + half_gap
    if largest <= 0.0:
        return 0.0
    ratio = max(0.0, (mean - half_gap) / largest)
    spread = 2 * ((1 + ratio) / 2 + (1 - ratio) / 2 * _COS_TWO_PHI)  # 2 g, where l1 is 1
    # The function of r^2 is convex and falls, so that Newton's steps from below never overshoot.
    squared = NormalDist().inv_cdf((1 + confidence) / 2) ** 2
    for _ in range(50):
        outside = np.exp(-squared / spread)
        step = float((outside.mean() - (1 - confidence)) / (outside / spread).mean())
        squared += step
        if step <= 1e-12 * squared:
            break
    return math.sqrt(largest * squared)


def vertical_accuracy(covariance: NDArray[np.float64], confidence: float = CONFIDENCE) -> float:
    """Half-width, m, of the interval around the mean that holds `confidence` of the vertical marginal."""
    return NormalDist().inv_cdf((1 + confidence) / 2) * math.sqrt(max(0.0, float(covariance[2, 2])))


def fix_to_document(fix: Fix, compute_seconds: float) -> dict[str, Any]:
    """Turn a fix into the JSON-compatible answer, which :class:`FixDocument` describes.

    The answer is built as plain dicts: going through the models would take longer than the fix itself.

    Parameters
    ----------
    fix : Fix
        The answer to one report.
    compute_seconds : float
        Time that the fix took, s.
    """
    candidates = [
        {
            "probability": float(candidate.probability),
            "position": _point(candidate.position),
            "covariance_m2": candidate.covariance.tolist(),
        }
        for candidate in fix.candidates
    ]
    best = candidates[0] if candidates else {"position": None, "covariance_m2": None}
    covariance = fix.covariance
    return {
        "target_id": fix.target_id,
        "timestamp": fix.timestamp,
        "status": fix.status,
        "position": best["position"],
        "covariance_m2": best["covariance_m2"],
        "horizontal_accuracy_m": None if covariance is None else horizontal_accuracy(covariance),
        "vertical_accuracy_m": None if covariance is None else vertical_accuracy(covariance),
        "confidence": CONFIDENCE,
        "candidates": candidates,
        "measurements": [
            {"index": index, "used": True, "outlier_probability": outcome.outlier_probability}
            if outcome.used
            else {"index": index, "used": False, "outlier_probability": None, "reason": outcome.reason}
            for index, outcome in enumerate(fix.outcomes)
        ],
        "table_id": fix.table_id,
        "compute_ms": round(compute_seconds * 1e3, 3),
    }


def _point(position: NDArray[np.float64]) -> dict[str, float]:
    """Position as the wire has it, m."""
    x, y, z = position.tolist()
    return {"x": x, "y": y, "z": z}
