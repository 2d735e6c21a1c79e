"""Joining what several stations heard of one transmission."""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Transmission(Generic[T]):
    """What stations heard of one transmission of one target.

    Attributes
    ----------
    heard : dict
        What each station heard, by the station's name, in the order of arrival.
    started : float, s
        When the first of it arrived.
    """

    target: str
    sequence: int | None
    started: float
    heard: dict[str, T] = field(default_factory=dict)


class Joiner(Generic[T]):
    """Collects messages into transmissions, by sequence number where there is one, else by time.

    A transmission ends when `num_stations` have been heard, when one of its stations is heard again, or
    `window` seconds after its first message. A message that comes later than that is dropped; a sequence number
    is taken for a new transmission again after ten windows.

    Parameters
    ----------
    window : float, s
        How long a transmission waits for more stations.
    num_stations : int, optional
        How many stations there are.
    """

    def __init__(self, *, window: float, num_stations: int | None = None) -> None:
        self._window = window
        self._num_stations = num_stations
        self._open: dict[tuple[str, int | None], Transmission[T]] = {}
        self._ended: dict[tuple[str, int | None], float] = {}

    def add(self, target: str, station: str, sequence: int | None, message: T, now: float) -> list[Transmission[T]]:
        """Take a message that arrived at `now`, s; returns the transmissions that it ends."""
        ended = self.due(now)
        key = (target, sequence)
        if now < self._ended.get(key, now):
            return ended
        transmission = self._open.get(key)
        if transmission is not None and station in transmission.heard:
            ended.append(self._open.pop(key))
            transmission = None
        if transmission is None:
            transmission = self._open[key] = Transmission(target=target, sequence=sequence, started=now)
        transmission.heard[station] = message
        if len(transmission.heard) == self._num_stations:
            ended.append(self._end(key, now))
        return ended

    def due(self, now: float) -> list[Transmission[T]]:
        """End the transmissions whose window has passed at `now`, s."""
        self._ended = {key: until for key, until in self._ended.items() if now < until}
        return [self._end(key, now) for key, t in list(self._open.items()) if now >= t.started + self._window]

    def next_due(self) -> float | None:
        """Time at which the next window passes, s."""
        return min((t.started + self._window for t in self._open.values()), default=None)

    def flush(self) -> list[Transmission[T]]:
        """End all transmissions, oldest first."""
        ended, self._open = list(self._open.values()), {}
        return ended

    def _end(self, key: tuple[str, int | None], now: float) -> Transmission[T]:
        if key[1] is not None:
            self._ended[key] = now + 10.0 * self._window
        return self._open.pop(key)
