"""Giving freed memory back to the system.

The C library keeps what the arrays of slow fixes have freed, up to 64 MiB for each thread that made any, and each fix
that is costlier than those before adds to it. A service would look as if it leaked.
"""

import asyncio
import ctypes
from collections.abc import Callable

_AFTER_SECONDS = 1.0


def give_back() -> None:
    """Give the system all whole pages that are free, within some milliseconds; for glibc, a no-op elsewhere."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)  # without the interpreter's lock


class FreedMemory:
    """Gives memory back a while after work that needed much, so at most once in that time.

    Parameters
    ----------
    give_back : callable
        What does it, in a thread.
    seconds : float
        From the work to its call.
    """

    def __init__(self, give_back: Callable[[], None] = give_back, *, seconds: float = _AFTER_SECONDS) -> None:
        self._give_back = give_back
        self._seconds = seconds
        self._timer: asyncio.TimerHandle | None = None

    def soon(self) -> None:
        """Have it done soon; to be called on the event loop, after the work."""
        if self._timer is None:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(self._seconds, self._due, loop)

    def _due(self, loop: asyncio.AbstractEventLoop) -> None:
        self._timer = None
        loop.run_in_executor(None, self._give_back)

    def close(self) -> None:
        """Do it no more."""
        if self._timer is not None:
            self._timer.cancel()
