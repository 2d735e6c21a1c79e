"""Locating within a request."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Annotated, Any, TypeVar

from fastapi import Depends
from pydantic_core import from_json, to_json
from starlette.requests import HTTPConnection

from rayfix_service.adapters.adapted import Adapted, error_in_message
from rayfix_service.adapters.formats import write
from rayfix_service.adapters.omlox_hub import OmloxHub
from rayfix_service.fusion.report import Fix, Report
from rayfix_service.http.feed import FixFeed
from rayfix_service.http.metrics import Metrics
from rayfix_service.http.problems import ProblemError, internal_problem, problem_document, report_problem
from rayfix_service.http.slow_fixes import SlowFixes, is_slow
from rayfix_service.http.tables import ServedTable
from rayfix_service.http.wanted import Wanted
from rayfix_service.tracking.tracker import TrackedPosition
from rayfix_service.wire import fix_to_document, parse_report, report_to_document
from rayfix_tables.errors import ReportError

_log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Incoming:
    """A report with what it was made from.

    Attributes
    ----------
    report : Report
    adapted : Adapted, optional
        Where it came from, if from another format.
    document : Mapping or bytes, optional
        The report as it was posted, if in this project's own format.
    """

    report: Report
    adapted: Adapted | None = None
    document: Mapping[str, Any] | bytes | None = None

    def native_document(self) -> Any:
        """Return the report as this project's JSON."""
        if isinstance(self.document, bytes):
            return from_json(self.document)
        return report_to_document(self.report) if self.document is None else self.document


def native(document: Mapping[str, Any] | bytes) -> Incoming:
    """Read a report of this project's own format.

    Raises
    ------
    ReportError
        When it cannot be used.
    """
    return Incoming(report=parse_report(document), document=document)


def foreign(adapted: Adapted) -> Incoming:
    """Take a report made from a message of another format."""
    return Incoming(report=adapted.report, adapted=adapted)


@dataclass(frozen=True, kw_only=True)
class Answerer:
    """What answers reports: the figures that it adds to, the feed and hub to tell, threads for slow ones."""

    metrics: Metrics
    feed: FixFeed
    slow_fixes: SlowFixes
    hub: OmloxHub | None

    async def answer(self, table: ServedTable, incoming: Incoming, wanted: Wanted) -> dict[str, Any]:
        """Locate a report with a table and write the answer as wanted.

        Raises
        ------
        ReportError
            When a station is not in the table, or the format needs a position and there is none.
        ProblemError
            When the fix is slow and the service too busy.
        """
        try:
            fix, track, seconds = await self._locate(table, incoming.report, wanted)
        except ReportError as error:
            if incoming.adapted is None:
                raise
            raise error_in_message(error, incoming.adapted) from None
        self.feed.publish(table.name, fix.target_id, partial(_event, table.name, incoming, fix, track, seconds))
        site = table.site
        if self.hub is not None:
            self.hub.tell(fix, site, track)
        return write(fix, wanted.output, site, compute_seconds=seconds, adapted=incoming.adapted, track=track)

    async def answer_or_problem(
        self, table: ServedTable, make: Callable[[], Incoming], wanted: Wanted
    ) -> dict[str, Any]:
        """Answer one report of several, with a problem where it cannot be used."""
        try:
            return await self.answer(table, make(), wanted)
        except ReportError as error:
            return report_problem(error)
        except ProblemError as error:
            return problem_document(error.kind, str(error))
        except Exception:
            # A defect that one report meets must not cost the other 999 their fix.
            _log.exception("a report of several failed")
            return internal_problem()

    async def _locate(
        self, table: ServedTable, report: Report, wanted: Wanted
    ) -> tuple[Fix, TrackedPosition | None, float]:
        """Locate a report; returns the fix, its target's track if that is wanted, and the time of the fix, s.

        A fix with an angle takes less than a millisecond or a few, right on the event loop. In the thread pool that
        FastAPI has for "def" such fixes would wait for each other's GIL; more worker processes use more cores.
        """
        start = perf_counter()
        if not wanted.follows(report):
            fix = await self._wherever(table.locator.locate, report)
            seconds = perf_counter() - start
            self.metrics.fix_done(fix, seconds)
            return fix, None, seconds
        fused = await self._wherever(table.locator.fuse, report)
        seconds = perf_counter() - start
        self.metrics.fix_done(fused.fix, seconds)
        track = table.tracker.follow(fused)
        if track is not None:
            self.metrics.track_done(track.state)
        return fused.fix, track, seconds

    async def _wherever(self, locate: Callable[[Report], T], report: Report) -> T:
        """Locate on the event loop, or in a thread what would take too long there."""
        return await self.slow_fixes.locate(locate, report) if is_slow(report) else locate(report)


def _event(table: str, incoming: Incoming, fix: Fix, track: TrackedPosition | None, seconds: float) -> bytes:
    """Write what the feed tells of a fix."""
    document = {"table": table, "report": incoming.native_document(), "fix": fix_to_document(fix, seconds, track)}
    return to_json(document)


async def get_answerer(connection: HTTPConnection) -> Answerer:
    """Return what answers."""
    answerer: Answerer = connection.app.state.answerer
    return answerer


AnswererDep = Annotated[Answerer, Depends(get_answerer)]
