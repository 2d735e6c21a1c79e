"""The table of a benchmark: one from the command line, or the bundled hall's, which is built first."""

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rayfix.example.files import write_example
from rayfix_offline.build import build_table
from rayfix_tables.checked import open_checked
from rayfix_tables.table import Table


def table_parser(description: str | None, *, seed: int = 2026) -> argparse.ArgumentParser:
    """Return the command line of a benchmark on one table: ``--table`` and ``--seed``, to which it adds its own."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path, help="a table; the bundled hall's is built when left out")
    parser.add_argument("--seed", type=int, default=seed)
    return parser


@contextmanager
def open_or_build(path: Path | None) -> Iterator[Table]:
    """Open a table; without a path, the bundled hall's is built into a folder that goes away afterwards.

    Raises
    ------
    TableError
        When the table cannot be opened.
    """
    if path is not None:
        yield open_checked(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        print("building the hall's table ...", flush=True)
        summary = build_table(write_example(folder), Path(folder) / "hall.h5")
        print(f"{summary.num_bytes / 1e6:.0f} MB in {summary.seconds:.0f} s")
        yield Table.open(Path(folder) / "hall.h5")
