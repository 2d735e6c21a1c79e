"""From a target's track to its JSON."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from rayfix_service.tracking.track import TrackedPosition, TrackState
from rayfix_service.wire.points import Matrix, Point, point


class TrackDocument(BaseModel):
    """What is known of a target from all its reports."""

    model_config = ConfigDict(title="Track")

    state: TrackState = Field(description="what the report did to the track")
    timestamp: str = Field(description="time that the track is of: that of the last report that it took in")
    num_reports: int = Field(description="reports since its start that constrained the position")
    probability: float = Field(description="probability that the target is there rather than elsewhere")
    position: Point
    covariance_m2: Matrix = Field(description="covariance of the position, m2, rows in the order x, y, z")
    velocity_m_s: Point = Field(description="velocity, m/s")
    velocity_covariance_m2_s2: Matrix = Field(description="covariance of the velocity, m2/s2")
    horizontal_accuracy_m: float = Field(
        description="radius of the horizontal circle around the position that holds the target with the report's "
        "`confidence`"
    )
    vertical_accuracy_m: float = Field(description="half the height of the layer that does")


def track_to_document(track: TrackedPosition, confidence: float) -> dict[str, Any]:
    """Turn a track into JSON-compatible data, which :class:`TrackDocument` describes."""
    found = track.estimate
    accuracies = track.regions.accuracies(confidence)
    return {
        "state": track.state,
        "timestamp": track.timestamp,
        "num_reports": track.num_reports,
        "probability": found.probability,
        "position": point(found.position),
        "covariance_m2": found.covariance.tolist(),
        "velocity_m_s": point(found.velocity),
        "velocity_covariance_m2_s2": found.velocity_covariance.tolist(),
        "horizontal_accuracy_m": accuracies.horizontal_radius,
        "vertical_accuracy_m": accuracies.vertical_half_height,
    }
