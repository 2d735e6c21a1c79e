"""Who may use the service, and how much."""

import math
from typing import Any

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send

from rayfix_service.http.keys import ApiKeys
from rayfix_service.http.problems import (
    TOO_MANY_REQUESTS,
    UNAUTHORIZED,
    ProblemError,
    error_response,
    problem_responses,
)
from rayfix_service.http.rates import RateLimit

KEY_SUBPROTOCOL = "rayfix.key."
"""Beginning of the web-socket subprotocol that carries a key; browsers can set no header there."""

_CLIENT = "rayfix.client"


class Access:
    """Middleware that asks for an API key and keeps to the rate limit.

    What tells of measurements and positions is under ``/v1`` and needs a key, as do the figures; health checks, the
    documentation and the viewer's page are open.
    """

    def __init__(self, app: ASGIApp, keys: ApiKeys | None, limit: RateLimit | None) -> None:
        self._app = app
        self._keys = keys
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] in ("http", "websocket") and _needs_key(scope["path"]):
            try:
                self._admit(scope)
            except ProblemError as error:
                await error_response(error)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _admit(self, scope: Scope) -> None:
        if self._keys is None:
            # Without keys the service is on loopback, where all clients are one.
            client = "local"
        else:
            client = self._keys.name_of(_presented_key(scope)) or ""
            if not client:
                raise ProblemError(
                    UNAUTHORIZED,
                    "the API key is missing or unknown; send the header Authorization: Bearer KEY or X-API-Key: KEY",
                    headers={"WWW-Authenticate": "Bearer"},
                )
        scope[_CLIENT] = client
        if self._limit is not None and scope["type"] == "http" and scope["method"] == "POST":
            _charge(self._limit, client)


def charge_report(connection: HTTPConnection) -> None:
    """Count a request that is no POST as a report, for what takes as long as one.

    Raises
    ------
    ProblemError
        When the client has sent more than it may.
    """
    limit: RateLimit | None = connection.app.state.rate_limit
    if limit is not None:
        _charge(limit, client_of(connection))


def _charge(limit: RateLimit, client: str) -> None:
    if (seconds := limit.seconds_to_wait(client)) > 0.0:
        raise ProblemError(
            TOO_MANY_REQUESTS,
            "this key has sent more reports than it may; try again after the seconds of Retry-After",
            headers={"Retry-After": str(math.ceil(seconds))},
        )
    limit.charge(client)


def client_of(connection: HTTPConnection) -> str:
    """Return the name of the key that a request came with."""
    name: str = connection.scope[_CLIENT]
    return name


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
            if _needs_key(path):
                operation["security"] = [{"bearer": []}, {"header": []}, {}]
                refusals = (UNAUTHORIZED, TOO_MANY_REQUESTS) if method == "post" else (UNAUTHORIZED,)
                for status, refusal in problem_responses(*refusals).items():
                    operation["responses"][str(status)] = refusal


def _needs_key(path: str) -> bool:
    return path.startswith("/v1/") or path == "/metrics"


def _presented_key(scope: Scope) -> str:
    headers = Headers(scope=scope)
    scheme, _, token = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    if (key := headers.get("x-api-key")) is not None:
        return key
    offered = (p.removeprefix(KEY_SUBPROTOCOL) for p in scope.get("subprotocols", ()) if p.startswith(KEY_SUBPROTOCOL))
    return next(offered, "")
