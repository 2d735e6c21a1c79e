"""A long log located by ``rayfix locate``: memory of its processes, and its rate against ``Locator.locate_batch``.

The log holds reports of uniform drops, angles at 1 deg and ranges at 0.5 m, ``--different`` of them in turn. Memory is
read from /proc while the command runs: ``own`` are pages that a process shares with no other (USS), ``share`` is that
and its part of what it shares (PSS), ``rss`` counts every page of the table and of libraries in each process that has
read it. The table's pages are of the file, which the system takes back when it needs memory; ``no file`` is RSS without
pages of files. The batch is located before and after the log, with as many processes, in blocks of ``--block`` reports.
"""

import json
import multiprocessing
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import drop_uniformly
from rayfix_evaluation.drops.simulate import Noise, simulate_report
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

_EVERY = 0.25
"""Seconds between two looks at the memory."""

_KINDS = ("own", "share", "rss", "no file")


@dataclass(kw_only=True)
class Peaks:
    """Most memory of each process, by its number, MB, and of all together at one time; processor time of each."""

    names: dict[int, str] = field(default_factory=dict)
    each: dict[int, dict[str, float]] = field(default_factory=dict)
    together: dict[str, float] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)

    def look(self, process: psutil.Process) -> None:
        """Read the memory of a process and of its children."""
        total = dict.fromkeys(_KINDS, 0.0)
        for one in [process, *process.children(recursive=True)]:
            try:
                memory, name = one.memory_full_info(), " ".join(one.cmdline())
                of_files, used = _of_files(one.pid), one.cpu_times()
            except (psutil.Error, OSError):
                continue
            found = dict(zip(_KINDS, (memory.uss, memory.pss, memory.rss, memory.rss - of_files), strict=True))
            self.seconds[one.pid] = used.user + used.system
            own = self.each.setdefault(one.pid, {})
            self.names[one.pid] = name
            for kind, size in found.items():
                own[kind] = max(own.get(kind, 0.0), size / 1e6)
                total[kind] += size / 1e6
        for kind, size in total.items():
            self.together[kind] = max(self.together.get(kind, 0.0), size)


def _of_files(pid: int) -> int:
    """Bytes of files that are mapped and in memory."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssFile:"):
            return 1024 * int(line.split()[1])
    return 0


def reports_of(table: Table, count: int, seed: int) -> list[dict[str, Any]]:
    """Simulate reports of uniform drops."""
    rng, angle = np.random.default_rng([seed, 1]), float(np.deg2rad(1.0))
    noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=0.5)
    drops = drop_uniformly(table, count, np.random.default_rng([seed, 0]))
    found = [simulate_report(drop.paths, noise, rng=rng, timing="pt") for drop in drops if drop.paths]
    return [report for report in found if report["measurements"]]


def located_log(table: Path, log: Path, output: Path, jobs: int) -> tuple[float, Peaks]:
    """Locate a log by the command; return its wall time and the memory of its processes."""
    peaks, begin = Peaks(), time.monotonic()
    command = [sys.executable, "-m", "rayfix", "locate", str(table), str(log), "-o", str(output), "--jobs", str(jobs)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as running:
        assert running.stderr is not None
        said: list[bytes] = []
        reader = threading.Thread(target=lambda: said.append(running.stderr.read()))  # type: ignore[union-attr]
        reader.start()
        process = psutil.Process(running.pid)
        while running.poll() is None:
            try:
                peaks.look(process)
            except psutil.Error:
                break
            time.sleep(_EVERY)
        reader.join()
    if running.returncode:
        raise SystemExit(said[0].decode())
    return time.monotonic() - begin, peaks


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--reports", type=int, default=100_000, help="of the log")
    parser.add_argument("--different", type=int, default=2000)
    parser.add_argument("--jobs", type=int, default=multiprocessing.cpu_count())
    parser.add_argument("--batch", type=int, default=20_000, help="reports of the batch, 0 for none")
    parser.add_argument("--block", type=int, default=4000, help="reports of a call")
    options = parser.parse_args()
    with open_or_build(options.table) as table, tempfile.TemporaryDirectory() as folder:
        reports = reports_of(table, options.different, options.seed)
        log, locator = Path(folder) / "log.jsonl", Locator(table)
        lines = [json.dumps(report, separators=(",", ":")) for report in reports]
        with log.open("w") as file:
            file.writelines(lines[n % len(lines)] + "\n" for n in range(options.reports))
        print(
            f"log: {options.reports} reports, {log.stat().st_size / 1e6:.0f} MB; {options.jobs} processes", flush=True
        )
        rates, batch_ms = [], []
        if options.batch:
            locator.locate_batch([reports[n % len(reports)] for n in range(options.block)], jobs=options.jobs)
        for half in range(2 if options.batch else 0):
            if half:
                seconds, log_ms = _log(table, log, Path(folder), options.reports, options.jobs)
            begin, used = time.monotonic(), _processor_seconds()
            for first in range(0, options.batch // 2, options.block):
                count = min(options.block, options.batch // 2 - first)
                block = [reports[(first + n) % len(reports)] for n in range(count)]
                locator.locate_batch(block, jobs=options.jobs)
            rates.append(options.batch // 2 / (time.monotonic() - begin))
            batch_ms.append(2e3 * (_processor_seconds() - used) / options.batch)
            print(f"batch: {rates[-1]:.0f} reports a second, {batch_ms[-1]:.2f} ms of processor time each", flush=True)
        if not options.batch:
            _log(table, log, Path(folder), options.reports, options.jobs)
        else:
            rate, work = options.reports / seconds / np.mean(rates), np.mean(batch_ms) / log_ms
            print(f"log against batch: {100 * rate:.0f} % by wall time, {100 * work:.0f} % by processor time")


def _log(table: Table, log: Path, folder: Path, count: int, jobs: int) -> tuple[float, float]:
    """Print the rate and the memory of the command; return its wall time, s, and processor time of a report, ms."""
    seconds, peaks = located_log(table.path, log, folder / "fixes.jsonl", jobs)
    used = 1e3 * sum(peaks.seconds.values()) / count
    print(f"log: {count / seconds:.0f} reports a second, {used:.2f} ms of processor time each, starts included")
    for pid, most in peaks.each.items():
        sizes = "  ".join(f"{kind} {size:5.0f}" for kind, size in most.items())
        name = " ".join(peaks.names[pid].split())
        print(f"    {sizes} MB  {peaks.seconds[pid]:6.1f} s  {name[:60]}")
    print(
        "    together: " + "  ".join(f"{kind} {size:.0f}" for kind, size in peaks.together.items()) + " MB", flush=True
    )
    return seconds, used


def _processor_seconds() -> float:
    """Processor time of this process and its children so far, s."""
    process = psutil.Process()
    return sum(each.user + each.system for each in (one.cpu_times() for one in [process, *process.children(True)]))


if __name__ == "__main__":
    main()
