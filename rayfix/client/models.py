"""The service's answers as frozen dataclasses of numbers and tuples.

Field names and units are those of the JSON; docs/measurements.md and the service's ``/docs`` describe them. Unknown
keys, which later versions of the service may add, are ignored.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Status = Literal["ok", "ambiguous", "inconsistent", "insufficient"]
TrackState = Literal["started", "updated", "restarted", "predicted", "late"]
Matrix = tuple[tuple[float, float, float], ...]
"""Three rows of three numbers."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """A position in the scene frame, m, or a velocity, m / s."""

    x: float
    y: float
    z: float


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One possible position of the target."""

    probability: float
    position: Point
    covariance_m2: Matrix


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result for one measurement; ``reason``: why it was not used, ``source``: its path in another system's message."""

    index: int
    used: bool
    outlier_probability: float | None
    reason: str | None
    source: str | None = None


@dataclass(frozen=True, kw_only=True)
class SkippedMeasurement:
    """A measurement of another system's message that was not converted."""

    source: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class TrackAnswer:
    """A target's state, estimated from all its reports; see docs/tracking.md."""

    state: TrackState
    timestamp: str
    num_reports: int
    probability: float
    position: Point
    covariance_m2: Matrix
    velocity_m_s: Point
    velocity_covariance_m2_s2: Matrix
    horizontal_accuracy_m: float
    vertical_accuracy_m: float


@dataclass(frozen=True, kw_only=True)
class FixAnswer:
    """The answer to a report; ``track`` if the service tracks targets, ``skipped`` for messages of other systems."""

    status: Status
    target_id: str | None
    timestamp: str | None
    position: Point | None
    covariance_m2: Matrix | None
    horizontal_accuracy_m: float | None
    vertical_accuracy_m: float | None
    ellipsoid_semi_axes_m: Matrix | None
    confidence: float
    candidates: tuple[Candidate, ...]
    measurements: tuple[Outcome, ...]
    table_id: str
    compute_ms: float
    track: TrackAnswer | None
    simplified: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    skipped: tuple[SkippedMeasurement, ...] = ()


@dataclass(frozen=True, kw_only=True)
class FixEvent:
    """A fix of any client's report, with the report's JSON and the table's name."""

    table: str
    report: Mapping[str, Any]
    fix: FixAnswer


@dataclass(frozen=True, kw_only=True)
class StationAnswer:
    """A station; bearing, downtilt and slant are its orientation as in 3GPP TR 38.901.

    ``boresight_azimuth_deg`` and ``boresight_downtilt_deg`` are the direction of its array's boresight, ``mounting`` is
    its local frame.
    """

    id: str
    position: Point
    bearing_deg: float
    downtilt_deg: float
    slant_deg: float
    mounting: str
    boresight_azimuth_deg: float
    boresight_downtilt_deg: float
    field_of_view_deg: float


@dataclass(frozen=True, kw_only=True)
class TableAnswer:
    """A served table; ``name`` is the value for a client's ``table``."""

    name: str
    table_id: str
    format_version: int
    software_version: str
    site_name: str
    north_deg: float
    max_path_length_m: float
    origin_m: tuple[float, float, float]
    num_stations: int
    num_components: int


