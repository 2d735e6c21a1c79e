"""Flips single bits of a table and checks each of the files in a process of its own.

As a program it takes the path of a table, a seed, how many bits, and seconds of processor time for each, and writes
what became of each, a JSON list a line: place, bit, status of the process, message or ``table_id``. It forks them,
which a process with threads must not; to start Python for each takes a hundred times as long.
"""

import json
import os
import random
import resource
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import h5py

from rayfix_tables.checking import check, limit_this_process
from rayfix_tables.disk.files import open_table_file
from rayfix_tables.disk.schema import read_text
from rayfix_tables.errors import TableError

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
    command = [sys.executable, "-m", "tests.support.table_flips", str(table), str(seed), str(count), str(seconds)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60 + 2 * seconds * count)
    assert done.stderr == ""
    names = ("place", "bit", "status", "accepted", "text")
    return [Outcome(**dict(zip(names, json.loads(line), strict=True))) for line in done.stdout.splitlines()]


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


def main(table: Path, seed: int, count: int, seconds: int) -> None:
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


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
