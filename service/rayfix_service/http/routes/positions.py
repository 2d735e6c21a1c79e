"""Routes that locate."""

import asyncio
from functools import partial
from typing import Any

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.datastructures import State
from starlette.types import Receive, Scope

from rayfix_service.http.access.guard import charge_reports
from rayfix_service.http.answering.cooperative import Patience
from rayfix_service.http.answering.locating import Answerer, AnswererDep, native
from rayfix_service.http.answering.response_options import WantedDep, wanted_by
from rayfix_service.http.openapi.examples import BATCH_EXAMPLES, REPORT_EXAMPLES
from rayfix_service.http.openapi.responses import NATIVE_ANSWER, POSITION_PROBLEMS, NativeOrOther, request_body
from rayfix_service.http.problems import Problem
from rayfix_service.http.routes.dependencies import BatchBody, ReportBody, TableDep, read_body
from rayfix_service.http.routes.json_answer import JsonAnswer, write_json
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.wire import (
    MAX_REPORTS,
    BatchDocument,
    FieldProblem,
    InvalidReportError,
    ReportDocument,
    path_text,
    read_json,
)


class BatchResult(BaseModel):
    """The answers to a batch, in the order of its reports."""

    results: list[NativeOrOther | Problem] = Field(
        description="a fix in the format that is wanted, or the problem of that report, whose paths start at the report"
    )


router = APIRouter(prefix="/v1", tags=["positions"])


@router.post(
    "/positions",
    summary="Locate one report",
    response_model=NativeOrOther,
    responses={**NATIVE_ANSWER, **POSITION_PROBLEMS},
    openapi_extra=request_body(ReportDocument, REPORT_EXAMPLES),
)
async def post_position(answerer: AnswererDep, table: TableDep, body: ReportBody, wanted: WantedDep) -> JsonAnswer:
    """Fuse the measurements of one transmission into a position, with its uncertainty and its rivals."""
    return JsonAnswer(await answerer.answer(table, native(body), wanted), media_type=wanted.media_type)


async def answer_position(state: State, scope: Scope, receive: Receive) -> tuple[bytes, str]:
    """Answer a request without a query as :func:`post_position` does; returns the answer's body and media type.

    ``state`` is the application's. Requests that came together take each of the three steps together: the processor's
    caches hold the code of one step and not that of all, so that this saves an eighth of the time.
    """
    settings: ServiceSettings = state.settings
    answerer: Answerer = state.answerer
    table = state.tables.named(None)
    body = await read_body(scope, receive, settings.body_limits.report)
    wanted = wanted_by(scope, settings)
    incoming = native(body)
    await asyncio.sleep(0)
    located = await answerer.locate(table, incoming, wanted)
    await asyncio.sleep(0)
    return write_json(answerer.write(table, incoming, wanted, located)), wanted.media_type


@router.post(
    "/positions/batch",
    summary="Locate many reports",
    response_model=BatchResult,
    responses=POSITION_PROBLEMS,
    openapi_extra=request_body(BatchDocument, BATCH_EXAMPLES),
)
async def post_batch(
    request: Request, answerer: AnswererDep, table: TableDep, body: BatchBody, wanted: WantedDep
) -> JsonAnswer:
    """Locate each report on its own; one that cannot be used gets a problem and leaves the others alone."""
    documents = _batch_reports(read_json(body))
    charge_reports(request, len(documents))
    results: list[dict[str, Any]] = []
    patience = Patience(request)
    for document in documents:  # not by locate_batch: other batches keep the other workers, one for each core, as busy
        await patience.take_a_breath()
        results.append(await answerer.answer_or_problem(table, partial(native, document), wanted))
    return JsonAnswer({"results": results})


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
