"""The connections of one worker: their number, which of them are idle, and why the service closed some."""

import asyncio
import logging
from collections.abc import Callable
from time import monotonic
from typing import Literal, Protocol, get_args

from rayfix_service.http.settings import ConnectionLimits

Closed = Literal["malformed", "head_too_large", "head_too_slow", "body_too_slow", "unread", "full"]
"""Reason why the service closed a connection."""

CLOSED: tuple[Closed, ...] = get_args(Closed)

NOTE = "rayfix.connection_closed"
"""Key in the lifespan's state of the function that is called with each :data:`Closed`."""

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
    """A connection that may be closed to make room for another."""

    def drop(self) -> None:
        """Close it at once."""


class Crowd:
    """Limits the number of connections of one worker.

    A connection above the limit replaces the one that has been idle longest. If none is idle, a few more connections
    are accepted to answer health checks.

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
        """Accept the ``count``-th connection; return whether it is above the limit and no other was closed for it."""
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
        """Record that a connection waits for a request."""
        if connection not in self._spare:
            self._waiting[connection] = None

    def work(self, connection: Droppable) -> None:
        """Record that a connection has a request."""
        self._waiting.pop(connection, None)

    def leave(self, connection: Droppable) -> None:
        """Record that a connection has ended or has become a web socket."""
        self._waiting.pop(connection, None)
        self._spare.pop(connection, None)

    def note(self, reason: Closed, figure: Callable[[Closed], None] | None) -> None:
        """Count a connection that the service closed; the log gets one line for many of them."""
        if figure is not None:
            figure(reason)
        self._untold[reason] = self._untold.get(reason, 0) + 1
        now = monotonic()
        if now - self._told_at >= _TELL_SECONDS:
            self._told_at = now
            asyncio.get_running_loop().call_later(0.5, self._log_counts)

    def _log_counts(self) -> None:
        told, self._untold = self._untold, {}
        for reason, number in told.items():
            _log.warning("%d connection%s closed: %s", number, "" if number == 1 else "s", _REASONS[reason])

    def _drop_oldest(self, connections: dict[Droppable, None]) -> None:
        oldest = next(iter(connections))
        del connections[oldest]
        oldest.drop()
