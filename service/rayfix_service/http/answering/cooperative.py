"""Long work for one request, in parts between which other requests are answered."""

import asyncio
import logging
from time import monotonic

from starlette.requests import Request

from rayfix_service.http.problems import CONNECTION_ENDED, ProblemError

_LOOK_SECONDS = 0.02

_log = logging.getLogger(__name__)


class Cooperation:
    """Lets other requests run between the parts of one, and checks whether its client is still connected."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self._looked = monotonic()

    async def let_others_run(self) -> None:
        """Let other requests run; to be awaited before each part.

        Raises
        ------
        ProblemError
            When the client has left. One that gave up waiting tends to ask again: do not compute for both.
        """
        await asyncio.sleep(0)
        if monotonic() - self._looked < _LOOK_SECONDS:
            return
        if await self._request.is_disconnected():
            _log.info("%s given up: the client left", self._request.url.path)
            raise ProblemError(CONNECTION_ENDED, "the connection ended before the answer")
        self._looked = monotonic()
