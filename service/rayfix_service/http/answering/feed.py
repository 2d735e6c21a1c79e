"""The feed of fixes: every fix is sent to all listeners."""

import asyncio
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rayfix_service.http.settings import FeedLimits

_RELAY_BYTES = 32 << 20
"""Bytes of fixes that wait for another worker, which receives them for all of its listeners."""

QUEUE_LENGTH = 256
"""Fixes that wait for a listener; of one that reads more slowly, the oldest are dropped."""


@dataclass(frozen=True, kw_only=True)
class FixEvent:
    """A fix, and the report that it answers.

    Attributes
    ----------
    number : int
        Counts the events of this process.
    table : str
        Name of the table that answered.
    target_id : str or None
        Target of the report.
    data : bytes
        One line of JSON with the keys ``table``, ``report`` and ``fix``.
    """

    number: int
    table: str
    target_id: str | None
    data: bytes


class Subscription:
    """The queue of one listener.

    Parameters
    ----------
    table, target_id : str, optional
        The only table and the only target whose fixes are wanted.
    own : bool
        Whether only fixes of this process are wanted.
    backlog_bytes : int
        Beyond which the oldest of several waiting events are dropped.
    """

    def __init__(
        self,
        *,
        table: str | None = None,
        target_id: str | None = None,
        own: bool = False,
        backlog_bytes: int = FeedLimits.backlog_bytes,
    ) -> None:
        self.own = own
        self._most = backlog_bytes
        self._length = 0
        self._table = table
        self._target_id = target_id
        self._events: deque[FixEvent] = deque()
        self._wake = asyncio.Event()
        self._dropped = 0
        self.closed = False

    def put(self, event: FixEvent) -> None:
        """Queue an event, if it is of the table and the target."""
        if self._table not in (None, event.table) or self._target_id not in (None, event.target_id):
            return
        self._events.append(event)
        self._length += len(event.data)
        while len(self._events) > QUEUE_LENGTH or (self._length > self._most and len(self._events) > 1):
            self._length -= len(self._events.popleft().data)
            self._dropped += 1
        self._wake.set()

    def close(self) -> None:
        """End the subscription; queued events may still be taken."""
        self.closed = True
        self._wake.set()

    async def wait(self, seconds: float) -> None:
        """Wait until an event is queued, the subscription is closed, or the time is over."""
        try:
            async with asyncio.timeout(seconds):
                await self._wake.wait()
        except TimeoutError:
            pass

    def take(self) -> tuple[int, list[FixEvent]]:
        """Take how many events were dropped since the last time, and those that are left."""
        dropped, events = self._dropped, list(self._events)
        self._dropped = self._length = 0
        self._events.clear()
        if not self.closed:
            self._wake.clear()
        return dropped, events


class FixFeed:
    """Distributes the fixes of one process to its listeners, within one event loop.

    Parameters
    ----------
    limits : FeedLimits, optional
    """

    def __init__(self, limits: FeedLimits | None = None) -> None:
        self._limits = limits or FeedLimits()
        self._subscriptions: set[Subscription] = set()
        self._count = 0
        self._closed = False

    @property
    def num_listeners(self) -> int:
        """Number of listeners to the fixes of all processes."""
        return sum(not subscription.own for subscription in self._subscriptions)

    @property
    def is_full(self) -> bool:
        """Whether there may be no more listeners."""
        return self.num_listeners >= self._limits.listeners

    @contextmanager
    def subscribe(
        self, *, table: str | None = None, target_id: str | None = None, own: bool = False
    ) -> Iterator[Subscription]:
        """Listen to all fixes, or to those of one table or target, or of this process."""
        most = _RELAY_BYTES if own else self._limits.backlog_bytes
        subscription = Subscription(table=table, target_id=target_id, own=own, backlog_bytes=most)
        if self._closed:
            subscription.close()
        self._subscriptions.add(subscription)
        try:
            yield subscription
        finally:
            self._subscriptions.remove(subscription)

    def publish(self, table: str, target_id: str | None, make_data: Callable[[], bytes]) -> None:
        """Publish a fix of this process; its JSON is only written where there is a listener."""
        if self._subscriptions:
            self._put(self._event(table, target_id, make_data()), self._subscriptions)

    def pass_on(self, table: str, target_id: str | None, data: bytes) -> None:
        """Publish a fix of another process."""
        self._put(self._event(table, target_id, data), {s for s in self._subscriptions if not s.own})

    def _event(self, table: str, target_id: str | None, data: bytes) -> FixEvent:
        self._count += 1
        return FixEvent(number=self._count, table=table, target_id=target_id, data=data)

    def _put(self, event: FixEvent, subscriptions: set[Subscription]) -> None:
        for subscription in subscriptions:
            subscription.put(event)

    def close(self) -> None:
        """End all subscriptions, and further ones at once."""
        self._closed = True
        for subscription in self._subscriptions:
            subscription.close()
