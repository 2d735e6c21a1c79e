"""From a fix to its JSON."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from rayfix_service.fusion.posterior.fix import Fix, Status
from rayfix_service.tracking.track import TrackedPosition
from rayfix_service.wire.points import Matrix, Point, point
from rayfix_service.wire.track import TrackDocument, track_to_document


class CandidateDocument(BaseModel):
    """One position that the target may have."""

    model_config = ConfigDict(title="Candidate")

    probability: float = Field(description="posterior probability that the target is there")
    position: Point
    covariance_m2: Matrix = Field(description="covariance of the position, m2, rows in the order x, y, z")


class OutcomeDocument(BaseModel):
    """Outcome of one measurement."""

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
    covariance_m2: Matrix | None = Field(description="covariance of that position, m2")
    horizontal_accuracy_m: float | None = Field(
        description="radius of the horizontal circle around the position that holds the target with probability "
        "`confidence`, wherever it is: where the position is less probable, the circle reaches to its rivals"
    )
    vertical_accuracy_m: float | None = Field(description="half the height of the layer that does, likewise")
    ellipsoid_semi_axes_m: Matrix | None = Field(
        description="an ellipsoid around the position that does, likewise: vectors x, y, z from its centre to the ends "
        "of its axes, longest first"
    )
    confidence: float = Field(
        description="probability that each of circle, layer and ellipsoid holds the target: that of the report, less "
        "where all measurements may be outliers"
    )
    candidates: list[CandidateDocument] = Field(description="the position and its rivals, most probable first")
    measurements: list[OutcomeDocument]
    simplified: list[str] = Field(
        default=[],
        description="what was worked out more coarsely than the report says, since the work for one report is bounded "
        "or because rounding made covariances singular; "
        "absent for nearly all reports",
    )
    warnings: list[str] = Field(
        default=[],
        description="of an inconsistent fix: which measurements contradict the others, and what may be wrong with the "
        "site; absent otherwise",
    )
    table_id: str
    compute_ms: float = Field(description="time the fix itself took, ms")
    track: TrackDocument | None = Field(
        default=None, description="the target as followed from report to report; absent unless that is asked for"
    )


def fix_to_document(fix: Fix, compute_seconds: float, track: TrackedPosition | None = None) -> dict[str, Any]:
    """Turn a fix into the JSON-compatible answer, which :class:`FixDocument` describes.

    The answer is built as plain dicts: going through the models would take longer than the fix itself.

    Parameters
    ----------
    fix : Fix
        The answer to one report.
    compute_seconds : float
        Time that the fix took, s.
    track : TrackedPosition, optional
        The target's track after the report.
    """
    candidates = [
        {
            "probability": float(candidate.probability),
            "position": point(candidate.position),
            "covariance_m2": candidate.covariance.tolist(),
        }
        for candidate in fix.candidates
    ]
    best = candidates[0] if candidates else {"position": None, "covariance_m2": None}
    regions, confidence = fix.regions, fix.confidence
    accuracies = None if regions is None else regions.accuracies(confidence)
    document = {
        "target_id": fix.target_id,
        "timestamp": fix.timestamp,
        "status": fix.status,
        "position": best["position"],
        "covariance_m2": best["covariance_m2"],
        "horizontal_accuracy_m": None if accuracies is None else accuracies.horizontal_radius,
        "vertical_accuracy_m": None if accuracies is None else accuracies.vertical_half_height,
        "ellipsoid_semi_axes_m": None if accuracies is None else accuracies.ellipsoid.semi_axes.tolist(),
        "confidence": confidence if regions is None else min(confidence, regions.share),
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
    if fix.simplified:
        document["simplified"] = list(fix.simplified)
    if fix.warnings:
        document["warnings"] = list(fix.warnings)
    if track is not None:
        document["track"] = track_to_document(track, confidence)
    return document
