"""Checks of tables' files, one for each version of a file whatever the number of workers."""

import contextlib
import hashlib
import json
import os
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rayfix_tables.checked import CheckLimits, check_file, table_of_verdict
from rayfix_tables.disk.files import FileState, OpenFile, open_table_file
from rayfix_tables.disk.ownership import try_lock
from rayfix_tables.errors import TableError
from rayfix_tables.table import Table

_MOST_KEPT = 256  # verdicts on files that are long gone are removed
_LOOK_SECONDS = 0.05  # between two looks at whether another worker has done its check

Verdict = dict[str, Any]
"""What :func:`rayfix_tables.checked.check_file` returns."""


class TableChecks:
    """Opens tables that have passed a check in a process of its own.

    A file that was refused is not checked again unless it changes.

    Parameters
    ----------
    folder : pathlib.Path, optional
        Common folder of the workers of a service. What one of them has checked, the others do not check again.
    limits : CheckLimits, optional
        What a check may take.
    """

    def __init__(self, folder: Path | None = None, limits: CheckLimits | None = None) -> None:
        self._folder = None if folder is None else folder / "checks"
        self._limits = limits or CheckLimits()
        self._refusals: dict[str, Verdict] = {}

    def open(self, path: Path, given_up: threading.Event | None = None) -> tuple[Table, FileState]:
        """Open a table, which is checked if this version of its file was not; returns it with the file's state.

        Parameters
        ----------
        given_up : threading.Event, optional
            Ends the check early.

        Raises
        ------
        TableError
            When the file is no whole table, or cannot be checked now.
        """
        with open_table_file(path) as opened:
            verdict = self._known(opened)
            if verdict is None:
                with self._locked(opened, given_up):
                    verdict = self._known(opened)
                    if verdict is None:
                        verdict = check_file(opened, whole=True, limits=self._limits, given_up=given_up)
                        self._keep(opened, verdict)
            return table_of_verdict(opened, verdict), opened.state

    def note_loaded(self, path: Path, state: FileState) -> None:
        """Record for the other processes that a table has passed its check and could be loaded."""
        if self._folder is not None:
            with contextlib.suppress(OSError):
                (self._folder / f"{_key(path, state)}.loaded").touch()

    def open_loaded(self, path: Path) -> tuple[Table, FileState] | None:
        """Open a table that a worker has loaded; None for one that none has."""
        try:
            with open_table_file(path) as opened:
                loaded = self._folder is not None and (self._folder / f"{_key(path, opened.state)}.loaded").exists()
                verdict = self._known(opened) if loaded else None
                if verdict is None or "error" in verdict:
                    return None
                return table_of_verdict(opened, verdict), opened.state
        except TableError:
            return None

    def _known(self, opened: OpenFile) -> Verdict | None:
        key = _key(opened.path, opened.state)
        if key in self._refusals or self._folder is None:
            return self._refusals.get(key)
        try:
            verdict: Verdict = json.loads((self._folder / f"{key}.json").read_bytes())
        except (OSError, ValueError):
            return None
        self._remember(key, verdict)
        return verdict

    def _keep(self, opened: OpenFile, verdict: Verdict) -> None:
        key = _key(opened.path, opened.state)
        self._remember(key, verdict)
        if self._folder is None:
            return
        with contextlib.suppress(OSError):  # a full disk costs the other workers a check
            partial = self._folder / f"{uuid.uuid4().hex}.partial"
            try:
                partial.write_text(json.dumps(verdict), encoding="ascii")
                partial.replace(self._folder / f"{key}.json")
            finally:
                partial.unlink(missing_ok=True)
            by_age = sorted(self._folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)
            for path in by_age[:-_MOST_KEPT]:
                path.unlink(missing_ok=True)

    def _remember(self, key: str, verdict: Verdict) -> None:
        if "error" in verdict:
            self._refusals[key] = verdict
            while len(self._refusals) > _MOST_KEPT:
                del self._refusals[next(iter(self._refusals))]

    @contextlib.contextmanager
    def _locked(self, opened: OpenFile, given_up: threading.Event | None) -> Iterator[None]:
        """Keep other workers from the check of the same file."""
        descriptor = None
        if self._folder is not None:
            with contextlib.suppress(OSError):
                self._folder.mkdir(exist_ok=True)
                descriptor = os.open(
                    self._folder / f"{_key(opened.path, opened.state)}.lock",
                    os.O_RDWR | os.O_CREAT | os.O_CLOEXEC,
                    0o600,
                )
        if descriptor is None:
            yield
            return
        try:
            while try_lock(descriptor) is False and not (given_up is not None and given_up.is_set()):
                time.sleep(_LOOK_SECONDS)
            yield
        finally:
            os.close(descriptor)


def _key(path: Path, state: FileState) -> str:
    """Name of a version of a file."""
    return hashlib.sha256(os.fsencode(path) + json.dumps(state).encode()).hexdigest()
