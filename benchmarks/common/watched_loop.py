"""A service with an event loop that writes the duration of each callback to memory that another process reads.

As a program it takes a table and a file of at least 32 bytes, and serves the table with one worker. The loop is
asyncio's own: that of uvloop, which the service has otherwise, calls the same callbacks and has no place to measure
them. With a third argument, a file, it writes there the stacks of all threads whenever the interpreter's lock was held
for :data:`HELD_SECONDS`, or the machine let nothing of this process run.
"""

import asyncio.events
import faulthandler
import mmap
import sys
import threading
import time
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

from rayfix_service.server.server import serve

HELD_SECONDS = 0.05

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


def watch_interpreter(path: Path) -> None:
    """Write the stacks of all threads whenever none could run Python code for some time."""

    def keep() -> None:
        with path.open("w") as file:
            while True:  # it is a thread without Python that writes, unless this one is in time
                faulthandler.dump_traceback_later(HELD_SECONDS, file=file)
                time.sleep(0.005)

    threading.Thread(target=keep, daemon=True).start()


if __name__ == "__main__":
    sys.modules["uvloop"] = None  # type: ignore[assignment]
    watch(LoopTimes(Path(sys.argv[2])))
    if sys.argv[3:]:
        watch_interpreter(Path(sys.argv[3]))
    serve(sys.argv[1], port=0)
