"""Routes that locate."""

import asyncio

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.datastructures import State
from starlette.types import Receive, Scope

from rayfix_service.http.answering.locating import native
from rayfix_service.http.answering.response_options import response_options_of
from rayfix_service.http.openapi.examples import BATCH_EXAMPLES, REPORT_EXAMPLES
from rayfix_service.http.openapi.responses import NATIVE_ANSWER, POSITION_PROBLEMS, NativeOrOther, request_body
from rayfix_service.http.problems import Problem
from rayfix_service.http.routes.batches import answer_batch
from rayfix_service.http.routes.dependencies import (
    AnswererDep,
    BatchBody,
    ReportBody,
    ResponseOptionsDep,
    TableDep,
    read_body,
)
from rayfix_service.http.routes.json_answer import JsonAnswer, ResultsAnswer, write_json
from rayfix_service.http.routes.one_report import answer_one
from rayfix_service.http.services import services_in
from rayfix_service.wire import BatchDocument, ReportDocument


class BatchResult(BaseModel):
    """The answers to a batch, in the order of its reports.

    All its problems together list some 50 fields, or what the service is set to; once they do, each further one lists
    its first and counts the others.
    """

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
async def post_position(
    answerer: AnswererDep, table: TableDep, body: ReportBody, options: ResponseOptionsDep
) -> JsonAnswer:
    """Fuse the measurements of one transmission into a position, with its uncertainty and its rivals."""
    return await answer_one(native, body, answerer, table, options, "positions")


async def answer_position(state: State, scope: Scope, receive: Receive) -> tuple[bytes, str]:
    """Answer a request without a query as :func:`post_position` does; returns the answer's body and media type.

    ``state`` is the application's. Requests that came together take each of the three steps together: the processor's
    caches hold the code of one step and not that of all, so that this saves an eighth of the time.
    """
    services = services_in(state)
    answerer = services.answerer
    table = services.tables.named(None)
    body = await read_body(scope, receive, services.settings.body_limits.report)
    options = response_options_of(scope, services.settings)
    with answerer.metrics.reports.timed("positions"):
        incoming = await answerer.read_report(body)
        await asyncio.sleep(0)
        located = await answerer.locate(table, incoming, options)
        await asyncio.sleep(0)
        return write_json(answerer.write(table, incoming, options, located)), options.media_type


@router.post(
    "/positions/batch",
    summary="Locate many reports",
    response_model=BatchResult,
    responses=POSITION_PROBLEMS,
    openapi_extra=request_body(BatchDocument, BATCH_EXAMPLES),
)
async def post_batch(
    request: Request, answerer: AnswererDep, table: TableDep, body: BatchBody, options: ResponseOptionsDep
) -> ResultsAnswer:
    """Locate each report on its own; one that cannot be used gets a problem and leaves the others alone."""
    return await answer_batch(request, answerer, table, body, options, native, "batch")
