"""Locating within a request."""

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Annotated, Any

from fastapi import Depends, Request

from rayfix_service.adapters.adapted import Adapted, error_in_message
from rayfix_service.adapters.formats import OutputFormat, write
from rayfix_service.fusion.locator import Locator
from rayfix_service.fusion.report import Fix, Report
from rayfix_service.http.dependencies import LocatorDep
from rayfix_service.http.metrics import Metrics
from rayfix_service.http.problems import internal_problem, report_problem
from rayfix_tables.errors import ReportError

_log = logging.getLogger(__name__)

# Routes are "async def" and compute right on the event loop. A fix with an angle takes a millisecond or a few, and
# in the thread pool that FastAPI has for "def" they would wait for each other's GIL: measured with two threads,
# 1.6 ms become 3.4. More worker processes use more processor cores. Only a report of very many measurements, which
# can take seconds, goes to a thread, so that /livez answers meanwhile.
_MEASUREMENTS_ON_LOOP = 16


@dataclass(frozen=True, kw_only=True)
class Answerer:
    """What answers reports: the locator, and the figures that it adds to."""

    locator: Locator
    metrics: Metrics

    async def answer(self, report: Report | Adapted, output: OutputFormat) -> dict[str, Any]:
        """Locate a report and write the answer in a format.

        Raises
        ------
        ReportError
            When a station is not in the table, or the format needs a position and there is none.
        """
        site = self.locator.table.site
        if isinstance(report, Report):
            fix, seconds = await self._locate(report)
            return write(fix, output, site, compute_seconds=seconds)
        try:
            fix, seconds = await self._locate(report.report)
        except ReportError as error:
            raise error_in_message(error, report) from None
        return write(fix, output, site, compute_seconds=seconds, adapted=report)

    async def answer_or_problem(
        self, make_report: Callable[[], Report | Adapted], output: OutputFormat
    ) -> dict[str, Any]:
        """Answer one report of several, with a problem where it cannot be used."""
        try:
            return await self.answer(make_report(), output)
        except ReportError as error:
            return report_problem(error)
        except Exception:
            # A defect that one report meets must not cost the other 999 their fix.
            _log.exception("a report of a batch failed")
            return internal_problem()

    async def _locate(self, report: Report) -> tuple[Fix, float]:
        """Locate a report; returns the fix and the time that it took, s."""
        start = perf_counter()
        if len(report.measurements) <= _MEASUREMENTS_ON_LOOP:
            fix = self.locator.locate(report)
        else:
            fix = await asyncio.to_thread(self.locator.locate, report)
        seconds = perf_counter() - start
        self.metrics.fix_done(fix, seconds)
        return fix, seconds


async def get_answerer(request: Request, locator: LocatorDep) -> Answerer:
    """Return what answers, or end the request with 503."""
    return Answerer(locator=locator, metrics=request.app.state.metrics)


AnswererDep = Annotated[Answerer, Depends(get_answerer)]
