"""Retries of requests and the pauses between them."""

from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from random import Random
from typing import Annotated

from rayfix_tables.validation.limits import Limits, check_limits

_AGAIN = frozenset({429, 502, 503, 504})
"""Statuses of a service that is busy, starting, or behind a proxy that cannot reach it."""


@dataclass(frozen=True, kw_only=True)
class RetryPolicy:
    """How often requests are repeated, and after which pauses.

    Sending a report twice is harmless: fixes are stateless, and tracks ignore a second report of the same time.

    Attributes
    ----------
    attempts : int
        Maximum number of attempts; 1 turns retries off.
    first_pause, longest_pause : float, s
        The pause before attempt n + 1 is drawn uniformly between 0 and ``first_pause`` times 2 to the power n - 1, or
        the longest pause if that is less. Clients that lost the service together then do not return together ("full
        jitter": M. Brooker, "Exponential backoff and jitter", 2015).
    longest_retry_after : float, s
        A request is not repeated if the service demands a longer pause than this.

    Raises
    ------
    SettingsError
        When a value is out of its range.
    """

    attempts: Annotated[int, Limits(least=1)] = 5
    first_pause: Annotated[float, Limits(least=0.0)] = 0.2
    longest_pause: Annotated[float, Limits(least=0.0)] = 10.0
    longest_retry_after: Annotated[float, Limits(least=0.0)] = 60.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_limits(self)

    def pause(self, attempt: int, random: Random, retry_after: str | None = None) -> float | None:
        """Return the pause after an attempt, counted from 1, in seconds; None after the last one.

        Parameters
        ----------
        attempt : int
        random : random.Random
        retry_after : str, optional
            The header of that name: the pause is at least as long.
        """
        if attempt >= self.attempts:
            return None
        least = seconds_of(retry_after) if retry_after is not None else 0.0
        if least > self.longest_retry_after:
            return None
        drawn = random.uniform(0.0, min(self.longest_pause, self.first_pause * 2.0 ** (attempt - 1)))
        return least + drawn


NO_RETRIES = RetryPolicy(attempts=1)


def is_temporary(status: int) -> bool:
    """Whether the same request may succeed later, given the status."""
    return status in _AGAIN


def seconds_of(retry_after: str) -> float:
    """Read a Retry-After header, seconds or a date (RFC 9110, 10.2.3); 0 for anything else."""
    text = retry_after.strip()
    if text.isdecimal():
        return float(text)
    try:
        moment = parsedate_to_datetime(text)
    except ValueError:
        return 0.0
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return max(0.0, (moment - datetime.now(UTC)).total_seconds())
