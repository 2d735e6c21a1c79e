"""Locating within a request."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple, TypeVar

from pydantic_core import from_json, to_json

from rayfix_service.adapters.adapted import Adapted, error_in_message
from rayfix_service.adapters.formats import write
from rayfix_service.adapters.omlox_hub import OmloxHub
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.posterior.fused import Fused
from rayfix_service.fusion.stopping import FixStoppedError, Stop
from rayfix_service.http.answering.feed import FixFeed
from rayfix_service.http.answering.freed_memory import FreedMemory
from rayfix_service.http.answering.quick_work import QuickWork
from rayfix_service.http.answering.response_options import ResponseOptions
from rayfix_service.http.answering.served_tables import ServedTable
from rayfix_service.http.answering.slow_work import SlowWork, Stoppable
from rayfix_service.http.problems import ProblemError, internal_problem, problem_document, report_problem
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.http.telemetry.metrics import Metrics
from rayfix_service.http.telemetry.report_figures import Source, report_outcome
from rayfix_service.locator import Locator
from rayfix_service.tracking.track import TrackedPosition
from rayfix_service.wire import fix_to_document, parse_report, report_to_document
from rayfix_service.wire.limits import USUAL_LIMITS, MessageLimits
from rayfix_tables.errors import ReportError

_log = logging.getLogger(__name__)

T = TypeVar("T")

READ_AT_ONCE = 16 << 10
"""Bytes of a JSON body that is parsed right on the event loop, within 5 ms whatever it holds."""

READ_LINES_AT_ONCE = 4 << 10
"""The same for lines of text, which Python code parses at a quarter of the speed."""


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


def native(document: Mapping[str, Any] | bytes, *, limits: MessageLimits = USUAL_LIMITS) -> Incoming:
    """Read a report of this project's own format.

    Raises
    ------
    ReportError
        When it cannot be used.
    """
    return Incoming(report=parse_report(document, limits=limits), document=document)


def foreign(adapted: Adapted) -> Incoming:
    """Take a report made from a message of another format."""
    return Incoming(report=adapted.report, adapted=adapted)


class Located(NamedTuple):
    """A fix, the track of its target if that is requested, and the time that the fix took, s."""

    fix: Fix
    track: TrackedPosition | None
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Answerer:
    """Locates reports and writes the answers.

    Attributes
    ----------
    metrics : Metrics
        To add to.
    feed : FixFeed
        To publish fixes in.
    quick_work : QuickWork
        Makes fixes on the event loop.
    slow_work : SlowWork
        Threads for what takes longer, by its estimate, than ``quick_seconds``, and for what turns out to.
    hub : OmloxHub or None
        To send positions to.
    quick_seconds : float
        What a fix may take on the event loop.
    message_limits : MessageLimits
        Of what is read.
    freed_memory : FreedMemory or None
        To be told of long bodies.
    reading : asyncio.Lock
        The turn to read a long body.
    """

    metrics: Metrics
    feed: FixFeed
    quick_work: QuickWork
    slow_work: SlowWork
    hub: OmloxHub | None
    quick_seconds: float = ServiceSettings.quick_fix_seconds
    message_limits: MessageLimits = USUAL_LIMITS
    freed_memory: FreedMemory | None = None
    reading: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def read_report(self, body: bytes) -> Incoming:
        """Read a report of this project's own format as :meth:`read` does.

        Raises
        ------
        ReportError
            When it cannot be used.
        """
        return await self.read(partial(native, limits=self.message_limits), body)

    async def read(self, parse: Callable[[bytes], T], body: bytes, *, at_once: int = READ_AT_ONCE) -> T:
        """Parse a body: long ones in a thread, one at a time, so that other requests are answered meanwhile.

        Parameters
        ----------
        parse : callable
        body : bytes
        at_once : int
            Bytes of a body that is parsed right on the event loop.

        Raises
        ------
        Exception
            As `parse` does.
        """
        if len(body) <= at_once:
            return parse(body)
        try:
            async with self.reading:
                return await asyncio.to_thread(parse, body)
        finally:
            if self.freed_memory is not None:
                self.freed_memory.soon()

    async def answer(self, table: ServedTable, incoming: Incoming, options: ResponseOptions) -> dict[str, Any]:
        """Locate a report with a table and write the answer in the requested format.

        Raises
        ------
        ReportError, ProblemError
            As :meth:`locate` and :meth:`write` do.
        """
        return self.write(table, incoming, options, await self.locate(table, incoming, options))

    async def locate(self, table: ServedTable, incoming: Incoming, options: ResponseOptions) -> Located:
        """Locate a report with a table, and follow its target if that is requested.

        A fix that takes less than a millisecond or a few by its estimate, as most do, is made right on the event loop.
        In the thread pool that FastAPI has for "def" such fixes would wait for each other's GIL; more worker processes
        use more cores. Others go to the threads for slow fixes.

        Raises
        ------
        ReportError
            When a station is not in the table, or the target cannot be followed.
        ProblemError
            When the fix is slow and the service too busy.
        """
        report = incoming.report
        locator = table.locator
        follows = options.follows(report)
        quick = locator.seconds(report, with_likelihood=follows) <= self.quick_seconds
        start = perf_counter()
        try:
            fused = await self._fuse(partial(locator.fuse, with_likelihood=follows), report, quick)
            seconds = perf_counter() - start
            self.metrics.fix_done(fused.fix, seconds, table=table.name, site=table.site, report=report)
            track = table.tracker.follow(fused) if follows else None
        except ReportError as error:
            if incoming.adapted is None:
                raise
            raise error_in_message(error, incoming.adapted) from None
        if track is not None:
            self.metrics.track_done(track.state)
        return Located(await self._explained(locator, report, fused.fix, perf_counter() - start), track, seconds)

    async def _fuse(self, fuse: Stoppable[Report, Fused], report: Report, quick: bool) -> Fused:
        """Make a fix on the event loop where it is quick, in a thread where it is not or was not."""
        if quick:
            with suppress(FixStoppedError):
                return self.quick_work.do(lambda stop: fuse(report, stop=stop))
        return await self.slow_work.locate(fuse, report)

    async def _explained(self, locator: Locator, report: Report, fix: Fix, spent: float) -> Fix:
        """Look in a thread for what may be wrong with the site, where a fix is inconsistent and no other work waits.

        It takes what the fix has left of the time limit, at most.
        """
        if fix.status != "inconsistent" or self.slow_work.under_way:
            return fix

        def explain(report: Report, *, stop: Stop) -> Fix:
            return locator.explain(report, fix, stop=stop)

        try:
            return await self.slow_work.locate(explain, report, spent=spent)
        except ProblemError:  # too busy, or too long: the fix itself is there
            return fix

    def write(
        self, table: ServedTable, incoming: Incoming, options: ResponseOptions, located: Located
    ) -> dict[str, Any]:
        """Publish a fix, and write the answer in the requested format.

        Raises
        ------
        ReportError
            When the format needs a position and there is none.
        """
        fix, track, seconds = located
        self.feed.publish(table.name, fix.target_id, partial(_event, table.name, incoming, located))
        site = table.site
        if self.hub is not None:
            self.hub.tell(fix, site, track)
        answer = write(fix, options.output, site, compute_seconds=seconds, adapted=incoming.adapted, track=track)
        if options.with_report and options.output == "native":
            answer["report"] = incoming.native_document()
        return answer

    def unread(self, error: Exception, source: Source) -> dict[str, Any]:
        """Write the problem of one report of several that cannot be read, and count it."""
        self.metrics.reports.done(source, report_outcome(error))
        return problem_of(error)

    async def answer_or_problem(
        self,
        table: ServedTable,
        make: Callable[[], Incoming | Awaitable[Incoming]],
        options: ResponseOptions,
        source: Source,
    ) -> dict[str, Any]:
        """Answer one report of several, with a problem where it cannot be used, and count it."""
        try:
            with self.metrics.reports.timed(source):
                made = make()
                return await self.answer(table, made if isinstance(made, Incoming) else await made, options)
        except Exception as error:
            return problem_of(error)


def problem_of(error: Exception) -> dict[str, Any]:
    """Write the problem of one report of several."""
    match error:
        case ReportError():
            return report_problem(error)
        case ProblemError():
            return problem_document(error.kind, str(error))
    # A defect in one report's fix must not fail the other 999.
    _log.error("a report of several failed", exc_info=error)
    return internal_problem()


def _event(table: str, incoming: Incoming, located: Located) -> bytes:
    """Write the event of a fix for the feed."""
    fix = fix_to_document(located.fix, located.seconds, located.track)
    return to_json({"table": table, "report": incoming.native_document(), "fix": fix})
