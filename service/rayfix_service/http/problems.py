"""Errors as RFC 9457 problem documents (``application/problem+json``)."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError, WebSocketRequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from rayfix_service.wire import FieldProblem, MalformedJsonError, more_problems, problems_of
from rayfix_service.wire.limits import USUAL_LIMITS
from rayfix_service.wire.problems import parameter_problem
from rayfix_tables.errors import ReportError
from rayfix_tables.validation.problems import path_text

MEDIA_TYPE = "application/problem+json"


@dataclass(frozen=True, kw_only=True)
class ProblemKind:
    """What RFC 9457 calls a problem type: its status, its title, and the last part of its URI."""

    status: int
    title: str
    name: str

    @property
    def uri(self) -> str:
        """URI of the type, for programs to compare."""
        return f"urn:rayfix:problem:{self.name}"


MALFORMED_JSON = ProblemKind(status=400, title="Malformed JSON", name="malformed-json")
CONNECTION_ENDED = ProblemKind(status=400, title="Connection ended", name="connection-ended")
UNAUTHORIZED = ProblemKind(status=401, title="Unauthorized", name="unauthorized")
FORBIDDEN = ProblemKind(status=403, title="Forbidden", name="forbidden")
NOT_FOUND = ProblemKind(status=404, title="Not found", name="not-found")
METHOD_NOT_ALLOWED = ProblemKind(status=405, title="Method not allowed", name="method-not-allowed")
TABLE_REFUSED = ProblemKind(status=409, title="Table refused", name="table-refused")
BODY_TOO_LARGE = ProblemKind(status=413, title="Body too large", name="body-too-large")
UNSUPPORTED_MEDIA_TYPE = ProblemKind(status=415, title="Unsupported media type", name="unsupported-media-type")
MISDIRECTED = ProblemKind(status=421, title="Misdirected request", name="misdirected-request")
INVALID_REPORT = ProblemKind(status=422, title="Report cannot be used", name="invalid-report")
INVALID_PARAMETER = ProblemKind(status=422, title="Parameter cannot be used", name="invalid-parameter")
TOO_MANY_REQUESTS = ProblemKind(status=429, title="Too many requests", name="too-many-requests")
INTERNAL_ERROR = ProblemKind(status=500, title="Internal error", name="internal-error")
NOT_READY = ProblemKind(status=503, title="Not ready", name="not-ready")
OVERLOADED = ProblemKind(status=503, title="Overloaded", name="overloaded")
FIX_TIMEOUT = ProblemKind(status=504, title="Fix takes too long", name="fix-timeout")

KINDS = (
    MALFORMED_JSON,
    UNAUTHORIZED,
    FORBIDDEN,
    NOT_FOUND,
    METHOD_NOT_ALLOWED,
    TABLE_REFUSED,
    BODY_TOO_LARGE,
    UNSUPPORTED_MEDIA_TYPE,
    MISDIRECTED,
    INVALID_REPORT,
    INVALID_PARAMETER,
    TOO_MANY_REQUESTS,
    INTERNAL_ERROR,
    NOT_READY,
    OVERLOADED,
    FIX_TIMEOUT,
)
"""Every kind that a client may see; with its connection ended, there is none that sees."""


class ProblemField(BaseModel):
    """One offending field."""

    path: str = Field(
        description="where in the document, empty for the whole of it",
        examples=["measurements[0].azimuth_deg"],
    )
    message: str = Field(description="the field, its value, and what to do about it")


class Problem(BaseModel):
    """A problem document of RFC 9457."""

    type: str = Field(description="URI of the kind of problem", examples=[INVALID_REPORT.uri])
    title: str = Field(description="the kind of problem in words", examples=[INVALID_REPORT.title])
    status: int = Field(description="the HTTP status", examples=[INVALID_REPORT.status])
    detail: str = Field(description="what is wrong this time, and what to do about it")
    errors: list[ProblemField] = Field(
        description=f"the offending fields, at most {USUAL_LIMITS.listed_problems} unless the service is set otherwise"
    )
    more_errors: int = Field(
        default=0, description="how many offending fields are left out of errors; absent when none is"
    )


class ProblemError(Exception):
    """Ends a request with a problem."""

    def __init__(
        self,
        kind: ProblemKind,
        detail: str,
        *,
        errors: Iterable[FieldProblem] = (),
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.kind = kind
        self.errors = tuple(errors)
        self.headers = headers


def problem_document(
    kind: ProblemKind, detail: str, errors: Iterable[FieldProblem] = (), more_errors: int = 0
) -> dict[str, Any]:
    """Build the document that :class:`Problem` describes."""
    document = {
        "type": kind.uri,
        "title": kind.title,
        "status": kind.status,
        "detail": detail,
        "errors": [{"path": path_text(error.path), "message": error.message} for error in errors],
    }
    if more_errors:
        document["more_errors"] = more_errors
    return document


def report_problem(error: ReportError) -> dict[str, Any]:
    """Build the document of a report that cannot be used."""
    kind = MALFORMED_JSON if isinstance(error, MalformedJsonError) else INVALID_REPORT
    return problem_document(kind, str(error), problems_of(error), more_problems(error))


def internal_problem() -> dict[str, Any]:
    """Build the document of a defect. The cause is in the log only."""
    return problem_document(
        INTERNAL_ERROR, "this is a defect of the service, not of the request; its log has the cause"
    )


def problem_response(document: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Answer with a problem document."""
    return JSONResponse(document, status_code=document["status"], headers=headers, media_type=MEDIA_TYPE)


