"""One process at a time compiles kernels or reads compiled ones.

numba numbers the files of a kernel's compiled signatures. Two processes that find none number theirs alike, so that the
index of one may name the code of the other: a process that reads it runs a kernel with arguments of other types, and
may crash. numba says when it takes and releases its compiler's lock, for a compilation and for a look into its
cache; here a lock on a file goes with it. What one process has compiled the others find afterwards.
"""

import contextlib
import fcntl
import os
import threading
from pathlib import Path

from numba.core import event

from rayfix_tables.gaussians.kernel_cache import kernel_folders

_NAME = "kernels.lock"


class KernelLock(event.Listener):  # type: ignore[misc]
    """Holds a lock on a file while numba holds its own.

    Parameters
    ----------
    folders : pathlib.Path
        The file is in the first where it can be written. Where it can in none, processes do not wait for each other.
    """

    def __init__(self, *folders: Path) -> None:
        self._paths = [folder / _NAME for folder in folders]
        self._lock = threading.Lock()
        self._file: int | None = None
        self._own = threading.local()

    def on_start(self, event: event.Event) -> None:
        """Wait for other threads and processes; numba takes its own lock afterwards."""
        self._own.depth = depth = getattr(self._own, "depth", 0) + 1
        if depth > 1:
            return
        self._lock.acquire()
        try:
            # Opened anew each time: processes that are forked would share the lock of an open file.
            self._file = next((file for file in map(_opened, self._paths) if file is not None), None)
            if self._file is not None:
                with contextlib.suppress(OSError):  # a file system without locks
                    fcntl.flock(self._file, fcntl.LOCK_EX)
        except BaseException:  # interrupted
            self.on_end(event)
            raise

    def on_end(self, event: event.Event) -> None:
        """Let others go on; numba has released its own lock."""
        depth = getattr(self._own, "depth", 0)
        self._own.depth = max(depth - 1, 0)
        if depth != 1:  # 0 where numba held its lock before this listened
            return
        if self._file is not None:
            os.close(self._file)  # which releases the lock
            self._file = None
        self._lock.release()


def _opened(path: Path) -> int | None:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError:
        return None


def kernel_lock() -> KernelLock:
    """Return the lock of the folder that numba keeps compiled kernels in."""
    return KernelLock(*kernel_folders(Path(__file__).parent))
