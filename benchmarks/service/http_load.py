"""Requests per second of the service, compared with a plain FastAPI endpoint that computes nothing, and its memory.

    python -m benchmarks.service.http_load hall.h5 [--workers 1 2] [--seconds 5] [--rounds 3] [--swaps 20]
    python -m benchmarks.service.http_load hall.h5 --memory 200000
    python -m benchmarks.service.http_load hall.h5 --steady 15 [--rate 100]

The load comes from `wrk` (Debian package wrk) over 16 connections on loopback. Both servers are uvicorn, on uvloop
and with httptools; the plain one is started by uvicorn's command, validates the same report with the same models and
answers with the example of a fix. They run alternately, and medians over the rounds are compared, because other work on
the machine slows both. Processor time per request is less affected.

`--memory` loads one process at the highest possible rate, `--steady` loads several for minutes at a moderate rate with
reports of all kinds. Both print the memory of the service's processes.
"""

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from fastapi import FastAPI
from fastapi.responses import JSONResponse

from rayfix_service.http.openapi.examples import FIX_EXAMPLE, REPORT_EXAMPLES
from rayfix_service.wire import ReportDocument

REPORT = REPORT_EXAMPLES["angle_and_time"]["value"]
CONNECTIONS = 16
ROOT = Path(__file__).resolve().parents[2]

plain = FastAPI()


@plain.post("/v1/positions")
async def post_position(report: ReportDocument) -> JSONResponse:
    """Take a report and compute nothing."""
    return JSONResponse(FIX_EXAMPLE)


@plain.get("/readyz")
async def readyz() -> dict[str, str]:
    """Answer as the service does."""
    return {"status": "ready"}


@dataclass(frozen=True, kw_only=True)
class Load:
    """What one run of the load generator saw, and the processor time that the server took for a request."""

    per_second: float
    processor_ms: float
    median_ms: float
    p99_ms: float
    failed: int


@contextmanager
def server(command: list[str]) -> Iterator[tuple[str, int]]:
    """Run a server on a free port; gives its URL and its process."""
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            deadline = time.monotonic() + 120
            port = None
            while port is None:
                assert process.poll() is None, "the server ended"
                assert time.monotonic() < deadline, "the server does not listen"
                time.sleep(0.05)
                log.seek(0)
                port = next(iter(re.findall(r"http://127\.0\.0\.1:(\d+)", log.read())), None)
            url = f"http://127.0.0.1:{port}"
            _wait_until_ready(url, deadline)
            yield url, process.pid
        finally:
            process.terminate()
            process.wait(30)


def _wait_until_ready(url: str, deadline: float) -> None:
    answers = 0
    while answers < 20:  # several workers take turns, more or less
        try:
            answers = answers + 1 if httpx.get(f"{url}/readyz", trust_env=False).status_code == 200 else 0
        except httpx.TransportError:
            answers = 0
        assert time.monotonic() < deadline, "not ready"
        time.sleep(0.02)


def rayfix_command(table: Path, workers: int) -> list[str]:
    """Command that serves the table."""
    return [sys.executable, "-m", "rayfix", "serve", str(table), "--port", "0", "--workers", str(workers)]


def plain_command(workers: int) -> list[str]:
    """Command that serves the endpoint that computes nothing."""
    options = ["--port", "0", "--workers", str(workers), "--no-access-log", "--app-dir", str(ROOT)]
    return [sys.executable, "-m", "uvicorn", "benchmarks.service.http_load:plain", *options]


def processes(pid: int) -> Iterator[int]:
    """Yield a process and all that it started."""
    waiting = [pid]
    while waiting:
        yield (each := waiting.pop())
        waiting += [int(c) for t in Path(f"/proc/{each}/task").iterdir() for c in (t / "children").read_text().split()]


def processor_seconds(pid: int) -> float:
    """Processor time of a process and its children so far."""
    total = 0
    for each in processes(pid):
        fields = Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split()
        total += int(fields[11]) + int(fields[12])
    return total / os.sysconf("SC_CLK_TCK")


