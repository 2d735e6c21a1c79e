"""How many reports a client may send: a token bucket for each."""

from collections.abc import Callable
from time import monotonic


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
        Returns seconds.
    """

    def __init__(self, per_second: float, burst: float, clock: Callable[[], float] = monotonic) -> None:
        self._per_second = per_second
        self._burst = burst
        self._clock = clock
        self._buckets: dict[str, tuple[float, float]] = {}

    def seconds_to_wait(self, client: str) -> float:
        """Return how long a client has to wait for its next report, 0 if it need not."""
        return max(0.0, (1.0 - self._tokens(client)) / self._per_second)

    def charge(self, client: str, reports: int = 1) -> None:
        """Take tokens for a number of reports."""
        self._buckets[client] = (self._tokens(client) - reports, self._clock())
        if len(self._buckets) > _MOST_BUCKETS:
            # A full bucket says nothing, so that what is kept is bounded by the clients of the last moments.
            self._buckets = {name: bucket for name, bucket in self._buckets.items() if self._tokens(name) < self._burst}

    def _tokens(self, client: str) -> float:
        tokens, since = self._buckets.get(client, (self._burst, 0.0))
        return min(self._burst, tokens + self._per_second * (self._clock() - since))


_MOST_BUCKETS = 4096
