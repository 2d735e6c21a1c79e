"""Routes that stay open: the feed of fixes, and reports in for fixes out."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, WebSocket
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, Field
from pydantic_core import to_json
from starlette.websockets import WebSocketDisconnect, WebSocketDisconnected

from rayfix_service.http.access.guard import client_of, limit_of, until_revoked
from rayfix_service.http.answering.feed import FixEvent
from rayfix_service.http.answering.response_options import ResponseOptions
from rayfix_service.http.openapi.examples import FIX_EVENT_EXAMPLE
from rayfix_service.http.problems import (
    BODY_TOO_LARGE,
    INVALID_PARAMETER,
    NOT_FOUND,
    NOT_READY,
    OVERLOADED,
    ProblemError,
    problem_document,
    problem_responses,
)
from rayfix_service.http.routes.dependencies import ResponseOptionsDep, ServicesDep, TableDep
from rayfix_service.http.services import Services
from rayfix_service.http.telemetry.report_figures import report_outcome
from rayfix_service.wire import FixDocument, ReportDocument

router = APIRouter(prefix="/v1", tags=["streams"])

HEARTBEAT_SECONDS = 15.0
"""Least frequency of something on a feed, so that proxies keep it open and either side notices when it is not."""

_RETRY_MILLISECONDS = 2000
_PIECE = 1 << 16  # bytes
_REVOKED = 1008  # a web socket's code for a breach of policy


class FixEventDocument(BaseModel):
    """The data of an event ``fix``."""

    table: str = Field(description="name of the table that answered")
    report: ReportDocument = Field(
        description="the report as it was posted; from another format, the report that it was turned into"
    )
    fix: FixDocument


class EventStreamResponse(StreamingResponse):
    """Server-sent events."""

    media_type = "text/event-stream"


@router.get(
    "/fixes",
    summary="All fixes, as they are made",
    response_class=EventStreamResponse,
    responses={
        200: {
            "description": "Server-sent events until the client leaves. Each event `fix` has a count as its `id` and "
            "an object with `table`, `report` and `fix` as its data; `fix` has the `track` of a target that is "
            "followed. A listener that reads too slowly loses the oldest "
            'fixes and gets an event `dropped` with the data `{"dropped": 7}`. Comments keep it open.',
            "content": {
                "text/event-stream": {
                    "schema": {"type": "string"},
                    "example": f"id: 1\nevent: fix\ndata: {json.dumps(FIX_EVENT_EXAMPLE)}\n\n",
                }
            },
        },
        **problem_responses(INVALID_PARAMETER, NOT_FOUND, NOT_READY),
        OVERLOADED.status: {**problem_responses(NOT_READY)[503], "description": "Not ready, or overloaded"},
    },
)
async def get_fixes(
    request: Request,
    services: ServicesDep,
    table: Annotated[str | None, Query(description="the only table whose fixes are sent")] = None,
    target_id: Annotated[str | None, Query(description="the only target whose fixes are sent", max_length=256)] = None,
) -> EventStreamResponse:
    """Tell of every fix that the service makes from now on, by whichever route its report came."""
    services.tables.all()  # none answers before it is ready
    if table is not None:
        services.tables.named(table)
    if services.feed.is_full:
        raise ProblemError(
            OVERLOADED,
            "as many listen to the fixes as may; try again later, or start the service with more --listeners",
            headers={"Retry-After": "10"},
        )
    return EventStreamResponse(
        _events(request, services, table, target_id),
        # A proxy that gathers answers before it passes them on would gather these for ever.
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


async def _events(
    request: Request, services: Services, table: str | None, target_id: str | None
) -> AsyncIterator[bytes]:
    """Write the events of a feed, in pieces after which the client may have to read first."""
    with (
        services.feed.subscribe(table=table, target_id=target_id) as subscription,
        until_revoked(request, subscription.close),
    ):
        if services.relay is not None:
            await services.relay.connect()
        yield b"retry: %d\n\n" % _RETRY_MILLISECONDS
        while True:
            await subscription.wait(HEARTBEAT_SECONDS)
            dropped, events = subscription.take()
            if dropped:
                yield b'event: dropped\ndata: {"dropped":%d}\n\n' % dropped
            for piece in _pieces(events):
                yield piece
            if subscription.closed:
                return
            if not events:
                yield b": still here\n\n"


def _pieces(events: list[FixEvent]) -> Iterator[bytes]:
    """Write events, several in a piece where they are short; a long one is several pieces."""
    gathered = b""
    for event in events:
        gathered += b"id: %d\nevent: fix\ndata: " % event.number
        for start in range(0, len(event.data), _PIECE):
            gathered += event.data[start : start + _PIECE]
            if len(gathered) >= _PIECE:
                yield gathered
                gathered = b""
        gathered += b"\n\n"
    if gathered:
        yield gathered


async def get_table_name(table: TableDep, name: Annotated[str | None, Query(alias="table")] = None) -> str | None:
    """Check that there is the table that the query names, and return its name alone: a stream outlives tables."""
    return name


@router.websocket("/stream")
async def stream(
    websocket: WebSocket,
    services: ServicesDep,
    table: Annotated[str | None, Depends(get_table_name)],
    options: ResponseOptionsDep,
) -> None:
    """Answer each message, a report, with a fix or a problem, in their order.

    The next message is read when the last answer is on its way, so that a client that sends faster than it is
    answered waits. Each is answered from the table that is served then.
    """
    await websocket.accept(subprotocol="rayfix" if "rayfix" in websocket.scope["subprotocols"] else None)
    limit = services.settings.body_limits.report
    rate = limit_of(websocket)
    client = client_of(websocket)
    closing: set[asyncio.Task[None]] = set()

    def close() -> None:
        closing.add(asyncio.create_task(_close(websocket)))

    with until_revoked(websocket, close):
        try:
            while True:
                if rate is not None:
                    while (seconds := rate.seconds_to_wait(client)) > 0.0:  # another stream may have been faster
                        await asyncio.sleep(seconds)
                    rate.charge(client)
                body = await _next_message(websocket)
                answer: dict[str, Any]
                if len(body) > limit:
                    services.metrics.reports.done("stream", "refused")
                    answer = problem_document(
                        BODY_TOO_LARGE, f"the message is longer than {limit} bytes; send fewer measurements at once"
                    )
                else:
                    answer = await _answer(services, table, body, options)
                await websocket.send_text(to_json(answer, inf_nan_mode="null").decode())
                await asyncio.sleep(0)  # whatever else is on the loop comes in between
        except (WebSocketDisconnect, WebSocketDisconnected):
            pass


async def _close(websocket: WebSocket) -> None:
    """Close a stream whose key was taken out."""
    with suppress(WebSocketDisconnect, WebSocketDisconnected):
        await websocket.close(_REVOKED, "the API key is no longer taken")


async def _answer(services: Services, table: str | None, body: bytes, options: ResponseOptions) -> dict[str, Any]:
    """Answer a message from the table that is served now."""
    try:
        served = services.tables.named(table)
    except ProblemError as error:
        services.metrics.reports.done("stream", report_outcome(error))
        return problem_document(error.kind, str(error), error.errors)
    answerer = services.answerer
    return await answerer.answer_or_problem(served, partial(answerer.read_report, body), options, "stream")


async def _next_message(websocket: WebSocket) -> bytes:
    """Receive a message, text or binary.

    Raises
    ------
    WebSocketDisconnect
        When the client has left.
    """
    message = await websocket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1000))
    text: str | None = message.get("text")
    return message["bytes"] if text is None else text.encode()
