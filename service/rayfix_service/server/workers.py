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
"""Exit status of a worker that could not start, as uvicorn has it; its successor may, after a pause."""

_LOOK_SECONDS = 0.5  # between two looks at the workers, and between two beats of each
_SILENT_LOOKS = 60  # a worker without a beat for so many is replaced; a kernel may keep it silent for some
_ENDING_SECONDS = 20.0  # then what has not ended is killed; requests under way get less
_LONGEST_PAUSE_SECONDS = 10.0  # before the next try after workers that could not start
_SHARED_BYTES = 16
_FAILURE_BYTES = 2048
_END = (signal.SIGINT, signal.SIGTERM)

_FORK = multiprocessing.get_context("fork")
_log = logging.getLogger(__name__)


def run_workers(
    work: Callable[[], None], *, count: int, meanwhile: Callable[[], None], ending: Callable[[], object]
) -> None:
    """Run worker processes until this process gets SIGINT or SIGTERM, then end them.

    Workers have all that this process has: its memory is theirs until either writes to it. It must have no other
    thread. They end by themselves when it dies. One that ends is replaced: at once if it had started (see
    :func:`tell_started`), after a pause that grows if not.

    Parameters
    ----------
    work : callable
        What a worker does. SIGTERM must end it.
    count : int
    meanwhile : callable
        What this process does at each look at them, twice a second.
    ending : callable
        Called when it has signalled them to end.

    Raises
    ------
    ServiceError
        When none of the first workers can start.
    """
    # Blocked signals stay pending, and reach no worker before it has handlers of its own.
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
    """Whether workers start, and when the next one may try after some that could not."""

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
            When as many as there should be could not start, and none ever has.
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


_own: "_Worker | None" = None  # in a worker, itself


def tell_started() -> None:
    """Report to the parent process that this one is ready; does nothing in a process that is no worker."""
    if _own is not None:
        _own.shared[1] = 1


def tell_failure(reason: str) -> None:
    """Report to the parent process why this one cannot start, before it ends with ``COULD_NOT_START``."""
    if _own is not None:
        text = reason.encode("utf-8", "backslashreplace")[: _FAILURE_BYTES - 1]
        _own.report[: len(text) + 1] = text + b"\0"


class _Worker:
    """A worker process, as the process that forked it sees it."""

    def __init__(self, work: Callable[[], None]) -> None:
        # Checks are counted and not the time: all processes may be stopped for long together.
        memory = memoryview(mmap.mmap(-1, _SHARED_BYTES + _FAILURE_BYTES))
        self.shared = memory[:_SHARED_BYTES].cast("Q")  # beats, and whether it has started
        self.report = memory[_SHARED_BYTES:]
        self.seen_to_start = False
        self._beats_seen = 0
        self._silent_looks = 0
        self.process = _FORK.Process(target=_live, args=(work, self, os.getpid()))
        self.process.start()

    @property
    def has_started(self) -> bool:
        """Whether it has reported that it is ready."""
        return self.shared[1] != 0

    @property
    def failure(self) -> str:
        """Why it could not start, if it has reported that."""
        return bytes(self.report).partition(b"\0")[0].decode("utf-8", "replace")

    def is_well(self) -> bool:
        """Check whether the process runs and beats; otherwise it has ended."""
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
    """Be a worker."""
    global _own
    _own = own
    for number in _END:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _END)
    threading.Thread(target=_beat, args=(own.shared, parent), daemon=True).start()
    work()


def _beat(beats: memoryview, parent: int) -> None:
    """Report to the parent process that this one runs; end when there is no parent."""
    while os.getppid() == parent:
        beats[0] += 1
        time.sleep(_LOOK_SECONDS)
    os.kill(os.getpid(), signal.SIGTERM)
