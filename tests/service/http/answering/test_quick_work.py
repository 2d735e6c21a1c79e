"""Fixes on the event loop: one that holds it for too long is ended, and made in a thread."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.posterior.fused import Fused
from rayfix_service.fusion.stopping import FixStoppedError, Stop
from rayfix_service.http.answering.quick_work import QuickWork
from rayfix_service.locator import Locator
from tests.support.running.running_app import RunningApp


@pytest.fixture
def quick_work() -> Iterator[QuickWork]:
    made = QuickWork(0.02)
    yield made
    made.close()


def until_stopped(stop: Stop) -> None:
    """Work on as a kernel does, for 30 s at most."""
    begin = time.monotonic()
    while time.monotonic() < begin + 30.0:
        stop.check()
        time.sleep(0.001)


def test_work_that_takes_too_long_is_stopped(quick_work: QuickWork) -> None:
    for _ in range(3):
        with pytest.raises(FixStoppedError):
            quick_work.do(until_stopped)


def test_short_work_is_not_stopped_however_much_there_is() -> None:
    """Each has the whole limit; of one after the other, none takes it from the next."""
    watched = QuickWork(0.5)
    begin, stops = time.monotonic(), []
    while time.monotonic() < begin + 1.2:
        stops.append(watched.do(lambda stop: stop))
    watched.close()
    assert len(stops) > 10
    # The machine may stand still for a moment, and work that was under way then is rightly stopped.
    assert sum(int(stop.cell[0]) for stop in stops) <= 1


def test_the_watch_sleeps_and_wakes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rayfix_service.http.answering.quick_work._IDLE_LOOKS", 2)
    watched = QuickWork(0.002)
    for _ in range(5):
        with pytest.raises(FixStoppedError):
            watched.do(until_stopped)
        time.sleep(0.05)
    watched.close()
    thread = watched._thread
    assert thread is not None
    thread.join(timeout=10.0)
    assert not thread.is_alive()


def test_a_fix_that_was_taken_for_quick_ends_in_a_thread(
    hall_table_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer is the same; the event loop goes on meanwhile."""
    fuse, threads = Locator.fuse, []

    def slow_at_first(self: Locator, report: Report, *, stop: Stop, with_likelihood: bool) -> Fused:
        threads.append(threading.current_thread().name)
        if len(threads) == 1:
            until_stopped(stop)
        return fuse(self, report, stop=stop, with_likelihood=with_likelihood)

    report = {"measurements": [{"type": "aoa", "station_id": "bs1", "azimuth_deg": 40.0, "azimuth_stdev_deg": 1.0}]}
    with RunningApp(hall_table_path, quick_fix_seconds=1.0) as service:
        expected = service.post("/v1/positions", report).json()
    with RunningApp(hall_table_path, quick_fix_seconds=0.02) as service:
        monkeypatch.setattr(Locator, "fuse", slow_at_first)
        monkeypatch.setattr(Locator, "seconds", lambda *_, **__: 0.0)
        answer = service.post("/v1/positions", report)
    assert answer.status_code == 200, answer.text
    assert len(threads) == 2
    assert threads[1].startswith("slow-fix")
    for name in ("compute_seconds", "compute_ms"):
        expected.pop(name, None)
    assert {name: value for name, value in answer.json().items() if name in expected} == expected
