"""Routes that locate."""

import asyncio
import logging
from collections.abc import Mapping
from time import perf_counter
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field

from rayfix_service.fusion.locator import Locator
from rayfix_service.fusion.report import Report
from rayfix_service.http.dependencies import BatchBody, LocatorDep, ReportBody
from rayfix_service.http.examples import BATCH_EXAMPLES, FIX_EXAMPLE, PROBLEM_EXAMPLE, REPORT_EXAMPLES
from rayfix_service.http.problems import (
    BODY_TOO_LARGE,
    CONNECTION_ENDED,
    INVALID_REPORT,
    MALFORMED_JSON,
    MEDIA_TYPE,
    NOT_READY,
    UNSUPPORTED_MEDIA_TYPE,
    Problem,
    ProblemError,
    internal_problem,
    problem_responses,
    report_problem,
)
from rayfix_service.wire import (
    MAX_REPORTS,
    BatchDocument,
    FieldProblem,
    FixDocument,
    InvalidReportError,
    ReportDocument,
    fix_to_document,
    parse_report,
    path_text,
    read_json,
)
from rayfix_tables.errors import ReportError

router = APIRouter(prefix="/v1", tags=["positions"])

_log = logging.getLogger(__name__)


class BatchResult(BaseModel):
    """The answers to a batch, in the order of its reports."""

    results: list[FixDocument | Problem] = Field(
        description="a fix, or the problem of that report; paths in a problem start at the report"
    )


def _request_body(model: type[BaseModel], examples: Mapping[str, Any]) -> dict[str, Any]:
    """Describe a body for OpenAPI; the routes read it themselves, to answer all errors in one style."""
    schema = {"$ref": f"#/components/schemas/{model.__name__}"}
    content = {"application/json": {"schema": schema, "examples": examples}}
    return {"requestBody": {"required": True, "content": content}}


_PROBLEMS = problem_responses(MALFORMED_JSON, BODY_TOO_LARGE, UNSUPPORTED_MEDIA_TYPE, INVALID_REPORT, NOT_READY)
_PROBLEMS[INVALID_REPORT.status]["content"][MEDIA_TYPE]["example"] = PROBLEM_EXAMPLE


# These routes are "async def" and compute right on the event loop. A fix with an angle takes a millisecond or
# a few, and in the thread pool that FastAPI has for "def" they would wait for each other's GIL: measured with
# two threads, 1.6 ms become 3.4. More worker processes use more processor cores. Only a report of very many
# measurements, which can take seconds, goes to a thread, so that /livez answers meanwhile.
_MEASUREMENTS_ON_LOOP = 16


@router.post(
    "/positions",
    summary="Locate one report",
    response_model=FixDocument,
    responses={
        200: {"description": "The fix", "content": {"application/json": {"example": FIX_EXAMPLE}}},
        **_PROBLEMS,
    },
    openapi_extra=_request_body(ReportDocument, REPORT_EXAMPLES),
)
async def post_position(locator: LocatorDep, body: ReportBody) -> JSONResponse:
    """Fuse the measurements of one transmission into a position, with its uncertainty and its rivals."""
    return JSONResponse(await _locate(locator, parse_report(body)))


@router.post(
    "/positions/batch",
    summary="Locate many reports",
    response_model=BatchResult,
    responses=_PROBLEMS,
    openapi_extra=_request_body(BatchDocument, BATCH_EXAMPLES),
)
async def post_batch(request: Request, locator: LocatorDep, body: BatchBody) -> JSONResponse:
    """Locate each report on its own; one that cannot be used gets a problem and leaves the others alone."""
    documents = _batch_reports(read_json(body))
    results: list[dict[str, Any]] = []
    for document in documents:
        # A client that gave up waiting tends to ask again: do not compute for both.
        if await request.is_disconnected():
            _log.info("batch given up after %d of %d reports: the client left", len(results), len(documents))
            raise ProblemError(CONNECTION_ENDED, "the connection ended before the answer")
        results.append(await _locate_or_problem(locator, document))
        await asyncio.sleep(0)  # a thousand fixes take a second: let other requests in between
    return JSONResponse({"results": results})


async def _locate(locator: Locator, report: Report) -> dict[str, Any]:
    start = perf_counter()
    if len(report.measurements) <= _MEASUREMENTS_ON_LOOP:
        fix = locator.locate(report)
    else:
        fix = await asyncio.to_thread(locator.locate, report)
    return fix_to_document(fix, perf_counter() - start)


async def _locate_or_problem(locator: Locator, document: Any) -> dict[str, Any]:
    try:
        return await _locate(locator, parse_report(document))
    except ReportError as error:
        return report_problem(error)
    except Exception:
        # A defect that one report meets must not cost the other 999 their fix.
        _log.exception("a report of a batch failed")
        return internal_problem()


def _batch_reports(document: object) -> list[Any]:
    """Return the reports of a batch, whatever they are.

    Raises
    ------
    InvalidReportError
        When the document is not a batch.
    """
    path: tuple[str | int, ...] = ()
    if not isinstance(document, dict):
        text = 'the batch is no JSON object; give {"reports": [...]}'
    elif unknown := [key for key in document if key != "reports"]:
        path = (unknown[0],)
        text = f"{path_text(path)} is an unknown key; a batch has the key reports alone"
    elif not isinstance(document.get("reports"), list):
        path = ("reports",)
        text = "reports is missing or no array; give an array of reports"
    elif len(document["reports"]) > MAX_REPORTS:
        path = ("reports",)
        text = f"reports is an array of length {len(document['reports'])}; give at most {MAX_REPORTS} at once"
    else:
        return list(document["reports"])
    raise InvalidReportError((FieldProblem(path=path, message=text),))
