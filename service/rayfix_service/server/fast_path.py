"""A shortcut past the router for the most frequent route."""

from collections.abc import Awaitable, Callable

from starlette.types import ASGIApp, Receive, Scope, Send

from rayfix_service.http.problems import ProblemError, error_response
from rayfix_tables.errors import ReportError


class FastPath:
    """Middleware that answers one kind of request by itself: POST to a path, without a query.

    FastAPI's resolution of route, parameters and dependencies takes a considerable fraction of the time of a fix. The
    route remains for requests with a query and for the OpenAPI document.

    Parameters
    ----------
    app : ASGI application
        Answers everything else.
    path : str
    answer : callable
        Takes the request's scope and its receive function, and returns the response's body and media type. May raise
        the same exceptions as the routes.
    """

    def __init__(
        self, app: ASGIApp, path: str, answer: Callable[[Scope, Receive], Awaitable[tuple[bytes, str]]]
    ) -> None:
        self._app = app
        self.path = path
        self._answer = answer

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or scope["path"] != self.path or scope["method"] != "POST" or scope["query_string"]:
            await self._app(scope, receive, send)
            return
        scope["route"] = self  # its path is the label of the metrics
        try:
            body, media_type = await self._answer(scope, receive)
        except (ProblemError, ReportError) as error:
            await error_response(error)(scope, receive, send)
            return
        # The same as Starlette's Response, which takes longer to construct.
        headers = [(b"content-length", str(len(body)).encode()), (b"content-type", media_type.encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": body})
