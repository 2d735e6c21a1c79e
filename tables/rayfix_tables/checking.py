"""The check of a table file, as a separate program.

A damaged file can make HDF5 crash or hang. Processes that must not crash or hang let this program read it;
:mod:`rayfix_tables.checked` starts it. The open file is the program's standard input; PATH is its name in messages. The
output is JSON: the layout of the file, or why it is refused.
"""

import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

from rayfix_tables.disk.files import OpenFile, state_of
from rayfix_tables.disk.layout import damage_reported, read_layout
from rayfix_tables.errors import TableError
from rayfix_tables.table import Table


def main(arguments: list[str]) -> None:
    """Check the file of the standard input.

    Parameters
    ----------
    arguments : list of str
        Name of the file, processor time [s], memory [bytes], and 1 to compare its checksums, 0 not to.
    """
    path, seconds, memory, whole = Path(arguments[0]), int(arguments[1]), int(arguments[2]), arguments[3] == "1"
    limit_this_process(seconds=seconds, memory=memory)
    opened = OpenFile(path=path, descriptor=0, state=state_of(os.fstat(0)))
    try:
        text = json.dumps(check(opened, whole=whole))
    except TableError as error:
        text = json.dumps({"error": type(error).__name__, "message": str(error)})
    sys.stdout.write(text)
    sys.stdout.flush()
    os._exit(0)  # skips HDF5's cleanup at exit, which may fail on a damaged file


def check(opened: OpenFile, *, whole: bool) -> dict[str, Any]:
    """Read and check the layout of a table; returns the layout's document.

    Parameters
    ----------
    whole : bool
        Whether to read every byte and compare the checksums.

    Raises
    ------
    TableError
        When the file is not an intact table.
    """
    with damage_reported(opened.path):
        layout = read_layout(opened)
        table = Table.of_layout(opened.path, layout, opened.mapped())
        if whole:
            table.verify()
        return {"layout": layout.to_document()}


def limit_this_process(*, seconds: int, memory: int) -> None:
    """Limit this process's processor time [s] and additional memory [bytes], and forbid it to write files."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    address_space = pages * resource.getpagesize() + memory
    resource.setrlimit(resource.RLIMIT_AS, (address_space, address_space))
    spent = resource.getrusage(resource.RUSAGE_SELF)
    seconds += int(spent.ru_utime + spent.ru_stime) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
