"""Opens a table with one changed byte after the other, in a separate process, because such a file can crash HDF5.

As a program it takes the table, the first place and the distance of the places, and writes a line of JSON for each
place: the problem, or null and a digest of the table's content.
"""

import hashlib
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from rayfix_tables.errors import TableError
from rayfix_tables.mixture import FIELD_SHAPES
from rayfix_tables.table import Table

_CHANGE = 0x55


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of a changed byte: the problem, or the digest of what was read, or neither if the process crashed."""

    place: int
    problem: str | None = None
    digest: str | None = None


def outcomes_of_changes(table: Path, copy: Path, places: range) -> list[Outcome]:
    """Change the bytes at these places of a table, one at a time, in a copy, and open and verify it."""
    outcomes: list[Outcome] = []
    while len(outcomes) < len(places):
        rest = places[len(outcomes) :]
        command = [sys.executable, "-m", __name__, str(table), str(copy), str(rest.start), str(rest.step)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
        lines = done.stdout.splitlines()
        outcomes += [Outcome(place=rest[n], **json.loads(line)) for n, line in enumerate(lines)]
        assert done.returncode <= 0, done.stderr
        if done.returncode < 0:
            outcomes.append(Outcome(place=rest[len(lines)]))
    return outcomes


def content_digest(table: Table) -> str:
    """Return a digest of all that decides an answer."""
    scene = table.scene
    arrays: list[NDArray[Any]] = [scene.vertices, scene.faces, scene.face_materials, scene.free_space.free]
    words = [repr(table.site), repr(scene.materials), repr(scene.free_space.origin)]
    for part in table.parts.values():
        words.append(repr((part.station, part.lost_ray_share, part.coverage)))
        for level in part.levels:
            words.append(repr(level.window))
            arrays += [level.grid.ring_cells, level.cell_offsets, level.cell_log_mass]
            arrays += [getattr(level.mixture, name) for name in FIELD_SHAPES]
    digest = hashlib.sha256()
    for content in (*(word.encode() for word in words), *(array.tobytes() for array in arrays)):
        digest.update(len(content).to_bytes(8))
        digest.update(content)
    return digest.hexdigest()


def _main(path: Path, copy: Path, first: int, step: int) -> None:
    content = path.read_bytes()
    for place in range(first, len(content), step):
        changed = bytearray(content)
        changed[place] ^= _CHANGE
        copy.write_bytes(changed)
        try:
            table = Table.open(copy)
            table.verify()
            found = {"digest": content_digest(table)}
        except TableError as error:
            found = {"problem": str(error)}
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    _main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
