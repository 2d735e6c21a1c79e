"""Routes that stay open: the feed of fixes, and reports in for fixes out."""

import asyncio
import json
from collections.abc import AsyncIterator
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, WebSocket
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, Field
from pydantic_core import to_json
from starlette.websockets import WebSocketDisconnect

from rayfix_service.http.access import client_of
from rayfix_service.http.dependencies import TableDep, TablesDep, report_limit
from rayfix_service.http.examples import FIX_EVENT_EXAMPLE
from rayfix_service.http.feed import FixFeed
from rayfix_service.http.feed_relay import FeedRelay
from rayfix_service.http.locating import AnswererDep, native
from rayfix_service.http.problems import (
    BODY_TOO_LARGE,
    INVALID_PARAMETER,
    NOT_FOUND,
    NOT_READY,
    problem_document,
    problem_responses,
)
from rayfix_service.http.rates import RateLimit
from rayfix_service.http.wanted import WantedDep
from rayfix_service.wire import FixDocument, ReportDocument

router = APIRouter(prefix="/v1", tags=["streams"])

HEARTBEAT_SECONDS = 15.0
"""Least frequency of something on a feed, so that proxies keep it open and either side notices when it is not."""

_RETRY_MILLISECONDS = 2000


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
            "an object with `table`, `report` and `fix` as its data. A listener that reads too slowly loses the oldest "
            'fixes and is told by an event `dropped` with the data `{"dropped": 7}`. Comments keep it open.',
            "content": {
                "text/event-stream": {
                    "schema": {"type": "string"},
                    "example": f"id: 1\nevent: fix\ndata: {json.dumps(FIX_EVENT_EXAMPLE)}\n\n",
                }
            },
        },
        **problem_responses(INVALID_PARAMETER, NOT_FOUND, NOT_READY),
    },
)
async def get_fixes(
    request: Request,
    tables: TablesDep,
    table: Annotated[str | None, Query(description="the only table to hear of")] = None,
    target_id: Annotated[str | None, Query(description="the only target to hear of", max_length=256)] = None,
) -> EventStreamResponse:
    """Tell of every fix that the service makes from now on, by whichever route its report came."""
    tables.all()  # none answers before it is ready
    if table is not None:
        tables.named(table)
    return EventStreamResponse(
        _events(request.app.state.feed, request.app.state.relay, table, target_id),
        # A proxy that gathers answers before it passes them on would gather these for ever.
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


async def _events(
    feed: FixFeed, relay: FeedRelay | None, table: str | None, target_id: str | None
) -> AsyncIterator[bytes]:
    """Write the events of a feed."""
    with feed.subscribe(table=table, target_id=target_id) as subscription:
        if relay is not None:
            await relay.connect()
        yield b"retry: %d\n\n" % _RETRY_MILLISECONDS
        while True:
            await subscription.wait(HEARTBEAT_SECONDS)
            dropped, events = subscription.take()
            if dropped:
                yield b'event: dropped\ndata: {"dropped":%d}\n\n' % dropped
            if events:
                yield b"".join(b"id: %d\nevent: fix\ndata: %b\n\n" % (e.number, e.data) for e in events)
            elif subscription.closed:
                return
            else:
                yield b": still here\n\n"


@router.websocket("/stream")
async def stream(websocket: WebSocket, answerer: AnswererDep, table: TableDep, wanted: WantedDep) -> None:
    """Answer each message, a report, with a fix or a problem, in their order.

    The next message is read when the last answer is on its way, so that a client that sends faster than it is
    answered waits.
    """
    await websocket.accept(subprotocol="rayfix" if "rayfix" in websocket.scope["subprotocols"] else None)
    limit = report_limit(websocket)
    rate: RateLimit | None = websocket.app.state.rate_limit
    client = client_of(websocket)
    try:
        while True:
            if rate is not None:
                await asyncio.sleep(rate.seconds_to_wait(client))
                rate.charge(client)
            body = await _next_message(websocket)
            answer: dict[str, Any]
            if len(body) > limit:
                answer = problem_document(
                    BODY_TOO_LARGE, f"the message is longer than {limit} bytes; send fewer measurements at once"
                )
            else:
                answer = await answerer.answer_or_problem(table, partial(answerer.read, native, body), wanted)
            await websocket.send_text(to_json(answer, inf_nan_mode="null").decode())
            await asyncio.sleep(0)  # whatever else is on the loop comes in between
    except WebSocketDisconnect:
        pass


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
