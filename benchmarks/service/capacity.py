"""Resources of a service: processor time per fix, memory, time to start. docs/capacity.md uses these results.

A real ``rayfix serve`` of one worker answers reports of uniform drops; its processor time is measured, not wall time,
because the machine may be busy with other work. Then the memory of a service with several workers is measured. Run with
``--table`` on any table.
"""

import http.client
import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import Drop, drop_uniformly
from rayfix_evaluation.drops.simulate import Noise, Timing, simulate_report
from rayfix_service.locator import Locator
from rayfix_service.wire import parse_report

CASES: list[tuple[str, float, Timing, bool]] = [
    ("AoA 1 deg + PT 0.5 m", 1.0, "pt", True),
    ("AoA 1 deg", 1.0, "none", True),
    ("AoA 7 deg + PT 0.5 m", 7.0, "pt", True),
    ("PT 0.5 m", 1.0, "pt", False),
]
"""What is measured: label, deviation of angles [deg], times, and whether angles are."""

WORKERS = 4
CONNECTIONS = 16
BATCH = 100


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--reports", type=int, default=200, help="of each kind")
    options = parser.parse_args()
    with open_or_build(options.table) as table:
        drops = drop_uniformly(table, options.reports, np.random.default_rng([options.seed, 0]))
        reports = {label: simulate(drops, options.seed, *how) for label, *how in CASES}
        locator = Locator(table)
        locator.warm_up()
        with serving(table.path) as (port, server, seconds, cpu):
            print(f"start to ready: {seconds:.1f} s, of which {cpu:.1f} s of processor time")
            memory = server.memory_full_info()
            print(f"table: {table.path.stat().st_size / 1e6:.0f} MB, {len(table.site.stations)} stations")
            print(f"memory of the worker after the start: {memory.uss / 1e6:.0f} MB of its own")
            print("                        processor ms a fix              fixes/s of a core")
            print("report                  fusion   POST each   batches    POST each   batches")
            for label, documents in reports.items():
                print(row(label, locator, server, port, documents), flush=True)
            memory = server.memory_full_info()
            print(f"after all: {memory.uss / 1e6:.0f} MB of its own, {(memory.rss - memory.uss) / 1e6:.0f} MB shared")
        with serving(table.path, WORKERS) as (port, first, seconds, cpu):
            print(f"{WORKERS} workers: start to ready {seconds:.1f} s, of which {cpu:.1f} s of processor time in all")
            for _ in range(WORKERS):  # each worker comes by many of them
                post_all(port, "/v1/positions", [json.dumps(d).encode() for own in reports.values() for d in own])
            own = [worker.memory_full_info().uss / 1e6 for worker in first.children()]
            print(f"after all: {', '.join(f'{size:.0f}' for size in sorted(own))} MB of their own")


def simulate(drops: list[Drop], seed: int, degrees: float, timing: Timing, angles: bool) -> list[dict[str, Any]]:
    """Simulate a report of each drop."""
    angle = float(np.deg2rad(degrees))
    noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=0.5)
    documents = []
    for n, drop in enumerate(drops):
        document = simulate_report(drop.paths, noise, rng=np.random.default_rng([seed, 1, n]), timing=timing)
        document["measurements"] = [m for m in document["measurements"] if angles or m["type"] != "aoa"]
        if document["measurements"]:
            documents.append(document)
    return documents


def row(label: str, locator: Locator, server: psutil.Process, port: int, documents: list[dict[str, Any]]) -> str:
    """Measure one kind of report in each of three ways."""
    parsed = [parse_report(document) for document in documents]
    begin = time.process_time()
    for report in parsed:
        locator.locate(report)
    fusion = (time.process_time() - begin) / len(parsed)
    singles = [json.dumps(document).encode() for document in documents]
    parts = [documents[n : n + BATCH] for n in range(0, len(documents), BATCH)]
    batches = [json.dumps({"reports": part}).encode() for part in parts]
    costs = []
    for path, bodies in (("/v1/positions", singles), ("/v1/positions/batch", batches)):
        post_all(port, path, bodies)  # once unmeasured, for what is made at first need
        before = processor_seconds(server)
        post_all(port, path, bodies)
        costs.append((processor_seconds(server) - before) / len(documents))
    rates = "".join(f"{1.0 / cost:11.0f}" for cost in costs)
    return f"{label:22} {1e3 * fusion:7.2f} {1e3 * costs[0]:11.2f} {1e3 * costs[1]:9.2f} {rates}"


def processor_seconds(process: psutil.Process) -> float:
    """Return the processor time of a process and its children so far."""
    times = [each.cpu_times() for each in (process, *process.children())]
    return float(sum(time.user + time.system for time in times))


def post_all(port: int, path: str, bodies: list[bytes]) -> None:
    """Send requests over several connections that stay open."""

    def send(share: list[bytes]) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=300.0)
        for body in share:
            connection.request("POST", path, body, {"content-type": "application/json"})
            answer = connection.getresponse()
            answer.read()
            if answer.status != http.client.OK:
                sys.exit(f"{path} was answered with {answer.status}")
        connection.close()

    with ThreadPoolExecutor(CONNECTIONS) as pool:
        list(pool.map(send, [bodies[n::CONNECTIONS] for n in range(CONNECTIONS)]))


@contextmanager
def serving(table_path: Path, workers: int = 1) -> Iterator[tuple[int, psutil.Process, float, float]]:
    """Serve a table; yields port, the first process, and the start's seconds and processor seconds."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    begin = time.perf_counter()
    command = [sys.executable, "-m", "rayfix", "serve", str(table_path), "--port", str(port), "--workers", str(workers)]
    with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
        try:
            while not ready(port):
                if process.poll() is not None or time.perf_counter() - begin > 300:
                    sys.exit(f"the service did not start: {process.communicate()[1].decode()}")
                time.sleep(0.02)
            server = psutil.Process(process.pid)
            yield port, server, time.perf_counter() - begin, processor_seconds(server)
        finally:
            process.terminate()


def ready(port: int) -> bool:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5.0)
    try:
        connection.request("GET", "/readyz")
        return connection.getresponse().status == http.client.OK
    except OSError:
        return False
    finally:
        connection.close()


if __name__ == "__main__":
    main()
