"""Kill builds of the hall at random moments, resume them, and compare the tables with that of an uninterrupted build.

A build is killed (SIGKILL) after it has saved a shard, at a time that is uniform over the rest of an uninterrupted
build, including the writing of the table. The build that resumes it is killed in the same way, until one finishes
before its time. Its table is compared, and the next build starts from scratch. Exit status 1 when a table differs.
"""

import argparse
import math
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rayfix.example.files import write_example
from rayfix_offline.job.shards import ShardStore
from rayfix_tables.table import Table

POLL = 0.005
"""Pause between two looks at the shards, s."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--windows", type=float, nargs="+", default=[5.0, 15.0], metavar="DEG", help="default: 5 15")
    parser.add_argument("--jobs", type=int, default=-1, help="cells fitted at a time (default: one per core)")
    parser.add_argument("--minutes", type=float, default=60.0, help="kill no further build after that (default 60)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    deadline = time.monotonic() + 60.0 * options.minutes
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        site = write_example(folder, windows_deg=tuple(options.windows))
        whole = folder / "whole.h5"
        finish(start(site, whole, options.jobs))
        expected = Table.open(whole).table_id
        whole.unlink()
        rest = rest_of_build(site, whole, options.jobs)  # the first build may have compiled
        whole.unlink()
        print(f"an uninterrupted build ends {rest:.1f} s after its first shard, table {expected[:16]}", flush=True)
        kept = {path.name for path in folder.iterdir()}
        kills = tables = same = 0
        table = folder / "hall.h5"
        chain: list[int] = []
        while True:
            last = kills == options.kills or time.monotonic() > deadline
            shards = kill_after(math.inf if last else rng.uniform(0.0, rest), site, table, options.jobs)
            if shards is not None:
                kills += 1
                chain.append(shards)
                continue
            found = Table.open(table).table_id
            left = {path.name for path in folder.iterdir()} - kept - {table.name}
            if chain:
                good = found == expected and not left
                tables += 1
                same += good
                verdict = "equal" if good else "DIFFERS" if found != expected else f"left behind: {sorted(left)}"
                print(
                    f"killed with {', '.join(map(str, chain))} shards saved: table {found[:16]} {verdict}", flush=True
                )
            table.unlink()
            chain = []
            if last:
                break
    print(f"{kills} builds killed; {same} of {tables} tables equal to that of the uninterrupted build")
    sys.exit(0 if kills and same == tables else 1)


def start(site: Path, table: Path, jobs: int) -> subprocess.Popen[bytes]:
    """Start a build."""
    command = [sys.executable, "-m", "rayfix", "build", str(site), "-o", str(table), "--no-progress"]
    return subprocess.Popen([*command, "--jobs", str(jobs)], stdout=subprocess.DEVNULL)


def finish(process: subprocess.Popen[bytes]) -> None:
    """Wait for a build that must succeed."""
    if process.wait() != 0:
        raise SystemExit(f"the build ended with exit status {process.returncode}")


def wait_for_shard(process: subprocess.Popen[bytes], table: Path, before: int) -> None:
    """Wait until a build has saved another block of cells, or has ended."""
    while process.poll() is None and num_shards(table) <= before:
        time.sleep(POLL)


def rest_of_build(site: Path, table: Path, jobs: int) -> float:
    """Time from an uninterrupted build's first shard to its end, s."""
    process = start(site, table, jobs)
    wait_for_shard(process, table, 0)
    begin = time.monotonic()
    finish(process)
    return time.monotonic() - begin


def kill_after(delay: float, site: Path, table: Path, jobs: int) -> int | None:
    """Kill a build this long after it saved a shard [s]; how many shards there are then, None if it was done before."""
    before = num_shards(table)
    process = start(site, table, jobs)
    wait_for_shard(process, table, before)
    try:
        process.wait(None if math.isinf(delay) else delay)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.returncode == 0:
        return None
    if process.returncode != -signal.SIGKILL:
        raise SystemExit(f"the build ended with exit status {process.returncode}")
    return num_shards(table)


def num_shards(table: Path) -> int:
    """Count the finished blocks of cells of a table to be."""
    folder = ShardStore.beside(table).folder
    if not folder.is_dir():
        return 0
    return sum(not path.name.endswith("-launch") and ".partial" not in path.name for path in folder.iterdir())


if __name__ == "__main__":
    main()
