"""A service with an event loop that writes the duration of each callback to memory that another process reads.

As a program it takes a table and a file of at least 32 bytes, and serves the table with one worker. The loop is
asyncio's own: that of uvloop, which the service has otherwise, calls the same callbacks and has no place to measure
them. With a third argument, a file, it writes there what callbacks do after :data:`HELD_SECONDS` of processor time.
"""

import asyncio.events
import gc
import mmap
import signal
import sys
import traceback
from pathlib import Path
from time import perf_counter, thread_time
from types import FrameType
from typing import Any

from rayfix_service.server.server import serve

HELD_SECONDS = 0.02

_LOOK_SECONDS = 0.005

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


def watch(times: LoopTimes, stacks: Path | None = None) -> None:
    """Have every callback of asyncio's loops in this process measured, and stacks of long ones written to a file."""
    run = asyncio.events.Handle._run
    begin, clock, shown = 0.0, 0.0, True

    def measured(self: Any) -> None:
        nonlocal begin, clock, shown
        begin, clock, shown = thread_time(), perf_counter(), False
        try:
            run(self)
        finally:
            shown = True
            times.add(thread_time() - begin, perf_counter() - clock)

    asyncio.events.Handle._run = measured  # type: ignore[method-assign]
    if stacks is None:
        return
    file = stacks.open("w")

    def look(_: int, frame: FrameType | None) -> None:
        # Python calls this in the loop's thread, between two steps of the callback. Once: writing takes time as well.
        nonlocal shown
        if not shown and (seconds := thread_time() - begin) > HELD_SECONDS:
            shown = True
            file.write(f"after {1e3 * seconds:.0f} ms, {1e3 * (perf_counter() - clock):.0f} ms by the clock:\n")
            file.writelines(traceback.format_stack(frame))
            file.flush()

    def collected(phase: str, found: dict[str, int]) -> None:
        # Python finds no time to call the above while it collects.
        if phase == "start":
            started[0] = thread_time()
        elif (seconds := thread_time() - started[0]) > HELD_SECONDS / 4.0:
            file.write(f"a collection of generation {found['generation']} took {1e3 * seconds:.0f} ms\n")
            file.flush()

    started = [0.0]
    gc.callbacks.append(collected)
    signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, _LOOK_SECONDS, _LOOK_SECONDS)


if __name__ == "__main__":
    sys.modules["uvloop"] = None  # type: ignore[assignment]
    watch(LoopTimes(Path(sys.argv[2])), Path(sys.argv[3]) if sys.argv[3:] else None)
    serve(sys.argv[1], port=0)
