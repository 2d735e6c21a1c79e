"""Joining the measurements of one transmission by several stations."""

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from typing import Generic, TypeVar

T = TypeVar("T")

Key = tuple[str, int | None]

_SLACK = 1000
"""A heap is rebuilt when it has this many more outdated entries than valid ones."""


@dataclass(frozen=True, kw_only=True)
class Transmission(Generic[T]):
    """Measurements of one transmission of one target.

    Attributes
    ----------
    heard : dict
        Measurement of each station, by the station's name, in the order of arrival.
    started : float, s
        When the first measurement arrived.
    """

    target: str
    sequence: int | None
    started: float
    heard: dict[str, T] = field(default_factory=dict)


class Joiner(Generic[T]):
    """Collects messages into transmissions, by sequence number where there is one, else by time.

    A transmission ends when `num_stations` have measured it, when one of its stations measures again, or `window`
    seconds after its first message. Later messages of it are dropped. After ten windows, the same sequence number
    starts a new transmission. The time for a message does not grow with the number of earlier messages.

    Parameters
    ----------
    window : float, s
        How long a transmission waits for more stations.
    num_stations : int, optional
        How many stations there are.
    repeats : callable, optional
        Whether a message of a station is its previous one, delivered twice. Such a message is dropped and counted, and
        does not end the transmission.
    most : int, optional
        Largest number of transmissions that are remembered. When there are more, the oldest one ends early.

    Attributes
    ----------
    num_repeated : int
        Messages dropped because they were delivered twice.
    """

    def __init__(
        self,
        *,
        window: float,
        num_stations: int | None = None,
        repeats: Callable[[T, T], bool] | None = None,
        most: int | None = None,
    ) -> None:
        self._window = window
        self._num_stations = num_stations
        self._repeats = repeats
        self._most = most
        self._numbers = count()
        self._open: dict[Key, Transmission[T]] = {}
        self._dues: list[tuple[float, int, Key, Transmission[T]]] = []  # a heap; some have ended since
        self._ended: dict[Key, float] = {}
        self._ended_untils: list[tuple[float, int, Key]] = []  # a heap; some have been replaced since
        self.num_repeated = 0

    def __len__(self) -> int:
        """Transmissions that wait for more stations."""
        return len(self._open)

    def expect(self, num_stations: int) -> None:
        """Set how many stations there are from now on."""
        self._num_stations = num_stations

    def add(self, target: str, station: str, sequence: int | None, message: T, now: float) -> list[Transmission[T]]:
        """Process a message that arrived at `now`, s, and return the transmissions that it ends."""
        ended = self.due(now)
        key = (target, sequence)
        if now < self._ended.get(key, now):
            return ended
        transmission = self._open.get(key)
        if transmission is not None and station in transmission.heard:
            if self._repeats is not None and self._repeats(transmission.heard[station], message):
                self.num_repeated += 1
                return ended
            ended.append(self._open.pop(key))
            transmission = None
        if transmission is None:
            transmission = self._open[key] = Transmission(target=target, sequence=sequence, started=now)
            heapq.heappush(self._dues, (now + self._window, next(self._numbers), key, transmission))
            if len(self._dues) > 2 * len(self._open) + _SLACK:
                self._dues = [due for due in self._dues if self._open.get(due[2]) is due[3]]
                heapq.heapify(self._dues)
        transmission.heard[station] = message
        if self._num_stations is not None and len(transmission.heard) >= self._num_stations:
            ended.append(self._end(key, now))
        elif self._most is not None and len(self._open) > self._most:
            ended.append(self._end(next(iter(self._open)), now))
        return ended

    def due(self, now: float) -> list[Transmission[T]]:
        """End the transmissions whose window has passed at `now`, s, oldest first."""
        while self._ended_untils and self._ended_untils[0][0] <= now:
            until, _, key = heapq.heappop(self._ended_untils)
            if self._ended.get(key) == until:
                del self._ended[key]
        passed = []
        while self._dues and self._dues[0][0] <= now:
            _, number, key, transmission = heapq.heappop(self._dues)
            if self._open.get(key) is transmission:
                passed.append((number, self._end(key, now)))
        return [transmission for _, transmission in sorted(passed, key=lambda one: one[0])]

    def next_due(self) -> float | None:
        """Time at which the next window passes, s."""
        while self._dues and self._open.get(self._dues[0][2]) is not self._dues[0][3]:
            heapq.heappop(self._dues)
        return self._dues[0][0] if self._dues else None

    def flush(self) -> list[Transmission[T]]:
        """End all transmissions, oldest first."""
        ended, self._open, self._dues = list(self._open.values()), {}, []
        return ended

    def _end(self, key: Key, now: float) -> Transmission[T]:
        if key[1] is not None:
            self._ended[key] = until = now + 10.0 * self._window
            heapq.heappush(self._ended_untils, (until, next(self._numbers), key))
            if self._most is not None and len(self._ended) > self._most:
                del self._ended[next(iter(self._ended))]
            if len(self._ended_untils) > 2 * len(self._ended) + _SLACK:
                self._ended_untils = [one for one in self._ended_untils if self._ended.get(one[2]) == one[0]]
                heapq.heapify(self._ended_untils)
        return self._open.pop(key)
