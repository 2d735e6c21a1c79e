"""Memory that slow fixes have freed goes back to the system."""

import asyncio
import gc
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rayfix_service.http.answering.freed_memory import FreedMemory
from rayfix_service.http.answering.slow_work import SlowWork
from rayfix_service.server import app as app_module
from tests.support.running.running_app import RunningApp

_ALLOCATORS = ("MALLOC_ARENA_MAX", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_", "GLIBC_TUNABLES")

CODE = """
import contextlib, ctypes, json, sys, threading
from pathlib import Path
import numpy as np
from rayfix_service.http.answering.freed_memory import give_back, one_arena

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

def work():
    np.ones(3_500_000)  # glibc gives arrays of that length no mappings of their own from now on
    both.wait()
    arrays = [np.ones(50_000) for _ in range(120)]
    both.wait()

both = threading.Barrier(2)
with one_arena() if sys.argv[1] == "one arena" else contextlib.nullcontext():
    before = resident()
    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    give_back()
    ctypes.CDLL(None).malloc_stats()  # to standard error
    print(json.dumps(resident() - before))
"""


@pytest.mark.parametrize("arenas", ["one arena", "many arenas"])
def test_what_threads_have_freed_goes_back_from_one_arena(arenas: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE, arenas],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
        env={name: value for name, value in os.environ.items() if name not in _ALLOCATORS},
    )
    assert (done.stderr.count("Arena ") == 1) == (arenas == "one arena")
    if arenas == "one arena":
        assert json.loads(done.stdout) < 10.0


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
