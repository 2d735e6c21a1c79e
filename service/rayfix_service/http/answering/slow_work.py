"""Fixes that take long: in a few threads, with a limit on how many wait and for how long."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Protocol, TypeVar

from rayfix_service.fusion.stopping import FixStoppedError, Stop
from rayfix_service.http.problems import FIX_TIMEOUT, OVERLOADED, ProblemError

Asked_contra = TypeVar("Asked_contra", contravariant=True)
T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Stoppable(Protocol[Asked_contra, T_co]):
    """Work that ends early, by a :class:`FixStoppedError`, once ``stop`` is set."""

    def __call__(self, asked: Asked_contra, /, *, stop: Stop) -> T_co:
        """Do the work."""


class SlowWork:
    """Threads for slow fixes.

    Parameters
    ----------
    threads : int
        Fixes computed at a time.
    waiting : int
        Fixes that may wait for a thread; more are refused.
    seconds : float
        After which a fix is given up, waiting included. Its thread is free again some milliseconds later.
    on_done : callable, optional
        Called on the event loop whenever a thread is free again.
    """

    def __init__(
        self, *, threads: int, waiting: int, seconds: float, on_done: Callable[[], None] | None = None
    ) -> None:
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix="slow-fix")
        self._most = threads + waiting
        self._seconds = seconds
        self._under_way = 0
        self._on_done = on_done

    @property
    def under_way(self) -> int:
        """Fixes that wait for a thread or have one, those included that are given up and have not stopped yet."""
        return self._under_way

    async def run(self, work: Callable[[], T]) -> T:
        """Do work in a thread that cannot be stopped, but takes well below a second.

        Raises
        ------
        ProblemError
            When too many wait, or the time is over.
        """

        def do(_: None, /, *, stop: Stop) -> T:
            stop.check()
            return work()

        return await self.locate(do, None)

    async def locate(self, locate: Stoppable[Asked_contra, T], report: Asked_contra, *, spent: float = 0.0) -> T:
        """Locate a report in a thread, or do other work of similar length.

        Parameters
        ----------
        locate : callable
        report : object
            What is given to it.
        spent : float
            Time that the same request has had already, s; the limit is for all of it.

        Raises
        ------
        ProblemError
            When too many wait, or the time is over.
        ReportError
            When the report cannot be used.
        """
        if self._under_way >= self._most:
            raise ProblemError(
                OVERLOADED,
                "too many reports that take long are under way; try again later, or send fewer measurements and "
                "narrower angles",
                headers={"Retry-After": "1"},
            )
        self._under_way += 1
        stop = Stop()
        loop = asyncio.get_running_loop()
        computed = self._executor.submit(partial(locate, report, stop=stop))
        # Of the thread's work and not of the task that waits for it, which may end before: it is a thread that is busy.
        computed.add_done_callback(lambda _: _soon(loop, self._done))
        work = asyncio.wrap_future(computed, loop=loop)
        work.add_done_callback(_retrieved)
        try:
            # A thread cannot be ended: what is given up counts as under way until it has stopped.
            return await asyncio.wait_for(asyncio.shield(work), max(self._seconds - spent, 0.0))
        except (TimeoutError, FixStoppedError):
            raise ProblemError(
                FIX_TIMEOUT, f"the fix took longer than {self._seconds:g} s; send fewer measurements"
            ) from None
        finally:
            # Also when the request was cancelled.
            stop.set()
            computed.cancel()  # if it has not begun

    def _done(self) -> None:
        self._under_way -= 1
        if self._on_done is not None:
            self._on_done()

    def close(self) -> None:
        """End the threads."""
        self._executor.shutdown(wait=False, cancel_futures=True)


def _soon(loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
    with suppress(RuntimeError):  # the loop is closed
        loop.call_soon_threadsafe(call)


def _retrieved(work: "asyncio.Future[T]") -> None:
    """Take the error of work that was given up."""
    if not work.cancelled():
        work.exception()
