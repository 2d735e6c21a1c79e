"""How many reports a client may send: a token bucket for each."""

import mmap
from collections.abc import Callable
from time import monotonic

_PLACES = 4096
_NEAR = 16


class Accounts:
    """When the bucket of each client is full again, in memory that processes forked from this one share.

    A client stands at one of the places near the hash of its name, which is the same in all these processes; a place
    whose bucket is full says nothing and is free. Nobody takes a lock, so that no process that is killed leaves one
    behind: where two charge one client at the same moment, one charge may be lost.
    """

    def __init__(self) -> None:
        memory = memoryview(mmap.mmap(-1, 2 * 8 * _PLACES))
        self._clients = memory[: 8 * _PLACES].cast("q")
        self._full_at = memory[8 * _PLACES :].cast("d")

    def full_at(self, client: str, now: float) -> float:
        """Return when the client's bucket is full, ``now`` where it is."""
        return max(self._full_at[self._place(hash(client), now)], now)

    def set_full_at(self, client: str, time: float, now: float) -> None:
        """Note when the client's bucket will be full."""
        number = hash(client)
        place = self._place(number, now)
        self._clients[place] = number
        self._full_at[place] = time

    def _place(self, number: int, now: float) -> int:
        """Where a client stands, else where it may; where none is free, it shares its first place with another."""
        places = [place % _PLACES for place in range(number, number + _NEAR)]
        free = None
        for place in places:
            if self._full_at[place] <= now:
                free = place if free is None else free
            elif self._clients[place] == number:
                return place
        return places[0] if free is None else free


class RateLimit:
    """Token buckets by client.

    A bucket fills with ``per_second`` tokens a second up to ``burst``. A report takes one; many at once may take more
    than there are, and the next then waits until the debt is paid.

    Parameters
    ----------
    per_second : float
    burst : float
        At least 1.
    clock : callable
        Returns seconds, the same in all processes that share the accounts.
    accounts : Accounts, optional
        Of its own unless given.
    """

    def __init__(
        self,
        per_second: float,
        burst: float,
        clock: Callable[[], float] = monotonic,
        accounts: Accounts | None = None,
    ) -> None:
        self._per_second = per_second
        self._burst = burst
        self._clock = clock
        self._accounts = accounts or Accounts()

    def seconds_to_wait(self, client: str, *, given: int = 0) -> float:
        """Return how long a client has to wait for its next report, 0 if it need not.

        ``given`` tokens are taken as if they were not charged.
        """
        now = self._clock()
        # A bucket with one token is this long from being full.
        longest = (self._burst - 1.0 + given) / self._per_second
        return max(0.0, self._accounts.full_at(client, now) - now - longest)

    def charge(self, client: str, reports: int = 1) -> None:
        """Take tokens for a number of reports."""
        now = self._clock()
        full_at = self._accounts.full_at(client, now) + reports / self._per_second
        self._accounts.set_full_at(client, full_at, now)
