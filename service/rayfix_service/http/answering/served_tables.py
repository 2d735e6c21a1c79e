"""The tables that a process serves: found, verified, and swapped when their files change."""

import asyncio
import logging
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rayfix_service.http.answering.table_checks import TableChecks
from rayfix_service.http.answering.table_files import FileState, FoundFiles, TableFiles, file_state, no_table
from rayfix_service.http.problems import INVALID_PARAMETER, NOT_FOUND, NOT_READY, ProblemError
from rayfix_service.http.telemetry.metrics import Metrics
from rayfix_service.locator import Locator
from rayfix_service.tracking.tracker import Tracker
from rayfix_service.wire import FieldProblem
from rayfix_tables.checked import VERDICTS
from rayfix_tables.errors import RayfixError, TableError
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

_CHECKS_AT_A_TIME = 4  # of one process; a file that is not whole may take all of its time
_AGAIN_SECONDS = 10.0  # after which a file that could not be checked is looked at again

_log = logging.getLogger(__name__)

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
    """Result of a check of a table's file; ``reason`` gives the cause of a refusal, without the file's folder."""

    name: str
    change: Change
    reason: str | None = None


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """A version of a file that is not served.

    Attributes
    ----------
    state : tuple of int or None
        Of the file.
    reason : str
        Without the file's folder.
    """

    state: FileState
    reason: str


def load_table(
    name: str, path: Path, *, checks: TableChecks | None = None, given_up: threading.Event | None = None
) -> ServedTable:
    """Have a table checked in a process of its own, map it, and compile the kernels.

    Parameters
    ----------
    checks : TableChecks, optional
    given_up : threading.Event, optional
        Ends the check early.

    Raises
    ------
    TableError
        When the file is no whole table.
    """
    checks = checks or TableChecks()
    table, state = checks.open(path, given_up)
    served = _warmed_up(_serve(name, table, state))
    checks.note_loaded(path, state)
    return served


def _warmed_up(served: ServedTable) -> ServedTable:
    served.locator.warm_up()
    served.tracker.warm_up()
    return served


def _serve(name: str, table: Table, state: FileState) -> ServedTable:
    return ServedTable(name=name, locator=Locator(table), tracker=Tracker(table), state=state)


def load_tables(path: Path, *, checks: TableChecks | None = None) -> dict[str, ServedTable]:
    """Load a table, or all whole tables of a folder, by name.

    Raises
    ------
    TableError
        When no file is a whole table, or a folder has none.
    """
    checks = checks or TableChecks()
    files = TableFiles(path=path).find()
    with ThreadPoolExecutor(_CHECKS_AT_A_TIME) as pool:  # a file that is not whole may take long
        opening = {name: pool.submit(checks.open, file) for name, file in files.items()}
    loaded: dict[str, ServedTable] = {}
    refusals: list[TableError] = []
    for name, future in opening.items():
        try:
            loaded[name] = _warmed_up(_serve(name, *future.result()))
        except TableError as error:
            refusals.append(error)
    if not loaded:
        raise refusals[0]
    return loaded


def forget_changed(tables: dict[str, ServedTable]) -> None:
    """Remove the tables whose files have changed since they were read."""
    for name, served in list(tables.items()):
        if file_state(served.locator.table.path) != served.state:
            del tables[name]


