"""The tables that a process serves: found, verified, and swapped when their files change."""

import asyncio
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rayfix_service.fusion.locator import Locator
from rayfix_service.http.problems import INVALID_PARAMETER, NOT_FOUND, NOT_READY, ProblemError
from rayfix_service.http.telemetry.metrics import Metrics
from rayfix_service.tracking.tracker import Tracker
from rayfix_service.wire import FieldProblem
from rayfix_tables.errors import RayfixError, TableError
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

_log = logging.getLogger(__name__)

FileState = tuple[int, int, int] | None
"""What tells one version of a file from the next: inode, size and time; None for a missing file."""

Change = Literal["loaded", "unchanged", "removed", "refused"]


@dataclass(frozen=True, kw_only=True)
class ServedTable:
    """A table that answers.

    Attributes
    ----------
    name : str
        Its file's name without the suffix.
    locator : Locator
    tracker : Tracker
        Targets followed with this table; those of a table that is swapped begin anew.
    state : tuple of int
        Of the file that it was read from.
    """

    name: str
    locator: Locator
    tracker: Tracker
    state: FileState

    @property
    def site(self) -> SiteInfo:
        """Site of the table."""
        return self.locator.table.site


@dataclass(frozen=True, kw_only=True)
class TableChange:
    """What became of a table's file at a look at it; ``reason`` says why it was refused, without its folder."""

    name: str
    change: Change
    reason: str | None = None


@dataclass(frozen=True, kw_only=True)
class TableFiles:
    """Where tables come from: one file, or the ``*.h5`` of a folder."""

    path: Path

    def find(self) -> dict[str, Path]:
        """Return the files by the names of their tables, sorted.

        Raises
        ------
        TableError
            When a folder has none.
        """
        if not self.path.is_dir():
            return {self.path.stem: self.path}
        # A file that is being written has another suffix or, as those of rsync, a dot before its name.
        files = {path.stem: path for path in sorted(self.path.glob("*.h5")) if not path.name.startswith(".")}
        if not files:
            raise TableError(f"there is no table in {self.path}; put files T.h5 that 'rayfix build' wrote there")
        return files

    def states(self) -> dict[str, FileState]:
        """Look which files there are and in which version; empty where the folder has none."""
        try:
            return {name: file_state(path) for name, path in self.find().items()}
        except (TableError, OSError):
            return {}


