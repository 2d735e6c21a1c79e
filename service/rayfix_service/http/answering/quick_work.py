"""Fixes that are made on the event loop, and end there when they take longer than estimated.

The estimate of a fix is made from its report alone, and some reports take ten times as long. The event loop cannot end
its own work; a thread of this module watches it and stops a fix that holds the loop for too long. The caller then
makes it anew in a thread for slow fixes.
"""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from rayfix_service.fusion.stopping import Stop

T = TypeVar("T")

_LOOKS = 2
"""Looks at the work in the time that it may take."""

_IDLE_LOOKS = 100
"""Looks at no work after which the thread sleeps until there is some."""


class QuickWork:
    """Does work at once, with a limit on its time.

    Parameters
    ----------
    seconds : float
        After which work is stopped; it may take half as long again until that is seen.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._current: tuple[float, Stop] | None = None
        self._wanted = threading.Event()
        self._closed = False
        self._thread: threading.Thread | None = None

    def do(self, work: Callable[[Stop], T]) -> T:
        """Do work of one thread at a time.

        Raises
        ------
        FixStoppedError
            When it took too long.
        """
        if self._thread is None:  # here, since a process that is forked later would be without the thread
            self._thread = threading.Thread(target=self._watch, name="quick-fix-watch", daemon=True)
            self._thread.start()
        stop = Stop()
        self._current = time.monotonic(), stop
        if not self._wanted.is_set():
            self._wanted.set()
        try:
            return work(stop)
        finally:
            self._current = None

    def close(self) -> None:
        """End the thread."""
        self._closed = True
        self._wanted.set()

    def _watch(self) -> None:
        while self._wanted.wait() and not self._closed:
            idle = 0
            while idle < _IDLE_LOOKS and not self._closed:
                time.sleep(self._seconds / _LOOKS)
                current = self._current
                idle = 0 if current else idle + 1
                if current and time.monotonic() - current[0] >= self._seconds:
                    current[1].set()
            self._wanted.clear()
            if self._current or self._closed:  # begun between the last look and the clearing
                self._wanted.set()
