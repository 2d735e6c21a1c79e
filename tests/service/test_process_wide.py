"""A process that uses rayfix as a library is left as it was."""

import gc
import logging
import logging.config
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info

import rayfix
from rayfix_service.process_wide import collector_paused, logged_to_stderr, logging_restored

REPORT: dict[str, Any] = {
    "target_id": "a",
    "timestamp": "2026-01-31T10:00:00Z",
    "measurements": [
        {"type": "aoa", "station_id": "bs1", "azimuth_deg": 70.5, "azimuth_stdev_deg": 2.0},
        {"type": "pt", "station_id": "bs1", "range_m": 14.5, "stdev_m": 0.5},
    ],
}


@pytest.fixture(autouse=True)
def collector() -> Iterator[None]:
    """Leave the collector as it was, whatever a test does."""
    enabled = gc.isenabled()
    yield
    (gc.enable if enabled else gc.disable)()


def state() -> dict[str, Any]:
    """Return what a process has one of."""
    root = logging.getLogger()
    return {
        "collector": (gc.isenabled(), gc.get_threshold(), gc.get_freeze_count()),
        "environment": dict(os.environ),
        "signals": {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD)},
        "blocked": signal.pthread_sigmask(signal.SIG_BLOCK, ()),
        "log": (root.level, list(root.handlers), logging.root.manager.disable),
        "warnings": list(warnings.filters),
        "hooks": (sys.excepthook, sys.unraisablehook, threading.excepthook, sys.getrecursionlimit()),
        "folder": Path.cwd(),
        "numpy": np.geterr(),
        "library threads": sorted((one["filepath"], one["num_threads"]) for one in threadpool_info()),
    }


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize(("count", "jobs"), [(3, 1), (150, 2)])
def test_a_batch_leaves_the_process_as_it_was(hall_table_path: Path, enabled: bool, count: int, jobs: int) -> None:
    locator = rayfix.Locator(rayfix.Table.open(hall_table_path))
    locator.locate_batch([REPORT] * count, jobs=jobs)  # libraries that are loaded later would count as a change
    (gc.enable if enabled else gc.disable)()
    before = state()
    answers = locator.locate_batch([REPORT] * count, jobs=jobs)
    assert state() == before
    assert before["collector"][0] is enabled
    assert all(isinstance(answer, rayfix.Fix) for answer in answers)


def test_locating_and_tracking_leave_the_process_as_it_was(hall_table_path: Path) -> None:
    def use() -> None:
        table = rayfix.Table.open(hall_table_path)
        locator = rayfix.Locator(table)
        rayfix.Tracker(table).follow(locator.fuse(REPORT))
        locator.posterior(REPORT)
        with pytest.raises(rayfix.ReportError):
            locator.locate({"measurements": []})

    use()
    before = state()
    use()
    assert state() == before


def test_an_error_ends_a_pause() -> None:
    gc.enable()
    with pytest.raises(KeyError), collector_paused():
        raise KeyError
    assert gc.isenabled()


def test_pauses_that_overlap_leave_the_collector_as_the_first_has_found_it() -> None:
    gc.enable()
    first, second = collector_paused(), collector_paused()
    first.__enter__()
    second.__enter__()
    assert not gc.isenabled()
    first.__exit__(None, None, None)
    assert not gc.isenabled()
    second.__exit__(None, None, None)
    assert gc.isenabled()


def test_a_log_is_shown_only_meanwhile_and_not_beside_that_of_the_host(capsys: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    try:
        root.handlers[:] = []
        root.setLevel(logging.WARNING)
        with logged_to_stderr():
            logging.getLogger("rayfix.sample").info("shown")
        assert (root.handlers, root.level) == ([], logging.WARNING)
        own = logging.NullHandler()
        root.addHandler(own)
        with logged_to_stderr():
            assert (root.handlers, root.level) == ([own], logging.WARNING)
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z INFO: shown\n", capsys.readouterr().err)


def test_logging_is_as_before_whatever_configures_it_meanwhile() -> None:
    known, unknown = logging.getLogger("rayfix.known"), "rayfix.made_meanwhile"
    own = logging.NullHandler()
    known.addHandler(own)
    known.setLevel(logging.ERROR)
    config = {
        "version": 1,
        "handlers": {"other": {"class": "logging.NullHandler"}},
        "loggers": {
            name: {"handlers": ["other"], "level": "DEBUG", "propagate": False} for name in (known.name, unknown)
        },
    }
    try:
        with logging_restored():
            logging.config.dictConfig(config | {"disable_existing_loggers": False})
            assert known.handlers != [own]
        assert (known.handlers, known.level, known.propagate) == ([own], logging.ERROR, True)
        made = logging.getLogger(unknown)
        assert (made.handlers, made.level, made.propagate) == ([], logging.NOTSET, True)
    finally:
        known.removeHandler(own)
        known.setLevel(logging.NOTSET)
