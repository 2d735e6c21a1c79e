"""The path below which a proxy offers the service."""

import re

from starlette.types import ASGIApp, Receive, Scope, Send

from rayfix_service.http.headers import header

PREFIX = re.compile(r"(?:/[A-Za-z0-9_~-][A-Za-z0-9._~-]*){1,8}")
"""What a prefix may look like: plain segments, none of which begins with a dot."""

_MOST_LETTERS = 200
_PREFIX = "rayfix.prefix"


def is_prefix(text: str) -> bool:
    """Tell whether a text is fit for a prefix, such as ``/rayfix``."""
    return len(text) <= _MOST_LETTERS and PREFIX.fullmatch(text) is not None


class Prefix:
    """Middleware that takes the prefix off a path, before anything else looks at it.

    So access control, routes and figures know one form of each path. A proxy may pass requests on with the prefix or
    without it. It serves no other path than without it, so that a wrong prefix lets nobody in anywhere.

    Parameters
    ----------
    app : ASGI application
    root_path : str
        The prefix, empty for none.
    trusts_header : bool
        Whether ``X-Forwarded-Prefix`` names the prefix, to be stated in the OpenAPI document, where ``root_path`` is
        empty. Only for services that nobody reaches but through a proxy that sets the header.
    """

    def __init__(self, app: ASGIApp, *, root_path: str, trusts_header: bool) -> None:
        self._app = app
        self._root_path = root_path
        self._trusts_header = trusts_header

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] in ("http", "websocket"):
            prefix = self._root_path
            if not prefix and self._trusts_header:
                said = (header(scope, b"x-forwarded-prefix") or "").rstrip("/")
                prefix = said if is_prefix(said) else ""
            scope[_PREFIX] = prefix
            if self._root_path and scope["type"] == "http" and scope["path"] == self._root_path:
                await _to_folder(prefix, scope, send)
                return
            if self._root_path and scope["path"].startswith(f"{self._root_path}/"):
                # In place: the middlewares around this one note the route, which the router adds to this scope.
                scope["path"] = scope["path"].removeprefix(self._root_path)
                raw = scope.get("raw_path")
                if raw is not None:
                    scope["raw_path"] = raw.removeprefix(self._root_path.encode())
        await self._app(scope, receive, send)


async def _to_folder(prefix: str, scope: Scope, send: Send) -> None:
    """Send a browser to the folder: the page there names its files relative to it."""
    query = f"?{scope['query_string'].decode('latin-1')}" if scope["query_string"] else ""
    headers = [(b"location", f"{prefix}/{query}".encode("latin-1")), (b"content-length", b"0")]
    await send({"type": "http.response.start", "status": 308, "headers": headers})
    await send({"type": "http.response.body", "body": b""})


def prefix_of(scope: Scope) -> str:
    """Return the prefix below which the client sees the service, empty for none."""
    prefix: str = scope.get(_PREFIX, "")
    return prefix
