"""The worker processes of a service: forked from one process, and replaced when they die or hang."""

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
"""Exit status of a worker that could not start, the same as uvicorn's; it is replaced after a pause."""

_LOOK_SECONDS = 0.5  # between two checks of the workers, and between two heartbeats of each
_SILENT_LOOKS = 60  # checks without a heartbeat, then a worker is replaced; a long kernel can block it for some
_ENDING_SECONDS = 20.0  # then workers that have not ended are killed; requests in progress get less
_LONGEST_PAUSE_SECONDS = 10.0  # before the next attempt after workers that could not start
_SHARED_BYTES = 16
_FAILURE_BYTES = 2048
_END = (signal.SIGINT, signal.SIGTERM)

_FORK = multiprocessing.get_context("fork")
_log = logging.getLogger(__name__)


def run_workers(
    work: Callable[[], None], *, count: int, meanwhile: Callable[[], None], ending: Callable[[], object]
) -> None:
    """Run worker processes until this process receives SIGINT or SIGTERM, then end them.

    Workers are forked: they share the memory of this process until either side writes to it. This process must have no
    other thread. Workers end when it dies. A worker that ends is replaced: at once if it had started (see
    :func:`tell_started`), otherwise after a pause that grows.

    Parameters
    ----------
    work : callable
        The work of a worker. SIGTERM must end it.
    count : int
    meanwhile : callable
        Called in this process at each check of the workers, twice a second.
    ending : callable
        Called after the workers have been signalled to end.

    Raises
    ------
    ServiceError
        When none of the first workers can start.
    """
    # Blocked signals stay pending until a worker has installed its own handlers.
    former = signal.pthread_sigmask(signal.SIG_BLOCK, _END)
    starts = _Starts(count=count)
    workers: list[_Worker] = []
    look = 0.0
    try:
        while signal.sigtimedwait(_END, look) is None:
            look = _LOOK_SECONDS
            starts.note(workers)
            workers = [worker for worker in workers if worker.process.is_alive()]
            while len(workers) < count and starts.may_be_tried():
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


class _Starts:
    """Whether workers start, and when the next attempt is due after failures."""

    def __init__(self, *, count: int) -> None:
        self._count = count
        self._any_started = False
        self._failed = 0
        self._reason = ""
        self._not_before = 0.0

    def may_be_tried(self) -> bool:
        """Check whether the pause is over."""
        return time.monotonic() >= self._not_before

    def note(self, workers: list["_Worker"]) -> None:
        """Update the state of the workers since the last check.

        Raises
        ------
        ServiceError
            When as many workers as requested could not start, and none has ever started.
        """
        for worker in workers:
            if worker.has_started and not worker.seen_to_start:
                worker.seen_to_start = self._any_started = True
                self._failed, self._reason, self._not_before = 0, "", 0.0
            if worker.is_well():
                continue
            if not worker.seen_to_start:
                self._failed += 1
                self._not_before = time.monotonic() + min(_LOOK_SECONDS * 2.0**self._failed, _LONGEST_PAUSE_SECONDS)
            if worker.process.exitcode == COULD_NOT_START:
                self._note_failure(worker.failure or "the log has the cause")
        others = sum(worker.process.is_alive() for worker in workers)
        if self._reason and not self._any_started and not others and self._failed >= self._count:
            raise ServiceError(f"a worker could not start; {self._reason}")

    def _note_failure(self, reason: str) -> None:
        if reason != self._reason:
            _log.critical("a worker cannot start and is tried again: %s", reason)
        self._reason = reason


_own: "_Worker | None" = None  # this process's object, in a worker


def tell_started() -> None:
    """Report to the parent process that this worker is ready; does nothing in other processes."""
    if _own is not None:
        _own.shared[1] = 1


def tell_failure(reason: str) -> None:
    """Report to the parent process why this worker cannot start, before it ends with ``COULD_NOT_START``."""
    if _own is not None:
        text = reason.encode("utf-8", "backslashreplace")[: _FAILURE_BYTES - 1]
        _own.report[: len(text) + 1] = text + b"\0"


class _Worker:
    """A worker process, as the process that forked it sees it."""

    def __init__(self, work: Callable[[], None]) -> None:
        # Checks are counted instead of time, because all processes may be suspended together.
        memory = memoryview(mmap.mmap(-1, _SHARED_BYTES + _FAILURE_BYTES))
        self.shared = memory[:_SHARED_BYTES].cast("Q")  # heartbeats, and whether the worker has started
        self.report = memory[_SHARED_BYTES:]
        self.seen_to_start = False
        self._beats_seen = 0
        self._silent_looks = 0
        self.process = _FORK.Process(target=_live, args=(work, self, os.getpid()))
        self.process.start()

    @property
    def has_started(self) -> bool:
        """Whether the worker has reported that it is ready."""
        return self.shared[1] != 0

    @property
    def failure(self) -> str:
        """Why the worker could not start, if it has reported that."""
        return bytes(self.report).partition(b"\0")[0].decode("utf-8", "replace")

    def is_well(self) -> bool:
        """Whether the process runs and sends heartbeats; if not, it has ended."""
        beats = self.shared[0]
        self._silent_looks = self._silent_looks + 1 if beats == self._beats_seen else 0
        self._beats_seen = beats
        if self.process.is_alive() and self._silent_looks < _SILENT_LOOKS:
            return True
        if self.process.is_alive():
            _log.error("worker %d hangs and is replaced", self.process.pid)
            self.process.kill()
            self.process.join()
        elif self.process.exitcode != COULD_NOT_START:
            _log.error("worker %d has ended with status %d and is replaced", self.process.pid, self.process.exitcode)
        return False


def _live(work: Callable[[], None], own: _Worker, parent: int) -> None:
    """Run in the worker process."""
    global _own
    _own = own
    for number in _END:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _END)
    threading.Thread(target=_beat, args=(own.shared, parent), daemon=True).start()
    work()


def _beat(beats: memoryview, parent: int) -> None:
    """Send heartbeats to the parent process; end when it is gone."""
    while os.getppid() == parent:
        beats[0] += 1
        time.sleep(_LOOK_SECONDS)
    os.kill(os.getpid(), signal.SIGTERM)
