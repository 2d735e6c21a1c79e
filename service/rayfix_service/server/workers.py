"""The worker processes of a service: forked from one that holds what they share, and replaced when they die or hang."""

import logging
import mmap
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable

from rayfix_service.http.errors import ServiceError

COULD_NOT_START = 3
"""Exit status of a worker that could not start, as uvicorn has it; its successor could not either."""

_LOOK_SECONDS = 0.5  # between two looks at the workers, and between two beats of each
_SILENT_LOOKS = 60  # a worker without a beat for so many is replaced; a kernel may keep it silent for some
_ENDING_SECONDS = 20.0  # then what has not ended is killed; requests under way get less
_END = (signal.SIGINT, signal.SIGTERM)

_FORK = multiprocessing.get_context("fork")
_log = logging.getLogger(__name__)


def run_workers(
    work: Callable[[], None], *, count: int, meanwhile: Callable[[], None], ending: Callable[[], object]
) -> None:
    """Run worker processes until this process is told to end (SIGINT, SIGTERM), then have them end.

    Workers have all that this process has: its memory is theirs until either writes to it. It must have no other
    thread. They end by themselves when it dies.

    Parameters
    ----------
    work : callable
        What a worker does. SIGTERM must end it.
    count : int
    meanwhile : callable
        What this process does at each look at them, twice a second.
    ending : callable
        What it does when it has told them to end.

    Raises
    ------
    ServiceError
        When a worker cannot start.
    """
    # Blocked signals wait to be asked for, and reach no worker before it has handlers of its own.
    former = signal.pthread_sigmask(signal.SIG_BLOCK, _END)
    workers: list[_Worker] = []
    try:
        while signal.sigtimedwait(_END, _LOOK_SECONDS if workers else 0) is None:
            workers = [worker for worker in workers if worker.is_well()]
            while len(workers) < count:
                workers.append(_Worker(work))
            meanwhile()
    finally:
        for worker in workers:
            worker.process.terminate()
        ending()
        deadline = time.monotonic() + _ENDING_SECONDS
        for worker in workers:
            worker.process.join(max(deadline - time.monotonic(), 0))
            worker.process.kill()
        while signal.sigpending() & set(_END):
            signal.sigwait(_END)
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


class _Worker:
    """A worker process, as the process that forked it sees it."""

    def __init__(self, work: Callable[[], None]) -> None:
        # Looks are counted and not the time: all processes may be stopped for long together.
        self._beats = memoryview(mmap.mmap(-1, 8)).cast("Q")
        self._beats_seen = 0
        self._silent_looks = 0
        self.process = _FORK.Process(target=_live, args=(work, self._beats, os.getpid()))
        self.process.start()

    def is_well(self) -> bool:
        """Tell whether the process runs and beats; it has ended otherwise.

        Raises
        ------
        ServiceError
            When it could not start.
        """
        beats = self._beats[0]
        self._silent_looks = self._silent_looks + 1 if beats == self._beats_seen else 0
        self._beats_seen = beats
        if self.process.is_alive() and self._silent_looks < _SILENT_LOOKS:
            return True
        if self.process.is_alive():
            _log.error("worker %d hangs and is replaced", self.process.pid)
            self.process.kill()
            self.process.join()
        elif self.process.exitcode == COULD_NOT_START:
            raise ServiceError("a worker could not start; the log says why")
        else:
            _log.error("worker %d has ended with status %d and is replaced", self.process.pid, self.process.exitcode)
        return False


def _live(work: Callable[[], None], beats: memoryview, parent: int) -> None:
    """Be a worker."""
    for number in _END:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _END)
    threading.Thread(target=_beat, args=(beats, parent), daemon=True).start()
    work()


def _beat(beats: memoryview, parent: int) -> None:
    """Tell the parent process that this one runs; end it when there is no parent."""
    while os.getppid() == parent:
        beats[0] += 1
        time.sleep(_LOOK_SECONDS)
    os.kill(os.getpid(), signal.SIGTERM)
