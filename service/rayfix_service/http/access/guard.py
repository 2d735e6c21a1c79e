"""Who may use the service, and how much."""

import asyncio
import logging
import math
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from typing import Any

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send

from rayfix_service.http.access.keys import ApiKeys
from rayfix_service.http.access.paths import is_open
from rayfix_service.http.access.rates import RateLimit
from rayfix_service.http.problems import (
    TOO_MANY_REQUESTS,
    UNAUTHORIZED,
    ProblemError,
    error_response,
    problem_responses,
)

KEY_SUBPROTOCOL = "rayfix.key."
"""Beginning of the web-socket subprotocol that carries a key; browsers can set no header there."""

_log = logging.getLogger(__name__)

_CLIENT = "rayfix.client"
_ACCESS = "rayfix.access"
_ENDING_SECONDS = 1.0


class Access:
    """Middleware that asks for an API key and keeps to the rate limit.

    Health checks, the documentation and the viewer's page are open; all else needs a key, whether it is there or not.
    """

    def __init__(self, app: ASGIApp, keys: ApiKeys | None, limit: RateLimit | None) -> None:
        self._app = app
        self.keys = keys
        self.limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] in ("http", "websocket") and not is_open(scope["path"]):
            try:
                self._admit(scope)
            except ProblemError as error:
                await error_response(error)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _admit(self, scope: Scope) -> None:
        if self.keys is None:
            # Without keys the service is on loopback, where all clients are one.
            client = "local"
        else:
            client = self.keys.name_of(_presented_key(scope)) or ""
            if not client:
                raise ProblemError(
                    UNAUTHORIZED,
                    "the API key is missing or unknown; send the header Authorization: Bearer KEY or X-API-Key: KEY",
                    headers={"WWW-Authenticate": "Bearer"},
                )
        scope[_CLIENT] = client
        scope[_ACCESS] = self
        if self.limit is not None and scope["type"] == "http" and scope["method"] == "POST":
            _require_tokens(self.limit.seconds_to_wait(client))
            self.limit.charge(client)


def charge_report(connection: HTTPConnection) -> None:
    """Count a request that is no POST as a report, for what takes as long as one.

    Raises
    ------
    ProblemError
        When the client has sent more than it may.
    """
    limit = limit_of(connection)
    if limit is not None:
        client = client_of(connection)
        _require_tokens(limit.seconds_to_wait(client))
        limit.charge(client)


def charge_reports(connection: HTTPConnection, reports: int) -> None:
    """Charge the reports of a request that is read now, of which one was charged when its head came.

    Whoever sends many heads first and their bodies later would get all of them in: so the request, as if it came now,
    must find a token, and only one at a time makes debts.

    Raises
    ------
    ProblemError
        When the client has sent more than it may since the head came.
    """
    limit = limit_of(connection)
    if limit is None or reports <= 1:
        return
    client = client_of(connection)
    _require_tokens(limit.seconds_to_wait(client, given=1))
    limit.charge(client, reports - 1)


def _require_tokens(seconds: float) -> None:
    if seconds > 0.0:
        raise ProblemError(
            TOO_MANY_REQUESTS,
            "this key has sent more reports than it may; try again after the seconds of Retry-After",
            headers={"Retry-After": str(math.ceil(seconds))},
        )


def limit_of(connection: HTTPConnection) -> RateLimit | None:
    """Return the rate limit that a request is subject to."""
    return _access(connection).limit


def _access(connection: HTTPConnection) -> Access:
    access: Access = connection.scope[_ACCESS]
    return access


def client_of(connection: HTTPConnection) -> str:
    """Return the name of the key that a request came with."""
    name: str = connection.scope[_CLIENT]
    return name


@contextmanager
def until_revoked(connection: HTTPConnection, end: Callable[[], None]) -> Iterator[None]:
    """Call ``end`` when the key that a connection came with is taken out, and cancel the task that does not end then.

    Of a client that does not read, what it is sent waits; only to cancel helps.
    """
    keys = _access(connection).keys
    if keys is None:
        yield
        return
    loop, task, late = asyncio.get_running_loop(), asyncio.current_task(), []

    def cut() -> None:
        _log.warning("a stream whose key was taken out is cut: its client does not read")
        if task is not None:
            task.cancel()

    def end_it() -> None:
        end()
        late.append(loop.call_later(_ENDING_SECONDS, cut))

    try:
        with keys.in_use(_presented_key(connection.scope), end_it):
            yield
    finally:
        for handle in late:
            handle.cancel()


def describe_access(document: dict[str, Any]) -> None:
    """Add the keys, and what is answered without one, to an OpenAPI document.

    ``{}`` stands for a service on loopback, which may ask for none.
    """
    document["components"]["securitySchemes"] = {
        "bearer": {"type": "http", "scheme": "bearer"},
        "header": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
    }
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            if not is_open(path):
                operation["security"] = [{"bearer": []}, {"header": []}, {}]
                refusals = (UNAUTHORIZED, TOO_MANY_REQUESTS) if method == "post" else (UNAUTHORIZED,)
                for status, refusal in problem_responses(*refusals).items():
                    operation["responses"][str(status)] = refusal


def _presented_key(scope: MutableMapping[str, Any]) -> str:
    headers = Headers(scope=scope)
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    if (key := headers.get("x-api-key")) is not None:
        return key
    offered = (p.removeprefix(KEY_SUBPROTOCOL) for p in scope.get("subprotocols", ()) if p.startswith(KEY_SUBPROTOCOL))
    return next(offered, "")
