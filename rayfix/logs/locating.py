"""Locating the reports of a log: what one process does with a block of them."""

from collections.abc import Sequence
from typing import Any

from rayfix.logs.entries import Located, Place, Problem, Task, Work, shard_of
from rayfix.logs.layouts import RADII, piece
from rayfix.logs.residuals import residuals
from rayfix_service.adapters.adapted import Adapted, with_confidence, with_height
from rayfix_service.adapters.formats import write
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.locator import Locator
from rayfix_service.process_wide import collector_paused
from rayfix_service.tracking.track import TrackedPosition
from rayfix_service.tracking.tracker import Tracker
from rayfix_service.wire import fix_to_document, parse_report, report_to_document
from rayfix_tables.checked import open_checked
from rayfix_tables.errors import ReportError, TableError


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
