"""What routes depend on: the tables, and the body of a request.

All dependencies are ``async``, though some wait for nothing: FastAPI sends plain functions to a thread pool,
which costs more than they do.
"""

from collections.abc import Awaitable, Callable
from typing import Annotated

from fastapi import Depends, Query, Request
from starlette.requests import ClientDisconnect, HTTPConnection

from rayfix_service.http.problems import (
    BODY_TOO_LARGE,
    CONNECTION_ENDED,
    UNSUPPORTED_MEDIA_TYPE,
    ProblemError,
)
from rayfix_service.http.settings import BodyLimits, ServiceSettings
from rayfix_service.http.tables import ServedTable, Tables


async def get_table(
    connection: HTTPConnection,
    table: Annotated[str | None, Query(description="name of the table; needed where there are several")] = None,
) -> ServedTable:
    """Return the table that the query names, or end the request with 503, 404 or 422."""
    tables: Tables = connection.app.state.tables
    return tables.named(table)


TableDep = Annotated[ServedTable, Depends(get_table)]


async def get_tables(connection: HTTPConnection) -> Tables:
    """Return the tables, ready or not."""
    tables: Tables = connection.app.state.tables
    return tables


TablesDep = Annotated[Tables, Depends(get_tables)]


def report_limit(connection: HTTPConnection) -> int:
    """Return how long a report may be, bytes."""
    settings: ServiceSettings = connection.app.state.settings
    return settings.body_limits.report


def body_reader(limit_of: Callable[[BodyLimits], int], *, text: bool = False) -> Callable[[Request], Awaitable[bytes]]:
    """Make the dependency that reads a body, JSON or plain text, within a limit."""

    async def read_body(request: Request) -> bytes:
        (_require_text if text else _require_json)(request.headers.get("content-type"))
        limit = limit_of(request.app.state.settings.body_limits)
        announced = request.headers.get("content-length", "")
        if announced.isdecimal() and int(announced) > limit:
            raise _too_large(limit)
        body = bytearray()
        try:
            async for chunk in request.stream():  # a chunked body announces nothing
                body += chunk
                if len(body) > limit:
                    raise _too_large(limit)
        except ClientDisconnect:
            raise ProblemError(CONNECTION_ENDED, "the connection ended within the body") from None
        return bytes(body)

    return read_body


read_report_body = body_reader(lambda limits: limits.report)

ReportBody = Annotated[bytes, Depends(read_report_body)]
BatchBody = Annotated[bytes, Depends(body_reader(lambda limits: limits.batch))]
LinesBody = Annotated[bytes, Depends(body_reader(lambda limits: limits.report, text=True))]


def _require_json(content_type: str | None) -> None:
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
