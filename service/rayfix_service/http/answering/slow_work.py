"""Fixes that take long: in a few threads, with a limit on how many wait and for how long."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from rayfix_service.fusion.measurements.report import Angle, Report
from rayfix_service.http.problems import FIX_TIMEOUT, OVERLOADED, ProblemError

Asked = TypeVar("Asked")
T = TypeVar("T")

_MEASUREMENTS_ON_LOOP = 16


def is_slow(report: Report) -> bool:
    """Tell whether a fix may take longer than the event loop should wait.

    An angle picks a few cells of the table; without one, all of them matter. Very many measurements take seconds.
    """
    if len(report.measurements) > _MEASUREMENTS_ON_LOOP:
        return True
    return not any(isinstance(measurement, Angle) for measurement in report.measurements)


class SlowFixes:
    """Threads for slow fixes.

    Parameters
    ----------
    threads : int
        Fixes computed at a time.
    waiting : int
        Fixes that may wait for a thread; more are refused.
    seconds : float
        After which a fix is given up, waiting included.
    """

    def __init__(self, *, threads: int, waiting: int, seconds: float) -> None:
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix="slow-fix")
        self._most = threads + waiting
        self._seconds = seconds
        self._under_way = 0

    async def locate(self, locate: Callable[[Asked], T], report: Asked) -> T:
        """Locate a report in a thread, or do what takes as long with something else that was asked.

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
                "too many reports without angles are under way; try again later, or send angles too",
                headers={"Retry-After": "1"},
            )
        self._under_way += 1
        work = asyncio.get_running_loop().run_in_executor(self._executor, locate, report)
        work.add_done_callback(self._done)
        try:
            # A thread cannot be ended: what is given up keeps its place among those under way until it is done.
            return await asyncio.wait_for(asyncio.shield(work), self._seconds)
        except TimeoutError:
            work.cancel()  # if it has not begun
            raise ProblemError(
                FIX_TIMEOUT, f"the fix took longer than {self._seconds:g} s; send fewer measurements"
            ) from None

    def _done(self, work: "asyncio.Future[T]") -> None:
        self._under_way -= 1
        if not work.cancelled():
            work.exception()  # seen, also of one that was given up

    def close(self) -> None:
        """End the threads."""
        self._executor.shutdown(wait=False, cancel_futures=True)