def follow_changes(tables: dict[str, ServedTable], path: Path, checks: TableChecks, *, failed: set[FileState]) -> None:
    """Add tables that workers have loaded since, and remove those whose files are gone.

    A table whose file has become another stays until a worker has loaded that: so there is always one that can answer
    for whoever is forked next.

    Parameters
    ----------
    failed : set of FileState
        Takes the files that this process could not load, so that it does not try again.
    """
    try:
        found = TableFiles(path=path).look()
    except OSError:
        return
    if not any(state is not None for state in found.states.values()):  # not mounted for a moment
        return
    for name in tables.keys() - found.files.keys():
        del tables[name]
    for name, file in found.files.items():
        state = found.states[name]
        if state in failed or (name in tables and tables[name].state == state):
            continue
        try:
            if (opened := checks.open_loaded(file)) is not None:
                tables[name] = _serve(name, *opened)
        except Exception:  # the workers go on
            _log.exception("%s is not kept for workers to come", file)
            failed.add(state)


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
        Folder through which the workers of one service ask each other to check all files.
    at_hand : dict of str to ServedTable, optional
        Tables that are loaded already, by name. One whose file has not changed since is served at once, and one whose
        file has become a bad one, too. Each is taken out, so that nothing holds it when it is swapped.
    checks : TableChecks, optional
    """

    def __init__(
        self,
        path: Path,
        metrics: Metrics,
        *,
        runtime_folder: Path | None = None,
        at_hand: dict[str, ServedTable] | None = None,
        checks: TableChecks | None = None,
    ) -> None:
        self._files = TableFiles(path=path)
        self._metrics = metrics
        self._checks = checks or TableChecks(runtime_folder)
        self._marker = None if runtime_folder is None else runtime_folder / "reload"
        self._marked: FileState = None if self._marker is None else file_state(self._marker)
        self._at_hand = {} if at_hand is None else at_hand
        self._served: Mapping[str, ServedTable] = {}
        self._refused: dict[str, Refusal] = {}
        self._found = FoundFiles(files={}, states={}, unfit={})
        self._looked_at: dict[str, FileState] = {}
        self._not_before: dict[str, float] = {}
        self._locks: dict[str, asyncio.Lock] = {}
        self._looking: dict[str, asyncio.Task[TableChange]] = {}
        self._at_a_time = asyncio.Semaphore(_CHECKS_AT_A_TIME)
        self._runtime_folder = runtime_folder
        self._failure: str | None = None
        self.became_ready = asyncio.Event()

    @property
    def refused(self) -> tuple[str, ...]:
        """Names of files that are refused in their present version, sorted; an older one may answer."""
        return tuple(sorted(name for name in self._refused if name))

    def all(self) -> tuple[ServedTable, ...]:
        """Return all tables, sorted by name, or end the request with 503.

        Raises
        ------
        ProblemError
            While none may answer.
        """
        self._require_ready()
        return self.at_hand()

    def at_hand(self) -> "tuple[ServedTable, ...]":
        """Return all tables that are checked already, sorted by name; none at the beginning."""
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
        """Load all tables, then new ones until cancelled.

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
            self._failure = "a table does not pass its check, the log has the cause; replace it"
        before = dict(self._looked_at)
        try:
            while True:
                await asyncio.sleep(seconds)
                try:
                    before = await self._watch_once(before)
                except Exception:
                    _log.exception("looking at the tables failed; they stay as they are")
        finally:
            for task in self._looking.values():
                task.cancel()

    async def refresh(self, *, again: bool = False) -> list[TableChange]:
        """Check all files; load those that are new.

        Parameters
        ----------
        again : bool
            Also look again at what was refused before, and no longer serve tables whose files are gone. Otherwise
            they stay: a folder that is gone for a moment must not take the service with it.
        """
        try:
            self._found = found = self._files.look()
        except OSError as error:
            return [self._refuse("", self._files.path, None, error)]
        if not found.files:
            return [self._refuse("", self._files.path, None, no_table(self._files.path, found))]
        changes = self._tell_unfit(found)
        looks = (self._look(name, path, again=again) for name, path in found.files.items())
        changes += await asyncio.gather(*looks)
        if again:
            changes += [self._remove(name) for name in self._served.keys() - found.files.keys()]
        return changes

    async def reload(self) -> list[TableChange]:
        """Check all files, and ask the other workers to."""
        changes = await self.refresh(again=True)
        if self._marker is not None:
            try:
                self._marker.write_bytes(b"")
                self._marked = file_state(self._marker)
            except OSError as error:
                _log.error(
                    "the other workers are not asked to look at the tables' files: %s; they will by themselves", error
                )
        return changes

    async def _watch_once(self, before: dict[str, FileState]) -> dict[str, FileState]:
        try:
            self._found = found = await asyncio.to_thread(self._files.look)
        except OSError:
            return before
        marked = None if self._marker is None else file_state(self._marker)
        if marked != self._marked:
            self._marked = marked
            await self.refresh(again=True)
            return found.states
        self._tell_unfit(found)
        now = asyncio.get_running_loop().time()
        for name, state in found.states.items():
            # Each file by itself: one that changes all the time must not keep the others waiting.
            settled = name in before and before[name] == state != self._looked_at.get(name)
            waits = self._is_refused(name, state) and now < self._not_before.get(name, now)
            if settled and state is not None and not waits and name not in self._looking:
                self._looking[name] = task = asyncio.create_task(self._look(name, found.files[name], again=False))
                task.add_done_callback(lambda done, name=name: self._looked(name, done))  # type: ignore[misc]
        return found.states

    def _looked(self, name: str, done: asyncio.Task[TableChange]) -> None:
        del self._looking[name]
        if not done.cancelled() and (error := done.exception()) is not None:
            _log.error("looking at table %s failed", name, exc_info=error)

    def _is_refused(self, name: str, state: FileState) -> bool:
        return name in self._refused and self._refused[name].state == state

    def _tell_unfit(self, found: FoundFiles) -> list[TableChange]:
        """Refuse files that cannot be tables by name or kind, once; forget those that are gone."""
        if found.files:
            for name in self._refused.keys() - found.files.keys() - found.unfit.keys():
                del self._refused[name]
            self._metrics.tables_refused(len(self.refused))
            for name in self._locks.keys() - found.files.keys() - self._served.keys() - self._looking.keys():
                if not self._locks[name].locked():
                    del self._locks[name]
                    self._looked_at.pop(name, None)
                    self._not_before.pop(name, None)
        return [self._refuse(name, self._files.path, None, TableError(reason)) for name, reason in found.unfit.items()]

    def _become_ready(self) -> None:
        """Become ready once all files are served but for those that are refused."""
        pending = self._found.files.keys() - self._served.keys() - self._refused.keys()
        if self.became_ready.is_set() or pending or not self._served:
            return
        self.became_ready.set()
        self._metrics.became_ready()
        if self._runtime_folder is not None:
            with suppress(OSError):  # full or gone: a worker to come then takes connections before it can locate
                (self._runtime_folder / "ready").touch()
        _log.info("ready with %s", ", ".join(_described(table) for table in self._served.values()))

    async def _look(self, name: str, path: Path, *, again: bool) -> TableChange:
        async with self._locks.setdefault(name, asyncio.Lock()):
            self._looked_at[name] = state = file_state(path)
            served = self._served.get(name)
            if served is not None and served.state == state:
                self._accept(name)
                return TableChange(name=name, change="unchanged")
            if self._is_refused(name, state) and not again and name not in self._not_before:
                return TableChange(name=name, change="unchanged")
            at_hand = self._at_hand.pop(name, None)
            if at_hand is not None and (served is None or at_hand.state == state):
                change = self._take(at_hand)  # even if its file has changed: until the new one has passed
                if at_hand.state == state:
                    return change
            try:
                return self._take(await self._load(name, path))
            except Exception as error:
                return self._refuse(name, path, state, error)

    async def _load(self, name: str, path: Path) -> ServedTable:
        given_up = threading.Event()
        async with self._at_a_time:
            try:
                return await asyncio.to_thread(load_table, name, path, checks=self._checks, given_up=given_up)
            finally:
                given_up.set()

    def _take(self, table: ServedTable) -> TableChange:
        """Serve a table from now on."""
        name = table.name
        self._accept(name)
        if (served := self._served.get(name)) is not None:
            self._metrics.table_left(name, served.locator.table)
        self._served = dict(sorted({**self._served, name: table}.items()))
        self._metrics.table_loaded(name, table.locator.table)
        if self.became_ready.is_set():
            _log.info("loaded %s", _described(table))
        self._become_ready()
        return TableChange(name=name, change="loaded")

    def _accept(self, name: str) -> None:
        self._refused.pop(name, None)
        self._not_before.pop(name, None)
        self._metrics.tables_refused(len(self.refused))

    def _refuse(self, name: str, path: Path, state: FileState, error: Exception) -> TableChange:
        if isinstance(error, RayfixError | OSError):
            reason = str(error).replace(str(path), path.name)
        else:
            reason = f"{path.name} cannot be loaded; the log has the cause"
        if isinstance(error, TableError) and not isinstance(error, VERDICTS) and state is not None:
            # The cause may be temporary: no memory for the check, no permission to read the file.
            self._looked_at.pop(name, None)
            self._not_before[name] = asyncio.get_running_loop().time() + _AGAIN_SECONDS
        before, self._refused[name] = self._refused.get(name), Refusal(state=state, reason=reason)
        self._metrics.tables_refused(len(self.refused))
        self._become_ready()
        change = TableChange(name=name, change="refused", reason=reason)
        if before == self._refused[name]:
            return change  # logged already
        self._metrics.table_refused()
        if isinstance(error, RayfixError | OSError):
            _log.error("table refused: %s", error)
        else:
            _log.error("table refused: %s", path, exc_info=error)
        if name in self._served:
            _log.warning("%s goes on answering", _described(self._served[name]))
        return change

    def _remove(self, name: str) -> TableChange:
        table = self._served[name]
        self._served = {key: value for key, value in self._served.items() if key != name}
        self._metrics.table_left(name, table.locator.table)
        _log.info("%s no longer answers, its file is gone", _described(table))
        return TableChange(name=name, change="removed")


def _described(served: ServedTable) -> str:
    return f"table {served.name} ({served.locator.table.table_id})"
