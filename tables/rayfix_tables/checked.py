"""Tables from files that need not be whole: checked in a process of its own before this one maps them.

A damaged file can crash the HDF5 library, hold it for ever, or have it take any amount of memory. The check runs within
limits, in a process that has nothing else to lose. It tells where the arrays lie; this process reads them from the
mapped file and never gives the file to HDF5.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rayfix_tables import errors
from rayfix_tables.disk.files import OpenFile, open_table_file
from rayfix_tables.disk.layout import FileLayout, damage_reported
from rayfix_tables.errors import CorruptTableError, FormatVersionError, NotATableError, TableError
from rayfix_tables.table import Table

VERDICTS = (CorruptTableError, FormatVersionError, NotATableError)
"""Errors that hold for a version of a file for good; any other may be over at the next try."""

_START = f"""\
import sys
sys.path[:] = sys.argv.pop(1).split({os.pathsep!r})
from rayfix_tables.checking import main
main(sys.argv[1:])
"""  # finds what this process finds, wherever that comes from
_NO_THREADS = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
_REMEDY = "restore it from a copy or build it again"
_LOOK_SECONDS = 0.1  # between two looks at whether a check was called off
_OWN_SECONDS = 1  # of the check's own start
_PATIENCE = 20  # times the processor time: a busy machine has other work, too


@dataclass(frozen=True, kw_only=True)
class CheckLimits:
    """What the check of a table may take.

    Attributes
    ----------
    seconds : float
        Processor time for any table.
    seconds_per_gigabyte : float
        Processor time besides for each 10^9 bytes of the file.
    memory : int
        Memory, bytes, besides three times the file's size, of which the file itself is one.
    """

    seconds: float = 10.0
    seconds_per_gigabyte: float = 60.0
    memory: int = 256_000_000

    def seconds_for(self, size: int) -> int:
        """Processor time for a file of a size, s."""
        return max(1, round(self.seconds + self.seconds_per_gigabyte * size / 1e9))

    def memory_for(self, size: int) -> int:
        """Memory for a file of a size, bytes."""
        return self.memory + 3 * size


_DEFAULT_LIMITS = CheckLimits()


def open_checked(path: str | Path, *, whole: bool = True, limits: CheckLimits | None = None) -> Table:
    """Map a table file that was checked in a process of its own.

    Parameters
    ----------
    path : str or Path
    whole : bool
        Whether to read every byte and compare the checksums, and not only to read what the table holds.
    limits : CheckLimits, optional

    Raises
    ------
    TableError
        When the file is missing, or cannot be checked now.
    NotATableError
        When it is not a rayfix table.
    FormatVersionError
        When another version of rayfix wrote it.
    CorruptTableError
        When it is damaged, or reading it crashes, takes too long or too much memory.
    """
    with open_table_file(Path(path)) as opened:
        return table_of_verdict(opened, check_file(opened, whole=whole, limits=limits or _DEFAULT_LIMITS))


def table_of_verdict(opened: OpenFile, verdict: Mapping[str, Any]) -> Table:
    """Make the table of a file from what :func:`check_file` found.

    Raises
    ------
    TableError
        When it was refused.
    """
    if "error" in verdict:
        raise getattr(errors, verdict["error"])(verdict["message"])
    with damage_reported(opened.path):
        return Table.of_layout(opened.path, FileLayout.from_document(verdict["layout"]), opened.mapped())


def check_file(
    opened: OpenFile, *, whole: bool, limits: CheckLimits, given_up: threading.Event | None = None
) -> dict[str, Any]:
    """Check a file in a process of its own.

    Parameters
    ----------
    whole : bool
        Whether to compare the checksums.
    given_up : threading.Event, optional
        Ends the check early.

    Returns
    -------
    dict
        JSON-compatible: the ``layout``, or the ``error`` (one of ``VERDICTS``) and its ``message``. It holds for this
        version of the file.

    Raises
    ------
    TableError
        When the file cannot be checked now.
    """
    seconds = limits.seconds_for(opened.size)
    patience = _PATIENCE * seconds + _OWN_SECONDS
    arguments = [str(opened.path), str(seconds), str(limits.memory_for(opened.size)), str(int(whole))]
    try:
        with subprocess.Popen(
            [sys.executable, "-P", "-c", _START, os.pathsep.join(sys.path), *arguments],
            stdin=opened.descriptor,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, **_NO_THREADS},
        ) as process:
            output, complaint = _wait(process, patience, given_up)
    except OSError as error:
        raise TableError(f"{opened.path} cannot be checked now ({error.strerror}); try again") from error
    if not opened.unchanged:
        raise TableError(f"{opened.path} changed while it was read; write tables beside and rename them into place")
    if process.returncode == -signal.SIGKILL:
        why = f"it took more than {patience} s, or was ended from outside"
        raise TableError(f"{opened.path} cannot be checked now ({why}); try again when the machine is less busy")
    return _verdict(opened, process.returncode, output, complaint, seconds)


def _wait(process: subprocess.Popen[bytes], seconds: float, given_up: threading.Event | None) -> tuple[bytes, bytes]:
    """Wait for the check to end, and end it after that time."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            return process.communicate(timeout=_LOOK_SECONDS)
        except subprocess.TimeoutExpired:
            if time.monotonic() > deadline or (given_up is not None and given_up.is_set()):
                process.kill()
        except BaseException:  # Ctrl-C must not leave it behind
            process.kill()
            raise


def _verdict(opened: OpenFile, status: int, output: bytes, complaint: bytes, seconds: int) -> dict[str, Any]:
    if status == 0:
        document: dict[str, Any] = json.loads(output)
        return document
    if status > 0:
        last = complaint.decode("utf-8", "replace").strip().splitlines()[-1:]
        raise TableError(f"{opened.path} cannot be checked ({' '.join(last) or f'status {status}'}); mend rayfix first")
    if status == -signal.SIGXCPU:
        what = f"reading it takes more than {seconds} s of processor time"
    else:
        what = f"reading it ends in a crash ({signal.Signals(-status).name})"
    return {"error": "CorruptTableError", "message": f"{opened.path} is damaged: {what}; {_REMEDY}"}
