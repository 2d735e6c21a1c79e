"""Kills workers and their service under load, and puts invalid files among its tables.

    python -m benchmarks.robustness.kills [--table hall.h5] [--workers 200] [--parents 20] [--bad-files 50]

In random order, workers of a service with two of them are killed, one or all at once, now and then their successors
right away; the first process is killed and started again; bad files are put beside the good table, and some in its
place for a moment. Each time the good table must answer again within `--limit` seconds, with two workers, and no
answer may be 5xx but 503. What the service's processes wait for a processor that has other work does not count for
that; both figures are printed. A new service removes the folders of those that were killed, and the last one leaves
none.
"""

import http.client
import json
import os
import random
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import psutil

from benchmarks.common.example_table import open_or_build, table_parser
from benchmarks.common.held_up import HeldUp
from benchmarks.common.running_service import RunningService, serve_command
from rayfix_tables.table import Table

WORKERS = 2


def located(port: int, report: bytes, *, seconds: float = 5.0) -> int | None:
    """Post a report on a connection of its own; returns the status, None where the connection breaks."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=seconds)
    try:
        connection.request("POST", "/v1/positions?table=good", report, {"Content-Type": "application/json"})
        response = connection.getresponse()
        response.read()
    except (OSError, http.client.HTTPException):
        return None
    finally:
        connection.close()
    return response.status


class Load:
    """Threads that post reports to wherever the service is, and count the answers."""

    def __init__(self, report: bytes, *, threads: int = 2) -> None:
        self.port: int | None = None
        self.statuses: Counter[int | None] = Counter()
        self._report = report
        self._end = threading.Event()
        self._threads = [threading.Thread(target=self._run, daemon=True) for _ in range(threads)]
        for thread in self._threads:
            thread.start()

    def _run(self) -> None:
        while not self._end.wait(0.01):
            if self.port is not None:
                self.statuses[located(self.port, self._report)] += 1

    def close(self) -> None:
        """End them."""
        self._end.set()
        for thread in self._threads:
            thread.join()


class Attack:
    """A service of one good table, and what is done to it."""

    def __init__(self, table: Path, folder: Path, seed: int, limit: float) -> None:
        self._rng = random.Random(seed)
        self._limit = limit
        self._temporary = folder / "temporary"
        self._temporary.mkdir()
        self._tables = folder / "tables"
        self._tables.mkdir()
        self._good = Path(shutil.copy(table, folder / "good.h5"))
        self._content = self._good.read_bytes()
        shutil.copy(self._good, self._tables / "good.h5")
        report = report_for(table)
        self.load = Load(report)
        self._report = report
        self.faults: list[str] = []
        self.slowest: dict[str, tuple[float, float]] = {}
        self.service = self._start()

    def _start(self) -> RunningService:
        os.environ["TMPDIR"] = str(self._temporary)
        service = RunningService(serve_command(self._tables, "--workers", str(WORKERS)))
        self._held_up = HeldUp(service.process.pid, whole=True)
        try:
            service.wait_until_ready(meanwhile=self._held_up.look)
        except RuntimeError:
            service.close()
            raise
        self.load.port = service.port
        return service

    def workers(self) -> list[psutil.Process]:
        """Return the processes that answer; checks of tables are processes of their children."""
        return [child for child in psutil.Process(self.service.process.pid).children() if child.is_running()]

    def kill_workers(self) -> None:
        """Kill one worker or all, and now and then the successors as soon as they are there."""
        for _ in range(2 if self._rng.random() < 0.1 else 1):
            victims = self.workers()
            if self._rng.random() < 0.6:
                victims = self._rng.sample(victims, min(1, len(victims)))
            for victim in victims:
                with_no_process(victim.kill)
            begin = self._begin()
            killed = {victim.pid for victim in victims}
        self._recovered("worker killed", begin, without=killed)

    def kill_parent(self) -> None:
        """Kill the first process, wait for its workers to end, and start it again."""
        workers = self.workers()
        self.service.process.kill()
        self.load.port = None
        begin = time.monotonic()
        _, alive = psutil.wait_procs(workers, timeout=self._limit + 15.0)
        if alive:
            self.faults.append(f"{len(alive)} workers outlive their service")
        self.service.close()
        self._note("workers of a killed service ended", time.monotonic() - begin, limit=15.0)
        begin = time.monotonic()
        self.service = self._start()
        self._recovered("service started again", begin)
        folders = list(self._temporary.glob("rayfix-serve-*"))
        if len(folders) != 1:
            self.faults.append(f"{len(folders)} folders of services after a start")

    def drop_bad_file(self) -> None:
        """Put a bad file beside the good one or in its place, and a good one again."""
        name = "good.h5" if self._rng.random() < 0.2 else "bad.h5"
        self._put(self._bad_content(), name)
        time.sleep(self._rng.uniform(0.0, 3.0))
        if self._rng.random() < 0.3:
            self.kill_workers()
        begin = self._begin()
        if name == "good.h5":
            self._put(self._content, name)
        self._recovered("bad file", begin)
        (self._tables / "bad.h5").unlink(missing_ok=True)

    def _bad_content(self) -> bytes:
        rng, content = self._rng, bytearray(self._content)
        match rng.randrange(5):
            case 0:
                return b""
            case 1:
                return rng.randbytes(10_000)
            case 2:
                return bytes(content[: rng.randrange(len(content))])
            case 3:
                return b"\x89HDF\r\n\x1a\n" + rng.randbytes(5000)
        for _ in range(rng.randrange(1, 50)):
            content[rng.randrange(min(len(content), 20_000))] ^= 1 << rng.randrange(8)
        return bytes(content)

    def _put(self, content: bytes, name: str) -> None:
        beside = self._tables / f"{name}.new"
        beside.write_bytes(content)
        os.replace(beside, self._tables / name)

    def _begin(self) -> float:
        self._held_up = HeldUp(self.service.process.pid)
        return time.monotonic()

    def _recovered(self, what: str, begin: float, *, without: frozenset[int] | set[int] = frozenset()) -> None:
        """Wait until the good table answers and there are two workers, none of them one that was killed."""
        while True:
            there = {child.pid for child in self.workers()} - without
            if located(self.service.port, self._report) == 200 and len(there) >= WORKERS:
                break
            if time.monotonic() - begin > 10 * self._limit or self.service.process.poll() is not None:
                raise RuntimeError(f"{what}: the service does not answer any more\n{self.service.log()[-3000:]}")
            time.sleep(0.02)
            self._held_up.look()
        self._note(what, time.monotonic() - begin, held_up=self._held_up.seconds(), limit=self._limit)

    def _note(self, what: str, took: float, *, held_up: float = 0.0, limit: float) -> None:
        own = took - held_up
        slowest, slowest_own = self.slowest.get(what, (0.0, 0.0))
        self.slowest[what] = max(slowest, took), max(slowest_own, own)
        if own > limit:
            self.faults.append(f"{what}: {own:.1f} s and {held_up:.1f} s of waiting for a processor")

    def close(self) -> None:
        """End all and look what is left."""
        self.load.close()
        self.service.close()
        if left := list(self._temporary.glob("rayfix-serve-*")):
            self.faults.append(f"{len(left)} folders are left")
        for status, count in self.load.statuses.items():
            if status is not None and status >= 500 and status != 503:
                self.faults.append(f"{count} answers {status}")


def report_for(table: Path) -> bytes:
    """Write a report of a station of a table."""
    (first, *_) = Table.open(table).site.stations
    measurement = {"type": "aoa", "station_id": first.id, "azimuth_deg": 40.0, "azimuth_stdev_deg": 2.0}
    return json.dumps({"measurements": [measurement]}).encode()


def with_no_process(kill: object) -> None:
    """Kill a process that may have ended."""
    try:
        kill()  # type: ignore[operator]
    except psutil.NoSuchProcess:
        return


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--workers", type=int, default=200, help="kills of workers; default 200")
    parser.add_argument("--parents", type=int, default=20, help="kills of the first process; default 20")
    parser.add_argument("--bad-files", type=int, default=50, help="default 50")
    parser.add_argument("--limit", type=float, default=5.0, help="s until all is well again; default 5")
    parser.add_argument("--seconds", type=float, default=3600.0, help="when to end earlier, which is an error")
    options = parser.parse_args()
    with open_or_build(options.table) as table, tempfile.TemporaryDirectory() as folder:
        faults = run(
            table.path,
            Path(folder),
            counts=(options.workers, options.parents, options.bad_files),
            seed=options.seed,
            limit=options.limit,
            seconds=options.seconds,
        )
    if faults:
        sys.exit("a bound does not hold: " + "; ".join(faults[:20]))


def run(
    table: Path, folder: Path, *, counts: tuple[int, int, int], seed: int, limit: float, seconds: float
) -> list[str]:
    """Do it; returns what did not hold."""
    attack = Attack(table, folder, seed, limit)
    kinds = (attack.kill_workers, attack.kill_parent, attack.drop_bad_file)
    todo = [kind for kind, count in zip(kinds, counts, strict=True) for _ in range(count)]
    rng = random.Random(seed + 1)
    rng.shuffle(todo)
    begin, done = time.monotonic(), Counter[str]()
    try:
        for do in todo:
            if time.monotonic() - begin > seconds:
                attack.faults.append(f"only {sum(done.values())} of {len(todo)} were done in {seconds:g} s")
                break
            time.sleep(rng.uniform(0.0, 0.5))
            do()
            done[do.__name__] += 1
            if sum(done.values()) % 20 == 0:
                print(f"{time.monotonic() - begin:6.0f} s  {dict(done)}  {len(attack.faults)} faults", flush=True)
    finally:
        attack.close()
    print(f"done: {dict(done)} in {time.monotonic() - begin:.0f} s")
    for what, (took, own) in attack.slowest.items():
        print(f"{what}: at most {took:.2f} s, without waiting for a processor at most {own:.2f} s")
    print("answers under load:", {status or "no answer": count for status, count in attack.load.statuses.items()})
    return attack.faults


if __name__ == "__main__":
    main()