def file_state(path: Path) -> FileState:
    """Tell this version of a file from others."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_ino, status.st_size, status.st_mtime_ns)


def load_table(name: str, path: Path) -> ServedTable:
    """Open a table, read every byte of it, and compile the kernels.

    Raises
    ------
    TableError
        When the file is no whole table.
    """
    state = file_state(path)
    table = Table.open(path)
    table.verify()
    if file_state(path) != state:
        raise TableError(f"{path} changed while it was read; write tables beside and rename them into place")
    locator = Locator(table)
    locator.warm_up()
    tracker = Tracker(table.scene)
    tracker.warm_up()
    return ServedTable(name=name, locator=locator, tracker=tracker, state=state)


def load_tables(path: Path) -> dict[str, ServedTable]:
    """Load a table, or all tables of a folder, by name.

    Raises
    ------
    TableError
        When one of the files is no whole table, or a folder has none.
    """
    return {name: load_table(name, file) for name, file in TableFiles(path=path).find().items()}


def forget_changed(tables: dict[str, ServedTable]) -> None:
    """Take out the tables whose files are no longer those that they were read from."""
    for name, served in list(tables.items()):
        if file_state(served.locator.table.path) != served.state:
            del tables[name]


class Tables:
    """The tables of one process.

    A table is served once it is verified. When its file changes, the new one is verified beside the old one, which
    answers until then, and goes on answering where the new one is refused.

    Parameters
    ----------
    path : pathlib.Path
        A table, or a folder of tables.
    metrics : Metrics
    runtime_folder : pathlib.Path, optional
        Folder through which the workers of one service tell each other to look at all files.
    at_hand : dict of str to ServedTable, optional
        Tables that are loaded already, by name. One whose file has not changed since is served at once. Each is taken
        out, so that nothing holds it when it is swapped.
    """

    def __init__(
        self,
        path: Path,
        metrics: Metrics,
        *,
        runtime_folder: Path | None = None,
        at_hand: dict[str, ServedTable] | None = None,
    ) -> None:
        self._files = TableFiles(path=path)
        self._metrics = metrics
        self._marker = None if runtime_folder is None else runtime_folder / "reload"
        self._marked: FileState = None if self._marker is None else file_state(self._marker)
        self._at_hand = {} if at_hand is None else at_hand
        self._served: Mapping[str, ServedTable] = {}
        self._refused: dict[str, FileState] = {}
        self._looked_at: dict[str, FileState] = {}
        self._lock = asyncio.Lock()
        self._runtime_folder = runtime_folder
        self._failure: str | None = None
        self.became_ready = asyncio.Event()

    def all(self) -> tuple[ServedTable, ...]:
        """Return all tables, sorted by name, or end the request with 503.

        Raises
        ------
        ProblemError
            While none may answer.
        """
        self._require_ready()
        return tuple(self._served.values())

    def named(self, name: str | None) -> ServedTable:
        """Return the table of that name; without one, the only table or that named ``default``.

        Raises
        ------
        ProblemError
            While none may answer, for an unknown name, and where a name is needed.
        """
        self._require_ready()
        if name is None and len(self._served) == 1:
            return next(iter(self._served.values()))
        table = self._served.get("default" if name is None else name)
        if table is not None:
            return table
        names = ", ".join(self._served)
        if name is None:
            text = f"table is missing and there are several; give one of {names}"
            problem = FieldProblem(path=("table",), message=text)
            raise ProblemError(INVALID_PARAMETER, text, errors=(problem,))
        raise ProblemError(NOT_FOUND, f"there is no table {name[:60]!r}; give one of {names}")

    def _require_ready(self) -> None:
        if self.became_ready.is_set():
            return
        if self._failure is not None:
            raise ProblemError(NOT_READY, self._failure)
        raise ProblemError(
            NOT_READY,
            "the tables are being checked and the kernels compiled; try again when /readyz answers 200",
            headers={"Retry-After": "1"},
        )

    async def keep(self, seconds: float) -> None:
        """Load all tables, then for ever what is new.

        A changed file is looked at once it has not changed between two looks.

        Parameters
        ----------
        seconds : float
            Between two looks.
        """
        try:
            changes = await self.refresh()
        except Exception:
            _log.critical("not ready", exc_info=True)
            changes = [TableChange(name="", change="refused")]
        if not self.became_ready.is_set() and any(change.change == "refused" for change in changes):
            self._failure = "a table does not pass its check, the log says why; replace it"
        before = self._looked_at
        while True:
            await asyncio.sleep(seconds)
            try:
                before = await self._watch_once(before)
            except Exception:
                _log.exception("looking at the tables failed; they stay as they are")

    async def refresh(self, *, again: bool = False) -> list[TableChange]:
        """Look at all files; load those that are new.

        Parameters
        ----------
        again : bool
            Also look again at what was refused before, and no longer serve tables whose files are gone. Otherwise
            they stay: a folder that is gone for a moment must not take the service with it.
        """
        async with self._lock:
            try:
                files = self._files.find()
            except (TableError, OSError) as error:
                return [self._refuse("", self._files.path, None, error)]
            self._looked_at = self._files.states()
            changes = []
            for name, path in files.items():
                changes.append(await self._look(name, path, again=again))
            if again:
                changes += [self._remove(name) for name in self._served.keys() - files.keys()]
            if self._served.keys() >= files.keys():
                self._become_ready()
            return changes

    async def reload(self) -> list[TableChange]:
        """Look at all files, and tell the other workers to."""
        changes = await self.refresh(again=True)
        if self._marker is not None:
            self._marker.write_bytes(b"")
            self._marked = file_state(self._marker)
        return changes

    async def _watch_once(self, before: dict[str, FileState]) -> dict[str, FileState]:
        now = await asyncio.to_thread(self._files.states)
        marked = None if self._marker is None else file_state(self._marker)
        if marked != self._marked:
            self._marked = marked
            await self.refresh(again=True)
        elif now == before and now != self._looked_at:
            await self.refresh()
        return now

    def _become_ready(self) -> None:
        if self.became_ready.is_set():
            return
        self.became_ready.set()
        self._metrics.became_ready()
        if self._runtime_folder is not None:
            (self._runtime_folder / "ready").touch()
        _log.info("ready with %s", ", ".join(_described(table) for table in self._served.values()))

    async def _look(self, name: str, path: Path, *, again: bool) -> TableChange:
        state = file_state(path)
        served = self._served.get(name)
        if served is not None and served.state == state:
            self._refused.pop(name, None)
            return TableChange(name=name, change="unchanged")
        if not again and name in self._refused and self._refused[name] == state:
            return TableChange(name=name, change="unchanged")
        try:
            table = self._at_hand.pop(name, None)
            if table is None or table.state != state:
                table = await asyncio.to_thread(load_table, name, path)
        except Exception as error:
            return self._refuse(name, path, state, error)
        self._refused.pop(name, None)
        if served is not None:
            self._metrics.table_left(name, served.locator.table)
        self._served = dict(sorted({**self._served, name: table}.items()))
        self._metrics.table_loaded(name, table.locator.table)
        if self.became_ready.is_set():
            _log.info("loaded %s", _described(table))
        return TableChange(name=name, change="loaded")

    def _refuse(self, name: str, path: Path, state: FileState, error: Exception) -> TableChange:
        self._refused[name] = state
        self._metrics.table_refused()
        if isinstance(error, RayfixError | OSError):
            reason = str(error).replace(str(path), path.name)
            _log.error("table refused: %s", error)
        else:
            reason = f"{path.name} cannot be loaded; the log says why"
            _log.error("table refused: %s", path, exc_info=error)
        if name in self._served:
            _log.warning("%s goes on answering", _described(self._served[name]))
        return TableChange(name=name, change="refused", reason=reason)

    def _remove(self, name: str) -> TableChange:
        table = self._served[name]
        self._served = {key: value for key, value in self._served.items() if key != name}
        self._metrics.table_left(name, table.locator.table)
        _log.info("%s no longer answers, its file is gone", _described(table))
        return TableChange(name=name, change="removed")


def _described(served: ServedTable) -> str:
    return f"table {served.name} ({served.locator.table.table_id})"
