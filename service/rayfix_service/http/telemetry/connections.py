"""The connections of one worker: how many there are, which of them wait, and why some were closed."""

import asyncio
import logging
from collections.abc import Callable
from time import monotonic
from typing import Literal, Protocol, get_args

from rayfix_service.http.settings import ConnectionLimits

Closed = Literal["malformed", "head_too_large", "head_too_slow", "body_too_slow", "unread", "full"]
"""Why the service closed a connection by itself."""

CLOSED: tuple[Closed, ...] = get_args(Closed)

NOTE = "rayfix.connection_closed"
"""Key of the lifespan's state: what to call with each :data:`Closed`."""

_SPARE = 32
_TELL_SECONDS = 10.0

_REASONS: dict[Closed, str] = {
    "malformed": "the request was malformed",
    "head_too_large": "the head of the request was too large",
    "head_too_slow": "the head of a request did not come in time",
    "body_too_slow": "the body of a request did not come in time",
    "unread": "the client did not read its answer in time",
    "full": "there were too many connections",
}

_log = logging.getLogger(__name__)


class Droppable(Protocol):
    """A connection that may be closed for another."""

    def drop(self) -> None:
        """Close it at once."""


class Crowd:
    """Keeps the connections of one worker within their number.

    A connection above the limit replaces the one that has waited longest for a request. Where none waits, a few more
    are accepted, so that health checks get an answer.

    Parameters
    ----------
    limits : ConnectionLimits
    """

    def __init__(self, limits: ConnectionLimits) -> None:
        self.limits = limits
        self._waiting: dict[Droppable, None] = {}
        self._spare: dict[Droppable, None] = {}
        self._untold: dict[Closed, int] = {}
        self._told_at = -_TELL_SECONDS

    def enter(self, connection: Droppable, count: int) -> bool:
        """Accept a connection, the ``count``-th; return whether it is above the limit and none was closed for it."""
        if count - len(self._spare) > self.limits.connections:
            if self._waiting:
                self._drop_oldest(self._waiting)
            else:
                if len(self._spare) >= _SPARE:
                    self._drop_oldest(self._spare)
                self._spare[connection] = None
                return True
        self._waiting[connection] = None
        return False

    def wait(self, connection: Droppable) -> None:
        """Note that a connection waits for a request."""
        if connection not in self._spare:
            self._waiting[connection] = None

    def work(self, connection: Droppable) -> None:
        """Note that a connection has a request."""
        self._waiting.pop(connection, None)

    def leave(self, connection: Droppable) -> None:
        """Note that a connection has ended, or is no longer for requests."""
        self._waiting.pop(connection, None)
        self._spare.pop(connection, None)

    def note(self, reason: Closed, figure: Callable[[Closed], None] | None) -> None:
        """Count a connection that the service closed; the log has a line for many."""
        if figure is not None:
            figure(reason)
        self._untold[reason] = self._untold.get(reason, 0) + 1
        now = monotonic()
        if now - self._told_at >= _TELL_SECONDS:
            self._told_at = now
            asyncio.get_running_loop().call_later(0.5, self._tell)

    def _tell(self) -> None:
        told, self._untold = self._untold, {}
        for reason, number in told.items():
            _log.warning("%d connection%s closed: %s", number, "" if number == 1 else "s", _REASONS[reason])

    def _drop_oldest(self, connections: dict[Droppable, None]) -> None:
        oldest = next(iter(connections))
        del connections[oldest]
        oldest.drop()
