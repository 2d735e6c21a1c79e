"""Logs in, fixes out: reading, locating, writing, and going on after an interruption."""

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

from rayfix.logs.entries import Entry, Problem, Task, Work
from rayfix.logs.files import fingerprint
from rayfix.logs.layouts import head, is_fixes, layout_of, tail, to_parquet
from rayfix.logs.processes import Result, located
from rayfix.logs.reading import Reading, ReadState, read_logs
from rayfix.logs.summary import StationFigures, Summary
from rayfix_service.measuring.timestamps import utc_moment
from rayfix_service.wire import parse_report
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table
from rayfix_tables.version import software_version

_SAVE_SECONDS = 2.0
"""Time between two states from which an interrupted run goes on."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class LogRun:
    """What became of logs.

    Attributes
    ----------
    summary : Summary
    problems_path : pathlib.Path or None
        File that lists all problems; None where there are none.
    first_problems : tuple of str
        The first of them.
    unread_columns : tuple of str
        Columns of CSV logs that were not read.
    resumed : int
        Entries that an interrupted run before had done.
    """

    summary: Summary
    problems_path: Path | None
    first_problems: tuple[str, ...]
    unread_columns: tuple[str, ...]
    resumed: int


def locate_logs(
    table: Table,
    logs: Sequence[Path],
    output: Path,
    *,
    task: Task,
    reading: Reading,
    jobs: int = -1,
    progress: Progress = lambda stage, done, total: None,
) -> LogRun:
    """Locate the reports of logs and write their fixes to a file.

    The file appears when all is done. Until then, the fixes are in ``OUTPUT.part``, and a run that was interrupted
    goes on from there; one that follows targets starts again. Entries without a fix are listed in a file beside it,
    ``OUTPUT.problems.jsonl``.

    Parameters
    ----------
    table : Table
    logs : sequence of pathlib.Path
    output : pathlib.Path
        File of the fixes.
    task, reading
        How to locate and read.
    jobs : int
        Processes; -1 for one per core.
    progress : callable
        Given a stage, and how much of how much is done.

    Raises
    ------
    ReportError
        When a log cannot be read at all, or the file cannot be written.
    RayfixError
        When a process ends early.
    """
    _check_output(output, logs, task)
    marks = _marks(logs, task, reading)
    total = sum(path.stat().st_size for path in logs)
    jobs = jobs if jobs > 0 else len(os.sched_getaffinity(0))
    state = ReadState()
    with _Files(output, marks, task, table) as files:
        done = files.done
        works = _works(read_logs(logs, reading, state), skip=done, track=task.track)
        progress("locating", 0, total)
        for results in located(works, task, jobs):
            files.write(results)
            progress("locating", min(state.num_bytes, total), total)
        progress("locating", total, total)
        return files.finish(unread=tuple(dict.fromkeys(state.unread_columns)), resumed=done)


def _works(entries: Iterator[Entry | Problem], *, skip: int, track: bool) -> Iterator[Work | Problem]:
    """Prepare entries, after those that are done already."""
    now = 0.0
    for number, entry in enumerate(entries):
        if number < skip:
            continue
        if isinstance(entry, Problem):
            yield entry
            continue
        if track:
            # Which process follows the target depends on the report.
            try:
                report = parse_report(entry.report) if isinstance(entry.report, bytes) else entry.report
            except ReportError as error:
                yield Problem(place=entry.place, text=str(error))
                continue
            entry = replace(entry, report=report)
            if report.timestamp is not None:
                now = max(now, utc_moment(report.timestamp).timestamp())
        yield Work(entry=entry, now=now)


def _check_output(output: Path, logs: Sequence[Path], task: Task) -> None:
    if task.output_format != "native" and task.layout != "jsonl":
        raise ReportError(f"--output {task.output_format} is written as JSON lines; let the name end in .jsonl")
    if task.with_reports and (task.layout != "jsonl" or task.output_format != "native"):
        raise ReportError("--with-reports is for fixes as JSON lines; let the name end in .jsonl, without --output")
    if not output.parent.is_dir():
        raise ReportError(f"there is no folder {output.parent}; make it first")
    if not output.exists():
        return
    if any(log.exists() and output.samefile(log) for log in logs):
        raise ReportError(f"{output} is a log itself; give another file for the fixes")
    if not output.is_file() or not is_fixes(output, layout_of(output)):
        raise ReportError(f"{output} is there and holds no fixes; give another name, or remove it")


def _marks(logs: Sequence[Path], task: Task, reading: Reading) -> dict[str, Any]:
    """Give what an interrupted run must have in common with this one, for its fixes to be those of this one."""
    return {
        "logs": [fingerprint(log) for log in logs],
        "table_id": task.table_id,
        "software_version": software_version(),
        "task": repr(replace(task, table_path=Path())),
        "reading": repr(reading),
    }


class _Files:
    """The files of a run: fixes, problems, and the state from which to go on."""

    def __init__(self, output: Path, marks: dict[str, Any], task: Task, table: Table) -> None:
        self._output, self._marks, self._task = output, marks, task
        self._part = output.with_name(output.name + ".part")
        self._problems_part = output.with_name(output.name + ".problems.part")
        self._state_path = output.with_name(output.name + ".state")
        self._problems_path = output.with_name(output.name + ".problems.jsonl")
        self._saved = time.monotonic()
        self._first_problems: list[str] = []
        self._ended = False
        self.done = 0
        self.summary = Summary(stations={station.id: StationFigures() for station in table.site.stations})

    def __enter__(self) -> "_Files":
        try:
            state = None if self._task.track else self._read_state()
            if state is None:
                self._state_path.unlink(missing_ok=True)
                self._fixes = _opened_at(self._part, 0)
                self._problems = _opened_at(self._problems_part, 0)
                self._fixes.write(head(self._task.layout, track=self._task.track))
            else:
                self._fixes = _opened_at(self._part, state["fix_bytes"])
                self._problems = _opened_at(self._problems_part, state["problem_bytes"])
                self.done = state["done"]
                self.summary = Summary.from_state(state["summary"])
                self._first_problems = state["first_problems"]
        except OSError as error:
            raise self._unwritable(error) from error
        return self

    def __exit__(self, *_: object) -> None:
        if not self._ended and not self._task.track:
            with suppress(ReportError):  # the state before is still there
                self._save()
        self._fixes.close()
        self._problems.close()
        if not self._ended and self._task.track:
            self._part.unlink(missing_ok=True)
            self._problems_part.unlink(missing_ok=True)

    def write(self, results: Sequence[Result]) -> None:
        """Write a block of results."""
        try:
            for result in results:
                if isinstance(result, Problem):
                    self._write_problem(result)
                    continue
                if self._task.layout == "geojson" and self.summary.fixes:
                    self._fixes.write(b",\n")
                self._fixes.write(result.text)
                self.summary.add(result.status, result.residuals)
        except OSError as error:
            raise self._unwritable(error) from error
        self.done += len(results)
        if not self._task.track and time.monotonic() - self._saved > _SAVE_SECONDS:
            self._save()

    def _write_problem(self, problem: Problem) -> None:
        self.summary.problems += 1
        if len(self._first_problems) < 10:
            self._first_problems.append(f"{problem.place}: {problem.text}")
        line = {"log": problem.place.log, "entry": problem.place.entry, "problem": problem.text}
        self._problems.write(json.dumps(line, separators=(",", ":")).encode() + b"\n")

    def finish(self, *, unread: tuple[str, ...], resumed: int) -> LogRun:
        """Write the rest, and give the files their names."""
        try:
            self._fixes.write(tail(self._task.layout))
            for file in (self._fixes, self._problems):
                file.flush()
                os.fsync(file.fileno())
            if self._task.layout == "parquet":
                whole = self._output.with_name(self._output.name + ".rows")
                to_parquet(self._part, whole, track=self._task.track)
                os.replace(whole, self._part)
            if self.summary.problems:
                os.replace(self._problems_part, self._problems_path)
            else:
                self._problems_part.unlink()
                self._problems_path.unlink(missing_ok=True)
            os.replace(self._part, self._output)
            self._state_path.unlink(missing_ok=True)
        except OSError as error:
            raise self._unwritable(error) from error
        self._ended = True
        return LogRun(
            summary=self.summary,
            problems_path=self._problems_path if self.summary.problems else None,
            first_problems=tuple(self._first_problems),
            unread_columns=unread,
            resumed=resumed,
        )

    def _save(self) -> None:
        """Keep all that is needed to go on from here."""
        try:
            for file in (self._fixes, self._problems):
                file.flush()
                os.fsync(file.fileno())
            state = {
                "marks": self._marks,
                "done": self.done,
                "fix_bytes": self._fixes.tell(),
                "problem_bytes": self._problems.tell(),
                "first_problems": self._first_problems,
                "summary": self.summary.state(),
            }
            new = self._state_path.with_name(self._state_path.name + ".new")
            new.write_text(json.dumps(state), encoding="utf-8")
            os.replace(new, self._state_path)
        except OSError as error:
            raise self._unwritable(error) from error
        self._saved = time.monotonic()

    def _read_state(self) -> dict[str, Any] | None:
        """Return the state of an interrupted run of the same logs, or None."""
        try:
            state = json.loads(self._state_path.read_text(encoding="utf-8"))
            if state["marks"] != self._marks:
                return None
            whole = self._part.stat().st_size >= state["fix_bytes"]
            return dict(state) if whole and self._problems_part.stat().st_size >= state["problem_bytes"] else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def _unwritable(self, error: OSError) -> ReportError:
        return ReportError(f"{self._output} cannot be written ({error.strerror or error}); give another file or folder")


def _opened_at(path: Path, size: int) -> BinaryIO:
    """Open a file to write on at a size, without what comes after."""
    file = path.open("r+b" if path.exists() else "w+b")
    file.truncate(size)
    file.seek(size)
    return file
