"""How long the machine's other work kept processes waiting for a processor that were ready to run."""

from contextlib import suppress
from pathlib import Path

import psutil


class HeldUp:
    """Sums the time that a process and its descendants have waited for a processor.

    Linux counts it for each thread (``/proc/PID/schedstat``); the main threads are looked at, on which a start depends.

    Parameters
    ----------
    pid : int
    whole : bool
        Whether to count from the process's start, and not from now.
    """

    def __init__(self, pid: int, *, whole: bool = False) -> None:
        self._pid = pid
        self._before: dict[int, float] = {}
        self._last: dict[int, float] = {}
        self.look()
        if not whole:
            self._before = dict(self._last)

    def look(self) -> None:
        """Take in the present figures; to be called often, since those of a process end with it."""
        with suppress(psutil.NoSuchProcess):
            below = psutil.Process(self._pid).children(recursive=True)
            for pid in (self._pid, *(child.pid for child in below)):
                with suppress(OSError):
                    self._last[pid] = int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9

    def seconds(self) -> float:
        """Return the wait of the process and the longest of one of its descendants, s.

        No more than these two waits one after the other is sure to have made anything late.
        """
        waits = {pid: last - self._before.get(pid, 0.0) for pid, last in self._last.items()}
        own = waits.pop(self._pid, 0.0)
        return own + max(waits.values(), default=0.0)
