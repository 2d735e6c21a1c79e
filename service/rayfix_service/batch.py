"""Many reports in one call, on several processor cores.

A third of a fix is Python, which one thread of a process runs at a time, so that threads gain little; processes do.
Each maps the table's file, so that the table is in memory once.
"""

import pickle
from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.process_wide import collector_paused
from rayfix_tables.checked import open_checked
from rayfix_tables.errors import RayfixError, ReportError, TableError
from rayfix_tables.table import Table

_BLOCK = 64
"""Reports that a process takes at a time; no more than these are not worth another process."""


class _Locates(Protocol):
    """A :class:`~rayfix_service.locator.Locator`, which builds on this module; processes make one of the same class."""

    table: Table
    settings: FusionSettings

    def __init__(self, table: Table, settings: FusionSettings) -> None: ...

    def locate(self, report: Report | Mapping[str, Any]) -> Fix: ...


def locate_batch(
    locator: _Locates, reports: Sequence[Report | Mapping[str, Any]], *, jobs: int = -1
) -> list[Fix | ReportError]:
    """Fuse the measurements of many reports.

    Parameters
    ----------
    locator : Locator
    reports : sequence of Report or mapping
        Mappings have the form of the JSON that ``POST /v1/positions`` takes.
    jobs : int
        Processes; -1 for one per core. With 1, everything happens in this one, as it does with 64 reports or fewer.
        Others start with the first call, within seconds, and wait for the next for some minutes.

    Returns
    -------
    list of Fix or ReportError
        Of each report in turn what :meth:`~rayfix_service.locator.Locator.locate` returns or raises.

    Raises
    ------
    TableError
        When the file of the locator's table is no longer that table.
    RayfixError
        When a process ends early.
    """
    with collector_paused():
        return _locate_all(locator, reports, jobs)


def _locate_all(locator: _Locates, reports: Sequence[Report | Mapping[str, Any]], jobs: int) -> list[Fix | ReportError]:
    blocks = [reports[begin : begin + _BLOCK] for begin in range(0, len(reports), _BLOCK)]
    # Imported here: a service answers without it.
    from joblib import Parallel, delayed, effective_n_jobs

    jobs = min(effective_n_jobs(jobs), len(blocks))
    if jobs < 2:
        return _locate_block(locator, reports)
    table = locator.table
    named = type(locator), table.path.resolve(), table.table_id, locator.settings
    parallel = Parallel(n_jobs=jobs, backend="loky", batch_size=1, pre_dispatch="all")
    try:
        packed = parallel(delayed(_locate_elsewhere)(*named, pickle.dumps(block)) for block in blocks)
    except BrokenProcessPool as error:
        raise RayfixError(
            "a process that located reports ended early, as it does when memory runs out; give fewer reports or jobs"
        ) from error
    return [answer for block in packed for answer in pickle.loads(block)]


def _locate_block(locator: _Locates, reports: Sequence[Report | Mapping[str, Any]]) -> list[Fix | ReportError]:
    answers: list[Fix | ReportError] = []
    for report in reports:
        try:
            answers.append(locator.locate(report))
        except ReportError as error:
            error.__traceback__ = error.__context__ = None  # they keep the report, and all that was made of it
            answers.append(error)
    return answers


def _locate_elsewhere(
    kind: type[_Locates], path: Path, table_id: str, settings: FusionSettings, packed: bytes
) -> bytes:
    """Locate pickled reports; joblib's own pickler asks Python about each object, which takes longer than its fix."""
    with collector_paused():
        return pickle.dumps(_locate_block(_locator(kind, path, table_id, settings), pickle.loads(packed)))


@lru_cache(maxsize=4)
def _locator(kind: type[_Locates], path: Path, table_id: str, settings: FusionSettings) -> _Locates:
    """Give this process's locator for a table."""
    table = open_checked(path, whole=False)
    if table.table_id != table_id:
        raise TableError(f"{path} has become another table since it was opened; open it again")
    return kind(table, settings)
