"""What rayfix changes in the whole process that it runs in, and how it is undone.

Functions of the public API change nothing in their process that outlasts the call. Within a call they change

- the collector of reference cycles: :func:`collector_paused`, in ``locate_batch``;
- the threads of linear algebra libraries, by threadpoolctl's context manager, in fits and evaluations;
- the logging of libraries that read scenes, in ``rayfix_offline.scene``.

What stays is a listener to numba's compilations, which announces those of rayfix's own kernels on the log, and has
processes compile one after the other (``rayfix_tables.gaussians.compilation``).

``rayfix mqtt`` logs to standard error by :func:`logged_to_stderr`. ``rayfix serve`` has uvicorn configure logging
(:func:`logging_restored` undoes it), takes signals (``rayfix_service.server.stopping``, ``workers``), sets the variable
of prometheus_client for its workers, freezes the collector's objects (``gc.freeze``) and sets its thresholds while they
run: all of it is undone at its end. So is that threads share one arena of glibc (``http.answering.freed_memory``). Only
the limit of open files stays raised. It ends by an exception, never by leaving the process.
"""

import gc
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["collector_paused", "logged_to_stderr", "logging_restored"]

_FORMAT = "%(asctime)s.%(msecs)03dZ %(levelname)s: %(message)s"
_DATE_FORMAT = "%Y-%m-%dT%H:%M:%S"

_lock = threading.Lock()
_pauses = 0
_was_enabled = False


@contextmanager
def collector_paused() -> Iterator[None]:
    """Pause cyclic garbage collection while results accumulate.

    Results have no reference cycles, and searching thousands of them again and again takes a fifth of the time of a
    batch. Pauses may overlap, in several threads too: the last to end leaves the collector as the first has found it.
    """
    global _pauses, _was_enabled
    with _lock:
        if _pauses == 0:
            _was_enabled = gc.isenabled()
            gc.disable()
        _pauses += 1
    try:
        yield
    finally:
        with _lock:
            _pauses -= 1
            if _pauses == 0 and _was_enabled:
                gc.enable()


@contextmanager
def logged_to_stderr() -> Iterator[None]:
    """Log messages from the level INFO on to standard error, unless the process has a log of its own.

    A line begins with its time in UTC.
    """
    root = logging.getLogger()
    if root.handlers:
        yield
        return
    handler = logging.StreamHandler()
    formatter = logging.Formatter(_FORMAT, _DATE_FORMAT)
    formatter.converter = time.gmtime
    handler.setFormatter(formatter)
    level = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.setLevel(level)
        root.removeHandler(handler)
        handler.close()


@contextmanager
def logging_restored() -> Iterator[None]:
    """Give each logger back the handlers, level and propagation that it had, whatever configures logging meanwhile."""
    names = [None, *logging.root.manager.loggerDict]
    before = {
        name: (list(logger.handlers), logger.level, logger.propagate)
        for name, logger in ((name, logging.getLogger(name)) for name in names)
    }
    try:
        yield
    finally:
        for name in [None, *logging.root.manager.loggerDict]:
            logger = logging.getLogger(name)
            handlers, level, propagate = before.get(name, ([], logging.NOTSET, True))
            logger.handlers[:] = handlers
            logger.setLevel(level)
            logger.propagate = propagate
