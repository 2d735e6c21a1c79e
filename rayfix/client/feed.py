"""The feed of fixes as a client sees it: events out of lines, and when to listen again."""

import json
from random import Random

from rayfix.client.calls import problem
from rayfix.client.events import EventReader
from rayfix.client.models import FixEvent, fix_event
from rayfix.client.retries import RetryPolicy, is_temporary
from rayfix.errors import AnswerError, UnreachableError

SILENCE_SECONDS = 45.0
"""The service writes something every 15 s; after this long without, the connection is lost."""


class Feed:
    """What both clients do with the lines of a feed, and with its end.

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
        """Begin with the lines of a new connection."""
        self._reader = EventReader()

    def take(self, line: str) -> FixEvent | None:
        """Take a line; returns the fix that it ends.

        Raises
        ------
        AnswerError
            When an event is none of this service's.
        """
        self._attempt = 0
        event = self._reader.take(line)
        if event is None or event.name != "fix":
            return None
        try:
            return fix_event(json.loads(event.data))
        except (KeyError, TypeError, ValueError, AttributeError):
            raise AnswerError("the feed tells of something that is no fix; is the address right?") from None

    def refused(self, status: int, body: bytes, retry_after: str | None) -> float:
        """Return the pause after an answer that is no feed, s.

        Raises
        ------
        ClientError
            When trying again will not help, or patience has ended.
        """
        if is_temporary(status):
            return self.lost(f"status {status}", retry_after)
        try:
            document = json.loads(body)
        except ValueError:
            document = None
        raise problem(document, status)

    def lost(self, reason: str, retry_after: str | None = None) -> float:
        """Return the pause after which to listen again, s.

        Raises
        ------
        UnreachableError
            When patience has ended.
        """
        self._attempt += 1
        pause = self._policy.pause(self._attempt, self._random, retry_after)
        if pause is None:
            raise UnreachableError(f"the feed is lost ({reason}); is the service still there?")
        return pause
