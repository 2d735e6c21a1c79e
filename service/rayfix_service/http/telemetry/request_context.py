"""Middleware around every request: identifier, log line, metrics, and a response to every unhandled exception."""

import asyncio
import logging
import re
from contextvars import ContextVar
from itertools import count
from secrets import token_hex
from time import perf_counter
from typing import Any
from urllib.parse import quote

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rayfix_service.http.headers import header
from rayfix_service.http.problems import OVERLOADED, internal_problem, problem_document, problem_response
from rayfix_service.http.telemetry.metrics import Metrics

HEADER = "X-Request-ID"
_RAW_HEADER = HEADER.lower().encode()

REQUEST_ID: ContextVar[str | None] = ContextVar("REQUEST_ID", default=None)
"""Identifier of the current request."""

ACCESS_LOGGER = "rayfix_service.access"
"""Logger of one line per request, at level INFO."""

_access = logging.getLogger(ACCESS_LOGGER)
_log = logging.getLogger(__name__)

_PROPER = re.compile(r"[A-Za-z0-9._:/+=-]{1,128}")


class UnderWay:
    """Knows whether POST requests are under way; others may be streams without an end."""

    def __init__(self) -> None:
        self._count = 0
        self._none = asyncio.Event()
        self._none.set()

    def begin(self) -> None:
        """Take one more into account."""
        self._count += 1
        self._none.clear()

    def end(self) -> None:
        """Forget one."""
        self._count -= 1
        if not self._count:
            self._none.set()

    async def until_none(self) -> None:
        """Wait until there is none."""
        await self._none.wait()


class RequestContext:
    """Middleware around all others.

    It gives each request an identifier and returns it in a header; a valid identifier from the client is used. It
    counts and logs the request. An unhandled exception is logged once and answered with a problem document unless a
    response has begun. Starlette answers exceptions of routes with the handler for Exception and raises them again; the
    server would log them a second time.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, under_way: UnderWay) -> None:
        self._app = app
        self._metrics = metrics
        self._under_way = under_way
        self._numbers = count()
        self._prefix = token_hex(10)  # of this process: a random number for each request costs a system call

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request, or one web socket from its handshake to its end."""
        if scope["type"] == "websocket":
            await self._serve_socket(scope, receive, send)
            return
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        identifier = self._identifier(scope)
        status, answered = 0, False

        async def send_noting(message: Message) -> None:
            nonlocal status, answered
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [*message.get("headers", ()), (_RAW_HEADER, identifier.encode())]
            elif message["type"] == "http.response.body":
                answered = not message.get("more_body", False)
            await send(message)

        token = REQUEST_ID.set(identifier)
        start = perf_counter()
        is_post = scope["method"] == "POST"
        if is_post:
            self._under_way.begin()
        try:
            await self._app(scope, receive, send_noting)
        except asyncio.CancelledError:  # not a defect: the process ends, or the client's key was removed
            if not answered:
                _log.warning("request %s %s cut off", scope["method"], _one_word(scope["path"]))
            if not status:
                await problem_response(_cut_off())(scope, receive, send_noting)
        except Exception:
            if status and not answered:
                raise  # only the server can cut the connection, and it logs
            _log.exception("request %s %s failed", scope["method"], _one_word(scope["path"]))
            if not status:
                await problem_response(internal_problem())(scope, receive, send_noting)
        finally:
            if is_post:
                self._under_way.end()
            self._note(scope, scope["method"], str(status or "none"), perf_counter() - start, identifier)
            REQUEST_ID.reset(token)

    async def _serve_socket(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a web socket; its handshake is a GET, answered with 101 or with a refusal."""
        identifier = self._identifier(scope)
        start, noted = perf_counter(), False

        def note(status: str) -> None:
            nonlocal noted
            if not noted:
                noted = True
                self._note(scope, "GET", status, perf_counter() - start, identifier)

        async def send_noting(message: Message) -> None:
            kind = message["type"]
            if kind in ("websocket.accept", "websocket.http.response.start"):
                message["headers"] = [*message.get("headers", ()), (_RAW_HEADER, identifier.encode())]
                note("101" if kind == "websocket.accept" else str(message["status"]))
            elif kind == "websocket.close":
                note("403")  # the server's status for a close before the handshake
            await send(message)

        token = REQUEST_ID.set(identifier)
        try:
            await self._app(scope, receive, send_noting)
        except asyncio.CancelledError:
            _log.warning("web socket %s cut off", _one_word(scope["path"]))
        finally:
            note("none")
            REQUEST_ID.reset(token)

    def _identifier(self, scope: Scope) -> str:
        """Use the client's identifier if it is safe in a log; otherwise make one."""
        given = header(scope, _RAW_HEADER)
        if given is not None and _PROPER.fullmatch(given):
            return given
        return f"{self._prefix}{next(self._numbers):012x}"

    def _note(self, scope: Scope, method: str, status: str, seconds: float, identifier: str) -> None:
        """Count a request and log it if enabled; the status is "none" if the client left before a response."""
        # The label is the route's template: with paths, which clients choose, the number of time series would be
        # unbounded.
        route = getattr(scope.get("route"), "path", "none")
        self._metrics.request_done(route, method, status, seconds)
        if _access.isEnabledFor(logging.INFO):
            fields = {"method": method, "path": scope["path"], "status": status, "seconds": round(seconds, 6)}
            line = "%s %s %s in %.1f ms, request %s"
            arguments = (_one_word(method), _one_word(scope["path"]), status, 1e3 * seconds, identifier)
            _access.info(line, *arguments, extra={"fields": fields})


def _one_word(text: str) -> str:
    """Quote a path to make it one word, so a client cannot add words to the line."""
    return quote(text, safe="/:@!$&'()*+,;=~", errors="replace")


def _cut_off() -> dict[str, Any]:
    return problem_document(OVERLOADED, "the process ends before this was answered; ask again")
