"""A service with an event loop that writes the duration of each callback to memory that another process reads.

As a program it takes a table and a file of at least 32 bytes, and serves the table with one worker. The loop is
asyncio's own: uvloop's, which the service normally uses, calls the same callbacks but has no hook for the measurement.
"""

import asyncio.events
import mmap
import sys
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

from rayfix_service.server.server import serve

_NUMBERS = 4


class LoopTimes:
    """The longest times of callbacks since the last reset, s.

    Parameters
    ----------
    path : pathlib.Path
        File that both processes map.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists() or path.stat().st_size < 8 * _NUMBERS:
            path.write_bytes(bytes(8 * _NUMBERS))
        with path.open("r+b") as file:
            self._numbers = memoryview(mmap.mmap(file.fileno(), 8 * _NUMBERS)).cast("d")

    def add(self, processor: float, wall: float) -> None:
        """Take in a callback."""
        if processor > self._numbers[0]:
            self._numbers[0] = processor
        if wall > self._numbers[1]:
            self._numbers[1] = wall

    def take(self) -> tuple[float, float]:
        """Return the longest processor time of the loop's thread and the longest time by the clock, and begin anew."""
        found = self._numbers[0], self._numbers[1]
        self._numbers[0] = self._numbers[1] = 0.0
        return found


def watch(times: LoopTimes) -> None:
    """Have every callback of asyncio's loops in this process measured."""
    run = asyncio.events.Handle._run

    def measured(self: Any) -> None:
        begin, clock = thread_time(), perf_counter()
        try:
            run(self)
        finally:
            times.add(thread_time() - begin, perf_counter() - clock)

    asyncio.events.Handle._run = measured  # type: ignore[method-assign]


if __name__ == "__main__":
    sys.modules["uvloop"] = None  # type: ignore[assignment]
    watch(LoopTimes(Path(sys.argv[2])))
    serve(sys.argv[1], port=0)
