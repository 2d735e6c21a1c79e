"""Locating the reports of a log: what one process does with a block of them."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rayfix.logs.entries import Entry, Place, Problem
from rayfix.logs.layouts import RADII, Layout, piece
from rayfix.logs.residuals import Residual, residuals
from rayfix_service.adapters.adapted import Adapted, with_confidence, with_height
from rayfix_service.adapters.formats import OutputFormat, write
from rayfix_service.fusion.measurements.report import Height, Report
from rayfix_service.fusion.posterior.fix import Fix, Status
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from rayfix_service.process_wide import collector_paused
from rayfix_service.tracking.track import TrackedPosition
from rayfix_service.tracking.tracker import Tracker
from rayfix_service.wire import fix_to_document, parse_report, report_to_document
from rayfix_tables.checked import open_checked
from rayfix_tables.errors import ReportError, TableError

SHARDS = 16
"""Groups of targets; each is followed in one process, whatever the number of processes, so that tracks are the same."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """How the reports of a log are located and written.

    Attributes
    ----------
    table_path : pathlib.Path
    table_id : str
        Of the table at that path.
    layout : {"jsonl", "csv", "geojson", "parquet"}
    output_format : {"native", "3gpp", "omlox"}
        Of JSON lines.
    height, confidence
        For reports without a height, and instead of the reports' confidence.
    track : bool
        Whether targets are followed.
    with_reports : bool
        Whether JSON lines hold each fix's report as well.
    settings : FusionSettings
    """

    table_path: Path
    table_id: str
    layout: Layout
    output_format: OutputFormat = "native"
    height: Height | None = None
    confidence: float | None = None
    track: bool = False
    with_reports: bool = False
    settings: FusionSettings = field(default_factory=FusionSettings)


@dataclass(frozen=True, kw_only=True)
class Located:
    """A fix as it is written, and what the summary takes of it."""

    place: Place
    text: bytes
    status: Status
    residuals: tuple[Residual, ...]


@dataclass(frozen=True, kw_only=True)
class Work:
    """An entry, and the newest time of the log up to it, s since 1970, by which targets are forgotten."""

    entry: Entry
    now: float


class LogLocator:
    """Locates blocks of a log in one process.

    Parameters
    ----------
    task : Task

    Raises
    ------
    TableError
        When the table is another one by now.
    """

    def __init__(self, task: Task) -> None:
        table = open_checked(task.table_path, whole=False)
        if table.table_id != task.table_id:
            raise TableError(f"{task.table_path} has become another table since it was opened; start again")
        self._task = task
        self._site = table.site
        self._locator = Locator(table, task.settings)
        self._now = 0.0
        self._trackers: dict[int, Tracker] = {}

    def block(self, block: Sequence[Work]) -> list[Located | Problem]:
        """Locate a block; of each entry, its fix or why there is none."""
        with collector_paused():
            return [self._one(work) for work in block]

    def _one(self, work: Work) -> Located | Problem:
        entry, task = work.entry, self._task
        try:
            report = parse_report(entry.report) if isinstance(entry.report, bytes) else entry.report
            adapted = with_height(Adapted(report=report, sources=()), task.height)
            report = with_confidence(adapted, task.confidence).report
            fix, track = self._located(report, work.now)
            document = self._document(entry.place, report, fix, track)
        except ReportError as error:
            return Problem(place=entry.place, text=str(error))
        return Located(
            place=entry.place,
            text=piece(document, task.layout, track=task.track),
            status=fix.status,
            residuals=residuals(report, fix, self._site),
        )

    def _located(self, report: Report, now: float) -> tuple[Fix, TrackedPosition | None]:
        if not self._task.track:
            return self._locator.locate(report), None
        fused = self._locator.fuse(report)
        self._now = now
        track = self._tracker(report.target_id).follow(fused)
        return self._locator.explain(report, fused.fix), track

    def _tracker(self, target_id: str | None) -> Tracker:
        shard = shard_of(target_id)
        if shard not in self._trackers:
            self._trackers[shard] = Tracker(self._locator.table, clock=lambda: self._now)
        return self._trackers[shard]

    def _document(self, place: Place, report: Report, fix: Fix, track: TrackedPosition | None) -> dict[str, Any]:
        if self._task.output_format != "native":
            return write(fix, self._task.output_format, self._site, compute_seconds=0.0, track=track)
        document = fix_to_document(fix, 0.0, track)
        del document["compute_ms"]  # the same log and table give the same bytes
        radii = None
        if fix.regions is not None:
            found = fix.regions.horizontal_radii(RADII)
            radii = {f"{p:g}": radius for p, radius in zip(RADII, found, strict=True)}
        document["horizontal_radii_m"] = radii
        if self._task.with_reports:
            document["report"] = report_to_document(report)
        return {"log": place.log, "entry": place.entry, **document}


def shard_of(target_id: str | None) -> int:
    """Group of a target, the same in every process."""
    return hashlib.sha256((target_id or "").encode("utf-8", "surrogatepass")).digest()[0] % SHARDS