def memory_of(pid: int) -> tuple[float, float]:
    """Memory of a process, MiB: all that is resident, and what of it no other process shares."""
    kinds = dict(re.findall(r"^(\w+):\s+(\d+) kB", Path(f"/proc/{pid}/smaps_rollup").read_text(), flags=re.MULTILINE))
    return int(kinds["Rss"]) / 1024, (int(kinds["Private_Clean"]) + int(kinds["Private_Dirty"])) / 1024


def load(
    server: tuple[str, int],
    path: str,
    *documents: Any,
    seconds: float,
    connections: int = CONNECTIONS,
    rate: float | None = None,
) -> Load:
    """Post documents to a server, a URL and a process, in turns, over and over; at most so many a second."""
    url, pid = server
    bodies = ", ".join(json.dumps(json.dumps(document)) for document in documents)
    delay = f"delay = function() return math.random() * {2e3 * connections / rate} end" if rate else ""
    script = f"""
local bodies, turn = {{{bodies}}}, 0
local headers = {{["Content-Type"] = "application/json"}}
request = function()
  turn = turn % #bodies + 1
  return wrk.format("POST", nil, headers, bodies[turn])
end
{delay}
done = function(summary, latency)
  local e = summary.errors
  io.write(string.format("RESULT %d %f %f %f %d\\n", summary.requests, summary.duration / 1e6,
    latency:percentile(50) / 1e3, latency:percentile(99) / 1e3, e.connect + e.read + e.write + e.status + e.timeout))
end
"""
    with tempfile.NamedTemporaryFile("w", suffix=".lua") as file:
        file.write(script)
        file.flush()
        before = processor_seconds(pid)
        command = ["wrk", "-t1", f"-c{connections}", f"-d{seconds:g}s", "--timeout", "30s", "-s", file.name, url + path]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        processor = processor_seconds(pid) - before
    (values,) = re.findall(r"^RESULT (.*)$", output, flags=re.MULTILINE)
    requests, duration, median, p99, failed = (float(value) for value in values.split())
    return Load(
        per_second=requests / duration,
        processor_ms=1e3 * processor / requests,
        median_ms=median,
        p99_ms=p99,
        failed=int(failed),
    )


def compare(table: Path, workers: int, seconds: float, rounds: int) -> None:
    """Load both servers in turns and print the medians."""
    runs: dict[str, list[Load]] = {"plain FastAPI": [], "rayfix": []}
    batches = []
    batch = {"reports": [REPORT] * 100}
    with server(plain_command(workers)) as plain_server, server(rayfix_command(table, workers)) as rayfix_server:
        for _ in range(rounds):
            for name, each in zip(runs, (plain_server, rayfix_server), strict=True):
                runs[name].append(load(each, "/v1/positions", REPORT, seconds=seconds))
            batches.append(load(rayfix_server, "/v1/positions/batch", batch, seconds=seconds, connections=2 * workers))
    median = {name: statistics.median(run.per_second for run in each) for name, each in runs.items()}
    for name, each in runs.items():
        print(
            f"{workers} workers  {name:14} {median[name]:8.0f} requests/s   "
            f"median {statistics.median(run.median_ms for run in each):6.2f} ms   "
            f"p99 {statistics.median(run.p99_ms for run in each):6.2f} ms   "
            f"processor {statistics.median(run.processor_ms for run in each):5.2f} ms a request   "
            f"failed {sum(run.failed for run in each)}"
        )
    ratios = [b.per_second / a.per_second for a, b in zip(*runs.values(), strict=True)]
    cost = [a.processor_ms / b.processor_ms for a, b in zip(*runs.values(), strict=True)]
    print(
        f"{workers} workers  share of plain FastAPI's requests/s: {100 * statistics.median(ratios):.0f} %   "
        f"by processor time: {100 * statistics.median(cost):.0f} %"
    )
    fixes = 100 * statistics.median(run.per_second for run in batches)
    print(
        f"{workers} workers  batches of 100: {fixes:.0f} fixes/s   "
        f"processor {statistics.median(run.processor_ms for run in batches) / 100:.2f} ms a fix   "
        f"failed {sum(run.failed for run in batches)}"
    )


