"""An application of the service in the process of the test, without a network."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any, TypeVar

import httpx
from fastapi import FastAPI

from rayfix_service.http.settings import ServiceSettings
from rayfix_service.server.app import create_app

T = TypeVar("T")

JSON = {"content-type": "application/json"}


@asynccontextmanager
async def serving(app: FastAPI) -> AsyncIterator[httpx.AsyncClient]:
    """Start an application, which need not be ready yet, in the loop of a test that is a coroutine.

    Starlette's own test client warns about the httpx it finds, and warnings are errors here.
    """
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as http,
    ):
        yield http


async def until_ready(http: httpx.AsyncClient, seconds: float = 600.0) -> None:
    """Wait until ``/readyz`` is 200."""
    async with asyncio.timeout(seconds):
        while (response := await http.get("/readyz")).status_code != httpx.codes.OK:
            assert "retry-after" in response.headers, response.text  # else it has failed for good
            await asyncio.sleep(0.02)


class RunningApp:
    """An application with a loop of its own, for tests that are no coroutines; as a context, one that is ready.

    Parameters
    ----------
    tables : pathlib.Path
        A table or a folder of tables.
    ready : bool
        Whether the context begins when the application can locate, and not as soon as it answers.
    **settings
        Fields of ``ServiceSettings``.

    Attributes
    ----------
    http : httpx.AsyncClient
        For coroutines that are given to :meth:`run`.
    """

    http: httpx.AsyncClient

    def __init__(self, tables: Path, *, ready: bool = True, **settings: Any) -> None:
        self._app = create_app(tables, ServiceSettings(**settings))
        self._ready = ready
        self._runner = asyncio.Runner()
        self._stack = AsyncExitStack()

    def __enter__(self) -> "RunningApp":
        """Start it."""
        try:
            self.http = self.run(self._stack.enter_async_context(serving(self._app)))
            if self._ready:
                self.wait_until_ready()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Stop it."""
        self._close()

    def _close(self) -> None:
        try:
            self.run(self._stack.aclose())
        finally:
            self._runner.close()

    @property
    def state(self) -> Any:
        """What the application keeps."""
        return self._app.state

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the application's loop."""
        return self._runner.run(coroutine)

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send one request and wait for the answer."""
        return self.run(self.http.request(method, path, **options))

    def get(self, path: str, **options: Any) -> httpx.Response:
        """GET."""
        return self.request("GET", path, **options)

    def post(self, path: str, document: Any = None, **options: Any) -> httpx.Response:
        """POST a document as JSON."""
        return self.request("POST", path, json=document, **options)

    def post_bytes(self, path: str, content: Any, headers: dict[str, str] | None = None) -> httpx.Response:
        """POST a body as it is, as JSON unless the headers say otherwise."""
        return self.request("POST", path, content=content, headers=JSON if headers is None else headers)

    def wait_until_ready(self, seconds: float = 600.0) -> None:
        """Wait until ``/readyz`` is 200."""
        self.run(until_ready(self.http, seconds))

    def wait_for(self, condition: Callable[[], bool], seconds: float = 60.0) -> None:
        """Let the application run until something holds."""
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, "not in time"
            self.run(asyncio.sleep(0.01))
