"""The common part of the OpenAPI document for routes of positions."""

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel, Field

from rayfix_service.http.openapi.examples import (
    ADAPTED_FIX_EXAMPLE,
    FIX_EXAMPLE,
    LOCAL_3D_EXAMPLE,
    OMLOX_EXAMPLE,
    PROBLEM_EXAMPLE,
)
from rayfix_service.http.problems import (
    BODY_TOO_LARGE,
    FIX_TIMEOUT,
    INVALID_REPORT,
    MALFORMED_JSON,
    MEDIA_TYPE,
    NOT_FOUND,
    NOT_READY,
    UNSUPPORTED_MEDIA_TYPE,
    problem_responses,
)
from rayfix_service.wire import FixDocument, Point, ReportDocument
from rayfix_service.wire.response import OutcomeDocument


class AdaptedOutcome(OutcomeDocument):
    """What became of one measurement, and where it stands in the message."""

    source: str = Field(description="path of the measurement in the message")


class SkippedDocument(BaseModel):
    """A measurement of the message that a fix cannot use."""

    source: str = Field(description="path of the measurement in the message")
    reason: str


class AdaptedFixDocument(FixDocument):
    """The answer to a message of another format."""

    measurements: list[AdaptedOutcome]  # type: ignore[assignment]
    skipped: list[SkippedDocument]
    report: ReportDocument | None = Field(
        default=None,
        description="the report that the message was turned into; only with the query parameter with_report",
    )


class LocalOrigin(BaseModel):
    """Origin and orientation of the scene frame."""

    coordinateId: str = Field(description="name of the site")  # noqa: N815
    horizAxesOrientation: int = Field(description="bearing of +y, clockwise from north, 0.1 deg")  # noqa: N815


class UncertaintyEllipsoid(BaseModel):
    """An upright ellipsoid about the point."""

    semiMajor: float = Field(description="larger horizontal semi-axis, m")  # noqa: N815
    semiMinor: float = Field(description="smaller horizontal semi-axis, m")  # noqa: N815
    vertical: float = Field(description="vertical semi-axis, m")
    orientationMajor: int = Field(description="bearing of the major axis, clockwise from north, deg")  # noqa: N815


class Local3dPointUncertaintyEllipsoid(BaseModel):
    """A position as in 3GPP TS 29.572."""

    shape: Literal["LOCAL_3D_POINT_UNCERTAINTY_ELLIPSOID"]
    localOrigin: LocalOrigin  # noqa: N815
    point: Point
    uncertaintyEllipsoid: UncertaintyEllipsoid  # noqa: N815
    confidence: int = Field(description="probability that the target is within the ellipsoid, percent")


class OmloxPoint(BaseModel):
    """A GeoJSON point in the scene frame, m."""

    type: Literal["Point"]
    coordinates: list[float] = Field(min_length=3, max_length=3)


class OmloxLocation(BaseModel):
    """A position as an omlox hub takes it."""

    position: OmloxPoint
    source: str = Field(description="name of the site")
    provider_type: Literal["unknown"]
    provider_id: str = Field(description="the target_id")
    timestamp_generated: str | None = None
    speed: float | None = Field(default=None, description="horizontal speed of the track, m/s")
    course: float | None = Field(default=None, description="bearing of the track, clockwise from north, deg")
    crs: Literal["local"]
    accuracy: float = Field(
        description="horizontal accuracy, m: the radius that holds the target with the `confidence` of the report"
    )
    floor: float
    elevation_ref: Literal["floor"]
    properties: dict[str, Any]


NativeOrOther = FixDocument | Local3dPointUncertaintyEllipsoid | OmloxLocation
AdaptedOrOther = AdaptedFixDocument | Local3dPointUncertaintyEllipsoid | OmloxLocation


def _examples(fix: Mapping[str, Any]) -> dict[int | str, dict[str, Any]]:
    answers = {"native": fix, "3gpp": LOCAL_3D_EXAMPLE, "omlox": OMLOX_EXAMPLE}
    return {
        200: {
            "description": "The position, in the format of the query parameter output",
            "content": {
                "application/json": {
                    "examples": {name: {"summary": f"output={name}", "value": value} for name, value in answers.items()}
                }
            },
        }
    }


NATIVE_ANSWER = _examples(FIX_EXAMPLE)
"""The answer to a report, for the OpenAPI document."""

ADAPTED_ANSWER = _examples(ADAPTED_FIX_EXAMPLE)
"""The answer to a message of another format, for the OpenAPI document."""

POSITION_PROBLEMS = problem_responses(
    MALFORMED_JSON, NOT_FOUND, BODY_TOO_LARGE, UNSUPPORTED_MEDIA_TYPE, INVALID_REPORT, NOT_READY, FIX_TIMEOUT
)
"""What may go wrong with a report, for the OpenAPI document."""

POSITION_PROBLEMS[INVALID_REPORT.status]["content"][MEDIA_TYPE]["example"] = PROBLEM_EXAMPLE


def request_body(model: type[BaseModel], examples: Mapping[str, Any]) -> dict[str, Any]:
    """Describe a body for OpenAPI; the routes read it themselves, to answer all errors in one style."""
    schema = {"$ref": f"#/components/schemas/{model.__name__}"}
    return {
        "requestBody": {"required": True, "content": {"application/json": {"schema": schema, "examples": examples}}}
    }
