"""Memory that slow fixes have freed goes back to the system."""

import asyncio
import gc
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rayfix_service.http.answering.freed_memory import FreedMemory
from rayfix_service.http.answering.slow_work import SlowWork
from rayfix_service.server import app as app_module
from tests.support.running.running_app import RunningApp

CODE = """
import json, threading
from pathlib import Path
import numpy as np
from rayfix_service.http.answering.freed_memory import give_back

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

kept = []
def work():
    arrays = [np.ones(8000) for _ in range(2000)]  # 122 MiB, none of them long enough for a mapping of its own
    kept.extend(arrays[::50])

before = resident()
thread = threading.Thread(target=work)
thread.start()
thread.join()
freed = resident()
give_back()
print(json.dumps([before, freed, resident()]))
"""


def test_what_a_thread_has_freed_goes_back() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, timeout=120)
    before, freed, after = json.loads(done.stdout)
    assert freed - before > 60.0
    assert after - before < 20.0


def test_work_done_in_quick_succession_is_followed_by_one_call() -> None:
    async def scenario() -> list[int]:
        calls: list[int] = []
        counts = []
        freed = FreedMemory(lambda: calls.append(1), seconds=0.2)
        for _ in range(5):
            freed.soon()
        counts.append(len(calls))
        await asyncio.sleep(0.6)
        counts.append(len(calls))
        freed.soon()
        await asyncio.sleep(0.6)
        counts.append(len(calls))
        freed.soon()
        freed.close()
        await asyncio.sleep(0.6)
        return [*counts, len(calls)]

    assert asyncio.run(scenario()) == [0, 1, 2, 2]


def test_slow_work_tells_when_a_thread_is_free_again() -> None:
    async def scenario() -> tuple[list[int], int]:
        under_way: list[int] = []
        work = SlowWork(threads=1, waiting=3, seconds=60.0, on_done=lambda: under_way.append(work.under_way))
        await asyncio.gather(*(work.run(lambda: None) for _ in range(3)))
        async with asyncio.timeout(10.0):
            while len(under_way) < 3:
                await asyncio.sleep(0.01)
        work.close()
        return under_way, work.under_way

    assert asyncio.run(scenario()) == ([2, 1, 0], 0)


@pytest.mark.parametrize("own_process", [True, False])
def test_a_service_of_its_own_process_does_it_after_slow_fixes_and_long_bodies(
    hall_table_path: Path, monkeypatch: pytest.MonkeyPatch, own_process: bool
) -> None:
    told: list[str] = []

    class Told:
        def soon(self) -> None:
            told.append("soon")

        def close(self) -> None:
            told.append("close")

    monkeypatch.setattr(app_module, "FreedMemory", Told)
    report: dict[str, Any] = {
        "measurements": [{"type": "pt", "station_id": "bs1", "range_m": 9.0, "stdev_m": 1.0}],
    }
    try:
        with RunningApp(hall_table_path, own_process=own_process, quick_fix_seconds=0.0) as service:
            assert service.post("/v1/positions", report).status_code == 200
            service.wait_for(lambda: told or not own_process)
            after_fix = len(told)
            service.post("/v1/positions", {"measurements": ["x" * 40_000]})
            after_body = len(told)
    finally:
        gc.unfreeze()
    assert (after_fix > 0, after_body > after_fix, told[-1:] == ["close"]) == (own_process,) * 3
