"""What routes depend on: the tables, and the body of a request.

All dependencies are ``async``, though some wait for nothing: FastAPI sends plain functions to a thread pool,
which costs more than they do.
"""

from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Annotated

from fastapi import Depends, Query, Request
from starlette.requests import HTTPConnection
from starlette.types import Receive, Scope

from rayfix_service.adapters.formats import OutputFormat
from rayfix_service.http.answering.locating import Answerer
from rayfix_service.http.answering.response_options import MEDIA_TYPES, ResponseOptions, response_options_of
from rayfix_service.http.answering.served_tables import ServedTable, Tables
from rayfix_service.http.headers import header
from rayfix_service.http.problems import (
    BODY_TOO_LARGE,
    CONNECTION_ENDED,
    UNSUPPORTED_MEDIA_TYPE,
    ProblemError,
)
from rayfix_service.http.services import Services, services_of
from rayfix_service.http.settings import BodyLimits


async def get_services(connection: HTTPConnection) -> Services:
    """Return what the application has."""
    return services_of(connection)


ServicesDep = Annotated[Services, Depends(get_services)]


async def get_table(
    services: ServicesDep,
    table: Annotated[str | None, Query(description="name of the table; needed where there are several")] = None,
) -> ServedTable:
    """Return the table that the query names, or end the request with 503, 404 or 422."""
    return services.tables.named(table)


TableDep = Annotated[ServedTable, Depends(get_table)]


async def get_tables(services: ServicesDep) -> Tables:
    """Return the tables, ready or not."""
    return services.tables


TablesDep = Annotated[Tables, Depends(get_tables)]


async def get_answerer(services: ServicesDep) -> Answerer:
    """Return what answers."""
    return services.answerer


AnswererDep = Annotated[Answerer, Depends(get_answerer)]

Output = Annotated[
    OutputFormat | None,
    Query(
        description="format of the answer: this service's own (native, the default), 3GPP TS 29.572 local 3D point, or "
        f"omlox location; the Accept header may name it instead: {', '.join(MEDIA_TYPES)}"
    ),
]
Track = Annotated[
    bool | None,
    Query(
        description="whether to follow targets by their target_id and timestamp, which reports must then have; the "
        "service's setting unless given"
    ),
]


async def get_response_options(
    connection: HTTPConnection, services: ServicesDep, output: Output = None, track: Track = None
) -> ResponseOptions:
    """Read what a request wants."""
    return response_options_of(connection.scope, services.settings, output, track)


ResponseOptionsDep = Annotated[ResponseOptions, Depends(get_response_options)]


async def get_message_options(
    options: ResponseOptionsDep,
    with_report: Annotated[
        bool, Query(description="whether a native answer also has the report that the message was turned into")
    ] = False,
) -> ResponseOptions:
    """Read what a request with another system's message wants."""
    return replace(options, with_report=True) if with_report else options


MessageOptionsDep = Annotated[ResponseOptions, Depends(get_message_options)]


def body_reader(limit_of: Callable[[BodyLimits], int], *, text: bool = False) -> Callable[[Request], Awaitable[bytes]]:
    """Make the dependency that reads a body, JSON or plain text, within a limit."""

    async def read_dependency(request: Request) -> bytes:
        limit = limit_of(services_of(request).settings.body_limits)
        return await read_body(request.scope, request.receive, limit, text=text)

    return read_dependency


async def read_body(scope: Scope, receive: Receive, limit: int, *, text: bool = False) -> bytes:
    """Read the body of a request, JSON or plain text.

    Raises
    ------
    ProblemError
        When it is of another type or longer than ``limit`` bytes, or the connection ends within it.
    """
    (_require_text if text else _require_json)(header(scope, b"content-type"))
    announced = header(scope, b"content-length")
    if announced is not None and announced.isdecimal() and int(announced) > limit:
        raise _too_large(limit)
    chunks, length, more = [], 0, True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise ProblemError(CONNECTION_ENDED, "the connection ended within the body")
        chunks.append(message.get("body", b""))
        length += len(chunks[-1])
        if length > limit:  # a chunked body announces nothing
            raise _too_large(limit)
        more = message.get("more_body", False)
    return chunks[0] if len(chunks) == 1 else b"".join(chunks)


ReportBody = Annotated[bytes, Depends(body_reader(lambda limits: limits.report))]
BatchBody = Annotated[bytes, Depends(body_reader(lambda limits: limits.batch))]
LinesBody = Annotated[bytes, Depends(body_reader(lambda limits: limits.report, text=True))]


def _require_json(content_type: str | None) -> None:
    if content_type == "application/json":  # as nearly all requests have it
        return
    media_type = _media_type(content_type)
    if media_type == "application/json" or (media_type.startswith("application/") and media_type.endswith("+json")):
        return
    raise _unsupported(media_type, "JSON", "application/json")


def _require_text(content_type: str | None) -> None:
    media_type = _media_type(content_type)
    if media_type != "text/plain":
        raise _unsupported(media_type, "lines of text", "text/plain")


def _media_type(content_type: str | None) -> str:
    return (content_type or "").partition(";")[0].strip().lower()


def _unsupported(found: str, what: str, wanted: str) -> ProblemError:
    return ProblemError(
        UNSUPPORTED_MEDIA_TYPE,
        f"the Content-Type is {repr(found[:100]) if found else 'missing'}; "
        f"send {what} with the header Content-Type: {wanted}",
        headers={"Accept": wanted},
    )


def _too_large(limit: int) -> ProblemError:
    # The rest of the body stays unread, so the connection cannot carry another request.
    return ProblemError(
        BODY_TOO_LARGE,
        f"the body is longer than {limit} bytes; send fewer measurements or reports at once",
        headers={"Connection": "close"},
    )
