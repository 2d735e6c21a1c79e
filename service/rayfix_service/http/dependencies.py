"""What routes depend on: the loaded table, and the body of a request.

All dependencies are ``async``, though some wait for nothing: FastAPI sends plain functions to a thread pool,
which costs more than they do.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request
from starlette.requests import ClientDisconnect, HTTPConnection

from rayfix_service.fusion.locator import Locator
from rayfix_service.http.problems import (
    BODY_TOO_LARGE,
    CONNECTION_ENDED,
    NOT_READY,
    UNSUPPORTED_MEDIA_TYPE,
    ProblemError,
)
from rayfix_tables.errors import RayfixError

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class BodyLimits:
    """How long a request may be, bytes."""

    report: int = 1 << 20
    batch: int = 16 << 20


class Service:
    """The locator of one process, and how far it is.

    Parameters
    ----------
    locator : Locator
        Of an open table that is not verified yet.
    on_ready : callable
        Called once it can locate.
    """

    def __init__(self, locator: Locator, *, on_ready: Callable[[], None]) -> None:
        self._on_ready = on_ready
        self.ready = False
        self.failure: str | None = None
        self._locator = locator

    async def prepare(self) -> None:
        """Verify the table and compile the kernels, in a thread; never raises."""
        try:
            await asyncio.to_thread(self._locator.table.verify)
            await asyncio.to_thread(self._locator.warm_up)
        except RayfixError as error:
            self.failure = "the table does not pass its check, the log says why; replace it and start again"
            _log.critical("not ready: %s", error)
        except Exception:
            self.failure = "the start failed, the log says why"
            _log.critical("not ready", exc_info=True)
        else:
            self.ready = True
            self._on_ready()
            _log.info("ready with table %s", self._locator.table.table_id)

    def locator(self) -> Locator:
        """Return the locator.

        Raises
        ------
        ProblemError
            While it is not ready.
        """
        if self.ready:
            return self._locator
        if self.failure is not None:
            raise ProblemError(NOT_READY, self.failure)
        raise ProblemError(
            NOT_READY,
            "the table is being checked and the kernels compiled; try again when /readyz answers 200",
            headers={"Retry-After": "1"},
        )


async def get_locator(connection: HTTPConnection) -> Locator:
    """Return the locator, or end the request with 503."""
    service: Service = connection.app.state.service
    return service.locator()


LocatorDep = Annotated[Locator, Depends(get_locator)]


def report_limit(connection: HTTPConnection) -> int:
    """Return how long a report may be, bytes."""
    limits: BodyLimits = connection.app.state.body_limits
    return limits.report


def body_reader(limit_of: Callable[[BodyLimits], int], *, text: bool = False) -> Callable[[Request], Awaitable[bytes]]:
    """Make the dependency that reads a body, JSON or plain text, within a limit."""

    async def read_body(request: Request) -> bytes:
        (_require_text if text else _require_json)(request.headers.get("content-type"))
        limit = limit_of(request.app.state.body_limits)
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


ReportBody = Annotated[bytes, Depends(body_reader(lambda limits: limits.report))]
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
