"""The table that a benchmark runs on: one from the command line, or the bundled hall's, built for it."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rayfix.example.files import write_example
from rayfix_offline.build import build_table
from rayfix_tables.table import Table


@contextmanager
def open_or_build(path: Path | None) -> Iterator[Table]:
    """Open a table; without a path, the bundled hall's is built into a folder that goes away afterwards.

    Raises
    ------
    TableError
        When the table cannot be opened.
    """
    if path is not None:
        yield Table.open(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        print("building the hall's table ...", flush=True)
        summary = build_table(write_example(folder), Path(folder) / "hall.h5")
        print(f"{summary.num_bytes / 1e6:.0f} MB in {summary.seconds:.0f} s")
        yield Table.open(Path(folder) / "hall.h5")
