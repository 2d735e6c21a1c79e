"""The client's side of the feed of fixes: parsing of events, and reconnection."""

import json
from random import Random

from rayfix.client.calls import problem
from rayfix.client.events import EventReader
from rayfix.client.models import FixEvent, fix_event
from rayfix.client.retries import RetryPolicy, is_temporary
from rayfix.errors import AnswerError, UnreachableError

SILENCE_SECONDS = 45.0
"""The service writes at least every 15 s; after this time without data, the connection counts as lost."""


class Feed:
    """Handles the lines of a feed and its end, for both clients.

    Parameters
    ----------
    policy : RetryPolicy
    random : random.Random
    """

    def __init__(self, policy: RetryPolicy, random: Random) -> None:
        self._policy = policy
        self._random = random
        self._attempt = 0
        self._reader = EventReader()

    def opened(self) -> None:
        """Begin a new connection."""
        self._reader = EventReader()

    def take(self, line: str) -> FixEvent | None:
        """Take a line and return the fix that it completes, if any.

        Raises
        ------
        AnswerError
            When an event cannot be read.
        """
        self._attempt = 0
        event = self._reader.take(line)
        if event is None or event.name != "fix":
            return None
        try:
            return fix_event(json.loads(event.data))
        except (KeyError, TypeError, ValueError, AttributeError):
            raise AnswerError("an event of the feed is not a fix; check the address") from None

    def refused(self, status: int, body: bytes, retry_after: str | None) -> float:
        """Return the pause after an answer that is not a feed, s.

        Raises
        ------
        ClientError
            When another attempt cannot help, or all attempts have failed.
        """
        if is_temporary(status):
            return self.lost(f"status {status}", retry_after)
        try:
            document = json.loads(body)
        except ValueError:
            document = None
        raise problem(document, status)

    def lost(self, reason: str, retry_after: str | None = None) -> float:
        """Return the pause before the next connection, s.

        Raises
        ------
        UnreachableError
            When all attempts have failed.
        """
        self._attempt += 1
        pause = self._policy.pause(self._attempt, self._random, retry_after)
        if pause is None:
            raise UnreachableError(f"the feed is lost ({reason}); is the service still there?")
        return pause