def memory(table: Path, requests: int) -> None:
    """Print the resident memory of one process after each tenth of the requests."""
    with server(rayfix_command(table, 1)) as (url, pid):
        done = 0.0
        while done < requests:
            begin = time.monotonic()
            run = load((url, pid), "/v1/positions", REPORT, seconds=10)
            done += run.per_second * (time.monotonic() - begin)
            print(f"{done:9.0f} requests   {memory_of(pid)[0]:7.1f} MiB   failed {run.failed}", flush=True)


def steady(table: Path, workers: int, minutes: int, rate: float) -> None:
    """Print the memory of all processes after each minute of a moderate load with reports of all kinds."""
    reports = [example["value"] for example in REPORT_EXAMPLES.values()]
    with server(rayfix_command(table, workers)) as (url, pid):
        for minute in range(minutes + 1):
            seconds = 60.0 if minute else 5.0
            run = load((url, pid), "/v1/positions", *reports, seconds=seconds, rate=rate)
            each = "   ".join(f"{all_:6.1f} ({own:6.1f})" for all_, own in map(memory_of, processes(pid)))
            print(
                f"minute {minute:3}   {run.per_second:6.1f} requests/s   median {run.median_ms:5.2f} ms   "
                f"p99 {run.p99_ms:6.2f} ms   failed {run.failed}   resident (own) MiB: {each}",
                flush=True,
            )


def swaps(table: Path, times: int, workers: int) -> None:
    """Put a new file in the table's place over and over under load, then end the service with its signal."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(1) as pool:
        place = Path(shutil.copy(table, folder))
        with server(rayfix_command(place, workers)) as (url, pid):
            begin = time.monotonic()
            loading = [pool.submit(load, (url, pid), "/v1/positions", REPORT, seconds=10)]
            for _ in range(times):
                os.replace(shutil.copy(table, place.with_suffix(".new")), place)
                answer = httpx.post(f"{url}/v1/tables/reload", timeout=60, trust_env=False)
                assert answer.json()["tables"][0]["change"] == "loaded", answer.text
                if loading[-1].done():
                    loading.append(pool.submit(load, (url, pid), "/v1/positions", REPORT, seconds=10))
            runs = [run.result() for run in loading]
            print(
                f"{workers} workers  {times} tables swapped in {time.monotonic() - begin:.0f} s under "
                f"{statistics.mean(run.per_second for run in runs):.0f} requests/s   "
                f"p99 {max(run.p99_ms for run in runs):.1f} ms   failed {sum(run.failed for run in runs)}"
            )


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", type=Path)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seconds", type=float, default=5.0, help="of each run (default: 5)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--memory", type=int, metavar="REQUESTS", help="watch the memory over so many instead")
    parser.add_argument("--steady", type=int, metavar="MINUTES", help="watch it for so long at a moderate rate instead")
    parser.add_argument("--rate", type=float, default=100.0, help="requests a second of --steady (default: 100)")
    parser.add_argument("--swaps", type=int, metavar="TIMES", help="swap the table under load instead")
    options = parser.parse_args()
    if shutil.which("wrk") is None:
        sys.exit("wrk is missing; install the Debian package wrk")
    if options.memory:
        memory(options.table, options.memory)
        return
    if options.steady:
        steady(options.table, options.workers[-1], options.steady, options.rate)
        return
    if options.swaps:
        for workers in options.workers:
            swaps(options.table, options.swaps, workers)
        return
    for workers in options.workers:
        compare(options.table, workers, options.seconds, options.rounds)


if __name__ == "__main__":
    main()
