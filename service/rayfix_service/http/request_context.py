"""What surrounds every request: its identifier, its line in the access log, its place in the figures."""

import logging
import re
from contextvars import ContextVar
from secrets import token_hex
from time import perf_counter

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rayfix_service.http.metrics import Metrics

HEADER = "X-Request-ID"
_RAW_HEADER = HEADER.lower().encode()

REQUEST_ID: ContextVar[str | None] = ContextVar("REQUEST_ID", default=None)
"""Identifier of the request under way."""

ACCESS_LOGGER = "rayfix_service.access"
"""Logger of a line per request; silent unless its level is INFO."""

_access = logging.getLogger(ACCESS_LOGGER)


class RequestContext:
    """Middleware that gives each request an identifier, the client's own if it sent a proper one, and echoes it."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        identifier = _identifier(scope)
        status = "none"  # the client left before the answer

        async def send_noting(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = str(message["status"])
                message["headers"] = [*message.get("headers", ()), (_RAW_HEADER, identifier.encode())]
            await send(message)

        token = REQUEST_ID.set(identifier)
        start = perf_counter()
        try:
            await self._app(scope, receive, send_noting)
        finally:
            seconds = perf_counter() - start
            # Only the route's template: the path is the client's, and a figure for each would be without end.
            route = getattr(scope.get("route"), "path", "none")
            self._metrics.request_done(route, scope["method"], status, seconds)
            if _access.isEnabledFor(logging.INFO):
                fields = {
                    "method": scope["method"],
                    "path": scope["path"],
                    "status": status,
                    "seconds": round(seconds, 6),
                }
                line = "%s %s %s in %.1f ms, request %s"
                arguments = (scope["method"], scope["path"], status, 1e3 * seconds, identifier)
                _access.info(line, *arguments, extra={"fields": fields})
            REQUEST_ID.reset(token)


def _identifier(scope: Scope) -> str:
    """Take the client's identifier where it is fit for a log, else make one."""
    given = next((value for name, value in scope["headers"] if name == _RAW_HEADER), None)
    if given is not None and re.fullmatch(rb"[A-Za-z0-9._:/+=-]{1,128}", given):
        return bytes(given).decode()
    return token_hex(16)