def fix_answer(document: Mapping[str, Any]) -> FixAnswer:
    """Read a fix; raises KeyError, TypeError or ValueError for other data."""
    track = document.get("track")
    return FixAnswer(
        status=document["status"],
        target_id=document["target_id"],
        timestamp=document["timestamp"],
        position=_optional_point(document["position"]),
        covariance_m2=_optional_matrix(document["covariance_m2"]),
        horizontal_accuracy_m=document["horizontal_accuracy_m"],
        vertical_accuracy_m=document["vertical_accuracy_m"],
        ellipsoid_semi_axes_m=_optional_matrix(document["ellipsoid_semi_axes_m"]),
        confidence=float(document["confidence"]),
        candidates=tuple(
            Candidate(
                probability=float(one["probability"]),
                position=_point(one["position"]),
                covariance_m2=_matrix(one["covariance_m2"]),
            )
            for one in document["candidates"]
        ),
        measurements=tuple(
            Outcome(
                index=int(one["index"]),
                used=bool(one["used"]),
                outlier_probability=one["outlier_probability"],
                reason=one.get("reason"),
                source=one.get("source"),
            )
            for one in document["measurements"]
        ),
        table_id=document["table_id"],
        compute_ms=float(document["compute_ms"]),
        track=None if track is None else _track(track),
        simplified=tuple(document.get("simplified", ())),
        warnings=tuple(document.get("warnings", ())),
        skipped=tuple(
            SkippedMeasurement(source=one["source"], reason=one["reason"]) for one in document.get("skipped", ())
        ),
    )


def fix_event(document: Mapping[str, Any]) -> FixEvent:
    """Read an event of the feed; raises KeyError, TypeError or ValueError for other data."""
    return FixEvent(table=document["table"], report=document["report"], fix=fix_answer(document["fix"]))


def station_answers(document: Mapping[str, Any]) -> tuple[StationAnswer, ...]:
    """Read the list of stations; raises KeyError, TypeError or ValueError for other data."""
    return tuple(
        StationAnswer(
            id=one["id"],
            position=_point(one["position"]),
            bearing_deg=one["orientation"]["bearing_deg"],
            downtilt_deg=one["orientation"]["downtilt_deg"],
            slant_deg=one["orientation"]["slant_deg"],
            mounting=one["mounting"],
            boresight_azimuth_deg=one["boresight"]["azimuth_deg"],
            boresight_downtilt_deg=one["boresight"]["downtilt_deg"],
            field_of_view_deg=one["field_of_view_deg"],
        )
        for one in document["stations"]
    )


def table_answer(document: Mapping[str, Any]) -> TableAnswer:
    """Read the summary of a table; raises KeyError, TypeError or ValueError for other data."""
    return TableAnswer(
        name=document["name"],
        table_id=document["table_id"],
        format_version=document["format_version"],
        software_version=document["software_version"],
        site_name=document["site"]["name"],
        north_deg=document["site"]["north_deg"],
        max_path_length_m=document["site"]["max_path_length_m"],
        origin_m=_triple(document["origin_m"]),
        num_stations=document["num_stations"],
        num_components=document["num_components"],
    )


def table_answers(document: Mapping[str, Any]) -> tuple[TableAnswer, ...]:
    """Read the list of tables; raises KeyError, TypeError or ValueError for other data."""
    return tuple(table_answer(one) for one in document["tables"])


def _track(document: Mapping[str, Any]) -> TrackAnswer:
    return TrackAnswer(
        state=document["state"],
        timestamp=document["timestamp"],
        num_reports=int(document["num_reports"]),
        probability=float(document["probability"]),
        position=_point(document["position"]),
        covariance_m2=_matrix(document["covariance_m2"]),
        velocity_m_s=_point(document["velocity_m_s"]),
        velocity_covariance_m2_s2=_matrix(document["velocity_covariance_m2_s2"]),
        horizontal_accuracy_m=float(document["horizontal_accuracy_m"]),
        vertical_accuracy_m=float(document["vertical_accuracy_m"]),
    )


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = values
    return (float(x), float(y), float(z))


def _point(document: Mapping[str, Any]) -> Point:
    return Point(x=float(document["x"]), y=float(document["y"]), z=float(document["z"]))


def _matrix(rows: Any) -> Matrix:
    matrix = tuple((float(a), float(b), float(c)) for a, b, c in rows)
    if len(matrix) != 3:
        raise ValueError("no three rows")
    return matrix


def _optional_point(document: Mapping[str, Any] | None) -> Point | None:
    return None if document is None else _point(document)


def _optional_matrix(rows: Any) -> Matrix | None:
    return None if rows is None else _matrix(rows)
