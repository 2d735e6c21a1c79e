"""Tables from files that may be damaged: a separate process checks them before this one maps them.

A damaged file can make the HDF5 library crash, hang or use any amount of memory. The check runs with limits in a
separate process and returns the offsets of the arrays. This process reads them from the mapped file, without HDF5.
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
"""Errors that are permanent for a version of a file; any other may not occur at the next attempt."""

_START = f"""\
import sys
sys.path[:] = sys.argv.pop(1).split({os.pathsep!r})
from rayfix_tables.checking import main
main(sys.argv[1:])
"""  # the same import path as in this process
_NO_THREADS = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
_REMEDY = "restore it from a copy or build it again"
_LOOK_SECONDS = 0.1  # between two tests whether a check was cancelled
_OWN_SECONDS = 1  # for the start of the check's process
_PATIENCE = 20  # wall-clock limit divided by that of processor time: a machine can be busy


@dataclass(frozen=True, kw_only=True)
class CheckLimits:
    """Limits of the check of a table.

    Attributes
    ----------
    seconds : float
        Processor time for any table.
    seconds_per_gigabyte : float
        Additional processor time for each 10^9 bytes of the file.
    memory : int
        Memory, bytes, in addition to three times the file's size, which includes the file itself.
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
    """Check a table file in a separate process, and map it.

    Parameters
    ----------
    path : str or Path
    whole : bool
        Whether to read every byte and compare the checksums, instead of only reading the metadata and small arrays.
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
        When it is damaged, or reading it crashes or exceeds a limit.
    """
    with open_table_file(Path(path)) as opened:
        return table_of_verdict(opened, check_file(opened, whole=whole, limits=limits or _DEFAULT_LIMITS))


def table_of_verdict(opened: OpenFile, verdict: Mapping[str, Any]) -> Table:
    """Make the table of a file from the result of :func:`check_file`.

    Raises
    ------
    TableError
        When the check refused it.
    """
    if "error" in verdict:
        raise getattr(errors, verdict["error"])(verdict["message"])
    with damage_reported(opened.path):
        return Table.of_layout(opened.path, FileLayout.from_document(verdict["layout"]), opened.mapped())


def check_file(
    opened: OpenFile, *, whole: bool, limits: CheckLimits, given_up: threading.Event | None = None
) -> dict[str, Any]:
    """Check a file in a separate process.

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
        raise TableError(f"{opened.path} changed while it was read; write a table under another name and rename it")
    if process.returncode == -signal.SIGKILL:
        why = f"it took more than {patience} s, or was ended from outside"
        raise TableError(f"{opened.path} cannot be checked now ({why}); try again when the machine is less busy")
    return _verdict(opened, process.returncode, output, complaint, seconds)


def _wait(process: subprocess.Popen[bytes], seconds: float, given_up: threading.Event | None) -> tuple[bytes, bytes]:
    """Wait for the check, and end it after the time limit."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            return process.communicate(timeout=_LOOK_SECONDS)
        except subprocess.TimeoutExpired:
            if time.monotonic() > deadline or (given_up is not None and given_up.is_set()):
                process.kill()
        except BaseException:  # Ctrl-C must also end the check
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
