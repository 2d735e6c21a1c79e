"""Giving freed memory back to the system.

glibc has an arena for each thread that allocates much, and each keeps up to 64 MiB of what the arrays of slow fixes
have freed. Every fix that is costlier than those before would add to it, as if the service leaked. With one arena for
all threads, and whole free pages given back a second after such a fix, an idle worker always comes back to the same
size. Fixes take as long as before.
"""

import asyncio
import ctypes
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_AFTER_SECONDS = 1.0
_M_ARENA_MAX = -8  # of glibc's malloc.h


@contextmanager
def one_arena() -> Iterator[None]:
    """Have threads that start in this context, and processes forked in it, allocate from one arena.

    Where the C library is another, or the environment says what its arenas are to be, nothing changes.
    """
    told = "MALLOC_ARENA_MAX" in os.environ or "malloc.arena_max" in os.environ.get("GLIBC_TUNABLES", "")
    if told or not _is_glibc():
        yield
        return
    library = ctypes.CDLL(None)
    library.mallopt(_M_ARENA_MAX, 1)
    try:
        yield
    finally:
        library.mallopt(_M_ARENA_MAX, 0)  # as by default: some for each processor core


def give_back() -> None:
    """Give whole free pages back to the system, which takes some milliseconds; only glibc needs it."""
    if _is_glibc():
        ctypes.CDLL(None).malloc_trim(0)  # without the interpreter's lock


def _is_glibc() -> bool:
    return hasattr(ctypes.CDLL(None), "malloc_trim")


class FreedMemory:
    """Gives memory back a while after work that needed much, and at most once in that time.

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
