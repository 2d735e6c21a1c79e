"""Routes that locate from messages of other systems; docs/formats.md describes them."""

from datetime import UTC, datetime
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, Field

from rayfix_service.adapters.adapted import known_height, station_map
from rayfix_service.adapters.formats import parse
from rayfix_service.adapters.nrppa import parse_nrppa
from rayfix_service.adapters.nrppa_documents import NrppaBatchDocument, NrppaDocument
from rayfix_service.adapters.silabs import SilabsBatchDocument, SilabsDocument, parse_silabs
from rayfix_service.adapters.ublox import USUAL_ERRORS, AngleErrors
from rayfix_service.http.access.guard import charge_reports
from rayfix_service.http.answering.cooperative import Cooperation
from rayfix_service.http.answering.locating import READ_LINES_AT_ONCE, Incoming, foreign
from rayfix_service.http.openapi.examples import (
    NRPPA_BATCH_EXAMPLES,
    NRPPA_EXAMPLES,
    SILABS_BATCH_EXAMPLES,
    SILABS_EXAMPLES,
    UBLOX_EXAMPLES,
)
from rayfix_service.http.openapi.responses import (
    ADAPTED_ANSWER,
    POSITION_PROBLEMS,
    AdaptedOrOther,
    request_body,
)
from rayfix_service.http.problems import MALFORMED_JSON, Problem
from rayfix_service.http.routes.batches import answer_batch
from rayfix_service.http.routes.dependencies import (
    AnswererDep,
    BatchBody,
    LinesBody,
    MessageOptionsDep,
    ReportBody,
    TableDep,
)
from rayfix_service.http.routes.json_answer import JsonAnswer, ResultsAnswer, write_json
from rayfix_service.http.routes.one_report import answer_one
from rayfix_service.wire.limits import MessageLimits

router = APIRouter(prefix="/v1/positions", tags=["formats"])


class MessagesResult(BaseModel):
    """The answers to messages in their order, or to lines, one for each transmission of each tag."""

    results: list[AdaptedOrOther | Problem] = Field(
        description="a fix in the format of the query parameter output, or the problem of that report"
    )


@router.post(
    "/nrppa",
    summary="Locate from NRPPa measurements",
    response_model=AdaptedOrOther,
    responses={**ADAPTED_ANSWER, **POSITION_PROBLEMS},
    openapi_extra=request_body(NrppaDocument, NRPPA_EXAMPLES),
)
async def post_nrppa(
    answerer: AnswererDep, table: TableDep, body: ReportBody, options: MessageOptionsDep
) -> JsonAnswer:
    """Take the measurements of a MEASUREMENT RESPONSE or REPORT of 3GPP TS 38.455, with the names of its ASN.1."""
    return await answer_one(_read_nrppa, body, answerer, table, options, "nrppa")


@router.post(
    "/silabs",
    summary="Locate from Silicon Labs locators",
    response_model=AdaptedOrOther,
    responses={**ADAPTED_ANSWER, **POSITION_PROBLEMS},
    openapi_extra=request_body(SilabsDocument, SILABS_EXAMPLES),
)
async def post_silabs(
    answerer: AnswererDep, table: TableDep, body: ReportBody, options: MessageOptionsDep
) -> JsonAnswer:
    """Take the angles that Silicon Labs' Bluetooth locators measured of one packet of a tag."""
    return await answer_one(_read_silabs, body, answerer, table, options, "silabs")


@router.post(
    "/nrppa/batch",
    summary="Locate from many NRPPa messages",
    response_model=MessagesResult,
    responses=POSITION_PROBLEMS,
    openapi_extra=request_body(NrppaBatchDocument, NRPPA_BATCH_EXAMPLES),
)
async def post_nrppa_batch(
    request: Request, answerer: AnswererDep, table: TableDep, body: BatchBody, options: MessageOptionsDep
) -> ResultsAnswer:
    """Locate each message on its own; one that cannot be used gets a problem and leaves the others alone."""
    return await answer_batch(request, answerer, table, body, options, _read_nrppa, "nrppa_batch")


@router.post(
    "/silabs/batch",
    summary="Locate from many packets of Silicon Labs locators",
    response_model=MessagesResult,
    responses=POSITION_PROBLEMS,
    openapi_extra=request_body(SilabsBatchDocument, SILABS_BATCH_EXAMPLES),
)
async def post_silabs_batch(
    request: Request, answerer: AnswererDep, table: TableDep, body: BatchBody, options: MessageOptionsDep
) -> ResultsAnswer:
    """Locate each packet on its own; one that cannot be used gets a problem and leaves the others alone."""
    return await answer_batch(request, answerer, table, body, options, _read_silabs, "silabs_batch")


def _read_nrppa(text: bytes, *, limits: MessageLimits) -> Incoming:
    return foreign(parse_nrppa(text, limits=limits))


def _read_silabs(text: bytes, *, limits: MessageLimits) -> Incoming:
    return foreign(parse_silabs(text, limits=limits))


@router.post(
    "/ublox",
    summary="Locate from u-blox anchors",
    response_model=MessagesResult,
    responses={status: problem for status, problem in POSITION_PROBLEMS.items() if status != MALFORMED_JSON.status},
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"text/plain": {"schema": {"type": "string"}, "examples": UBLOX_EXAMPLES}},
        }
    },
)
async def post_ublox(
    request: Request,
    answerer: AnswererDep,
    table: TableDep,
    body: LinesBody,
    options: MessageOptionsDep,
    station: Annotated[list[str], Query(description="ANCHOR=STATION, for anchors whose id is no station's")] = [],  # noqa: B006
    height_m: Annotated[float | None, Query(description="known height of the tags, z in the scene frame, m")] = None,
    height_stdev_m: Annotated[float | None, Query(description="its standard deviation, m")] = None,
    confidence: Annotated[
        float | None,
        Query(description="probability with which accuracies are to hold, 0.01 to 0.99; 0.68 unless given"),
    ] = None,
    stdev_deg: Annotated[
        float, Query(ge=1e-3, le=180, description="standard deviation of the anchors' angles, deg")
    ] = USUAL_ERRORS.stdev_deg,
    tail_share: Annotated[
        float, Query(ge=0, lt=1, description="probability that an angle's error is of a wider Gaussian")
    ] = USUAL_ERRORS.tail_share,
    tail_scale: Annotated[
        float, Query(ge=1, le=100, description="standard deviation of the wider Gaussian, in those of the other")
    ] = USUAL_ERRORS.tail_scale,
) -> ResultsAnswer:
    """Take ``+UUDF`` lines of u-blox anchors, join them by tag and sequence number, and locate each transmission.

    Lines without a log's time are taken for lines that end now.
    """
    known, results = known_height(height_m, height_stdev_m), list[bytes]()
    read = partial(
        parse,
        input_format="ublox",
        stations=station_map(station),
        height=known,
        confidence=confidence,
        errors=AngleErrors(stdev_deg=stdev_deg, tail_share=tail_share, tail_scale=tail_scale),
        received=datetime.now(UTC),
    )
    messages = await answerer.read(read, body, at_once=READ_LINES_AT_ONCE)
    charge_reports(request, len(messages))
    cooperation = Cooperation(request)
    for adapted in messages:
        await cooperation.let_others_run()
        answer = await answerer.answer_or_problem(table, partial(foreign, adapted), options, "ublox")
        results.append(write_json(answer))
    return ResultsAnswer(results)
