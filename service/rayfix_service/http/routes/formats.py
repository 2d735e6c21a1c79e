"""Routes that locate from messages of other systems; docs/formats.md describes them."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, Field

from rayfix_service.adapters.adapted import known_height, station_map, with_height
from rayfix_service.adapters.nrppa import parse_nrppa
from rayfix_service.adapters.nrppa_documents import NrppaDocument
from rayfix_service.adapters.silabs import SilabsDocument, parse_silabs
from rayfix_service.adapters.ublox import parse_ublox
from rayfix_service.http.access.guard import charge_reports
from rayfix_service.http.answering.cooperative import Cooperation
from rayfix_service.http.answering.locating import foreign
from rayfix_service.http.openapi.examples import NRPPA_EXAMPLES, SILABS_EXAMPLES, UBLOX_EXAMPLES
from rayfix_service.http.openapi.responses import (
    ADAPTED_ANSWER,
    POSITION_PROBLEMS,
    AdaptedOrOther,
    request_body,
)
from rayfix_service.http.problems import MALFORMED_JSON, Problem
from rayfix_service.http.routes.dependencies import AnswererDep, LinesBody, ReportBody, ResponseOptionsDep, TableDep
from rayfix_service.http.routes.json_answer import JsonAnswer, results_answer, write_json

router = APIRouter(prefix="/v1/positions", tags=["formats"])


class LinesResult(BaseModel):
    """The answers to lines, one for each transmission of each tag."""

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
    answerer: AnswererDep, table: TableDep, body: ReportBody, options: ResponseOptionsDep
) -> JsonAnswer:
    """Take the measurements of a MEASUREMENT RESPONSE or REPORT of 3GPP TS 38.455, with the names of its ASN.1."""
    incoming = foreign(await answerer.read(partial(parse_nrppa, limits=answerer.message_limits), body))
    return JsonAnswer(await answerer.answer(table, incoming, options), media_type=options.media_type)


@router.post(
    "/silabs",
    summary="Locate from Silicon Labs locators",
    response_model=AdaptedOrOther,
    responses={**ADAPTED_ANSWER, **POSITION_PROBLEMS},
    openapi_extra=request_body(SilabsDocument, SILABS_EXAMPLES),
)
async def post_silabs(
    answerer: AnswererDep, table: TableDep, body: ReportBody, options: ResponseOptionsDep
) -> JsonAnswer:
    """Take the angles that Silicon Labs' Bluetooth locators measured of one packet of a tag."""
    incoming = foreign(await answerer.read(partial(parse_silabs, limits=answerer.message_limits), body))
    return JsonAnswer(await answerer.answer(table, incoming, options), media_type=options.media_type)


@router.post(
    "/ublox",
    summary="Locate from u-blox anchors",
    response_model=LinesResult,
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
    options: ResponseOptionsDep,
    station: Annotated[list[str], Query(description="ANCHOR=STATION, for anchors whose id is no station's")] = [],  # noqa: B006
    height_m: Annotated[float | None, Query(description="known height of the tags, z in the scene frame, m")] = None,
    height_stdev_m: Annotated[float | None, Query(description="its standard deviation, m")] = None,
) -> JsonAnswer:
    """Take ``+UUDF`` lines of u-blox anchors and join them by tag and sequence number."""
    known = known_height(height_m, height_stdev_m)
    results: list[bytes] = []
    messages = await answerer.read(partial(parse_ublox, stations=station_map(station)), body)
    charge_reports(request, len(messages))
    cooperation = Cooperation(request)
    for adapted in messages:
        await cooperation.let_others_run()
        make = partial(foreign, with_height(adapted, known))
        results.append(write_json(await answerer.answer_or_problem(table, make, options)))
    return results_answer(results)
