"""Flips single bits of a table and checks each of the files in a separate process.

    python -m benchmarks.robustness.flips [--table hall.h5] [--runs 5] [--count 1000] [--seed 2026]

Half of the bits are in HDF5's metadata. A file with a flipped bit is refused in one line, or it is the same
table by its ``table_id``, or its check is ended by a signal, at its limit of processor time or memory; anything else
is a fault. Without a table, a small one is built.

With ``--flip`` it is the process that forks the checks, because a process with threads must not fork. It writes each
result as a line of JSON: offset, bit, status of the process, message or ``table_id``. Starting Python for each check
would take a hundred times as long.
"""

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import h5py

from rayfix_tables.checking import check, limit_this_process
from rayfix_tables.disk.files import open_table_file
from rayfix_tables.disk.schema import read_text
from rayfix_tables.errors import TableError
from rayfix_tables.table import Table
from tests.support.tables.random_tables import random_content

MEMORY = 256_000_000


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a table with one flipped bit.

    Attributes
    ----------
    place, bit : int
    status : int
        Of the check: 0 if it has an answer, -N if signal N ended it.
    accepted : bool
    text : str
        The ``table_id`` or why it was refused.
    """

    place: int
    bit: int
    status: int
    accepted: bool
    text: str


def flip_bits(table: Path, *, seed: int, count: int, seconds: int = 1) -> list[Outcome]:
    """Check that many copies of a table with one flipped bit each; half of them in HDF5's own administration."""
    command = [
        sys.executable,
        "-m",
        "benchmarks.robustness.flips",
        "--flip",
        str(table),
        str(seed),
        str(count),
        str(seconds),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60 + 2 * seconds * count)
    assert done.stderr == ""
    names = ("place", "bit", "status", "accepted", "text")
    return [Outcome(**dict(zip(names, json.loads(line), strict=True))) for line in done.stdout.splitlines()]


def faults_of(table: Path, outcomes: list[Outcome]) -> list[Outcome]:
    """Return the outcomes that no check should have."""
    expected, copy = Table.open(table).table_id, str(table.with_suffix(".flipped"))

    def is_sound(outcome: Outcome) -> bool:
        if outcome.status != 0:
            return outcome.status < 0  # a signal, which costs nobody but the check
        if outcome.accepted:
            return outcome.text == expected
        return "\n" not in outcome.text and copy in outcome.text

    return [outcome for outcome in outcomes if not is_sound(outcome)]


def places(table: Path, seed: int, count: int) -> list[tuple[int, int]]:
    """Places and bits, in turns of the administration and of the whole file."""
    with h5py.File(table) as file:
        data: set[int] = set()

        def gather(name: str, node: h5py.Group | h5py.Dataset) -> None:
            if isinstance(node, h5py.Dataset) and node.size:
                data.update(range(node.id.get_offset(), node.id.get_offset() + node.nbytes))

        file.visititems(gather)
    size = table.stat().st_size
    others = [place for place in range(size) if place not in data]
    rng = random.Random(seed)
    return [(rng.choice(others) if n % 2 else rng.randrange(size), rng.randrange(8)) for n in range(count)]


def flipped(content: bytes, place: int, bit: int) -> bytes:
    """Return the content with one bit flipped."""
    changed = bytearray(content)
    changed[place] ^= 1 << bit
    return bytes(changed)


def _flip(table: Path, seed: int, count: int, seconds: int) -> None:
    """Check the copies and write what became of them."""
    content, copy = table.read_bytes(), table.with_suffix(".flipped")
    for place, bit in places(table, seed, count):
        copy.write_bytes(flipped(content, place, bit))
        reading, writing = os.pipe()
        if (child := os.fork()) == 0:
            os.close(reading)
            _check(copy, writing, seconds)
        os.close(writing)
        with open(reading, "rb") as answers:
            answer = answers.read()
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps([place, bit, status, *(json.loads(answer) if answer else (False, ""))]))
    copy.unlink(missing_ok=True)


def _check(path: Path, writing: int, seconds: int) -> None:
    """Be the process of one check; it never returns."""
    signal.signal(signal.SIGXCPU, signal.SIG_DFL)
    limit_this_process(seconds=seconds, memory=MEMORY)
    try:
        with open_table_file(path) as opened:
            check(opened, whole=True)
            answer = json.dumps([True, _table_id(opened.path)])
    except TableError as error:
        answer = json.dumps([False, str(error)])
    os.write(writing, answer.encode())
    os._exit(0)


def _table_id(path: Path) -> str:
    with h5py.File(path) as file:
        return read_text(file, "table_id")


def peak_bytes_of_children() -> int:
    """Most memory that any process that has ended below this one has held."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path)
    parser.add_argument("--runs", type=int, default=5, help="each with a seed of its own; default 5")
    parser.add_argument("--count", type=int, default=1000, help="bits of a run; default 1000")
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    faults: list[Outcome] = []
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "table.h5"
        if options.table is None:
            random_content(1, num_stations=1, num_levels=1).write(table)
        else:
            shutil.copy(options.table, table)
        for run in range(options.runs):
            outcomes = flip_bits(table, seed=options.seed + run, count=options.count)
            ended = sum(outcome.status < 0 for outcome in outcomes)
            same = sum(outcome.accepted for outcome in outcomes)
            new = faults_of(table, outcomes)
            refused = len(outcomes) - ended - same
            print(
                f"seed {options.seed + run}: {refused} refused, {same} the same table, {ended} checks ended by a "
                f"signal, {len(new)} faults",
                flush=True,
            )
            faults += new
    for fault in faults[:20]:
        print(fault)
    if faults:
        sys.exit(f"a bound does not hold: {len(faults)} faults")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--flip"]:
        _flip(Path(sys.argv[2]), *map(int, sys.argv[3:]))
    else:
        main()
