"""How many reports a client may send: a token bucket for each."""

import mmap
from collections.abc import Callable
from time import monotonic

_SLOTS = 4096
_NEAR = 16


class Accounts:
    """When the bucket of each client is full again, in memory common to all processes forked from this one.

    It is a hash table: a client has one of the slots from the hash of its name on, which is the same in all these
    processes; a slot whose bucket is full is free. There is no lock, so that a process that is killed leaves none
    behind: where two charge one client at the same moment, one charge may be dropped.
    """

    def __init__(self) -> None:
        memory = memoryview(mmap.mmap(-1, 2 * 8 * _SLOTS))
        self._clients = memory[: 8 * _SLOTS].cast("q")
        self._full_at = memory[8 * _SLOTS :].cast("d")

    def full_at(self, client: str, now: float) -> float:
        """Return when the client's bucket is full, ``now`` where it is."""
        return max(self._full_at[self._slot(hash(client), now)], now)

    def set_full_at(self, client: str, time: float, now: float) -> None:
        """Note when the client's bucket will be full."""
        number = hash(client)
        slot = self._slot(number, now)
        self._clients[slot] = number
        self._full_at[slot] = time

    def _slot(self, number: int, now: float) -> int:
        """Slot of a client, or else a free one; where none is free, the first, which is another client's too."""
        slots = [slot % _SLOTS for slot in range(number, number + _NEAR)]
        free = None
        for slot in slots:
            if self._full_at[slot] <= now:
                free = slot if free is None else free
            elif self._clients[slot] == number:
                return slot
        return slots[0] if free is None else free


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
        Returns seconds, the same in all processes with these accounts.
    accounts : Accounts, optional
        New ones by default.
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