def problem_responses(*kinds: ProblemKind) -> dict[int | str, dict[str, Any]]:
    """Describe the kinds of problem of a route for the OpenAPI document."""
    schema = {"$ref": f"#/components/schemas/{Problem.__name__}"}
    return {kind.status: {"description": kind.title, "content": {MEDIA_TYPE: {"schema": schema}}} for kind in kinds}


def error_response(error: ProblemError | ReportError) -> JSONResponse:
    """Answer with the problem document of an error."""
    if isinstance(error, ProblemError):
        return problem_response(problem_document(error.kind, str(error), error.errors), error.headers)
    return problem_response(report_problem(error))


async def _answer_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, ProblemError | ReportError)
    return error_response(error)


async def _answer_validation(request: Request, error: Exception) -> JSONResponse:
    """Answer a parameter that FastAPI itself refuses, such as one of a query."""
    assert isinstance(error, RequestValidationError | WebSocketRequestValidationError)
    errors = [parameter_problem(detail) for detail in error.errors()]
    listed = errors[: USUAL_LIMITS.listed_problems]
    return problem_response(problem_document(INVALID_PARAMETER, errors[0].message, listed, len(errors) - len(listed)))


async def _answer_http(request: Request, error: Exception) -> JSONResponse:
    """Answer what the router or Starlette refuses."""
    assert isinstance(error, HTTPException)
    if error.status_code == 404:
        detail = f"there is nothing at {request.url.path}; /docs lists what there is"
        return problem_response(problem_document(NOT_FOUND, detail))
    if error.status_code == 405:
        allowed = (error.headers or {}).get("Allow", "another method")
        detail = f"{request.method} is not possible at {request.url.path}; use {allowed}"
        return problem_response(problem_document(METHOD_NOT_ALLOWED, detail), error.headers)
    kind = ProblemKind(status=error.status_code, title="HTTP error", name="http-error")
    return problem_response(problem_document(kind, str(error.detail)), error.headers)


async def _answer_defect(request: Request, error: Exception) -> JSONResponse:
    """Answer what nobody else does; the application's outermost middleware logs it."""
    return problem_response(internal_problem())


def install_problems(app: FastAPI) -> None:
    """Make every error that the routes of `app` raise a problem document."""
    app.add_exception_handler(ProblemError, _answer_error)
    app.add_exception_handler(ReportError, _answer_error)
    app.add_exception_handler(RequestValidationError, _answer_validation)
    app.add_exception_handler(WebSocketRequestValidationError, _answer_validation)  # before the handshake
    app.add_exception_handler(HTTPException, _answer_http)
    app.add_exception_handler(Exception, _answer_defect)
