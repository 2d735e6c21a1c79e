"""Locating within a request."""

import asyncio
import logging
from collections.abc import Callable
from time import perf_counter
from typing import Any

from rayfix_service.adapters.adapted import Adapted, error_in_message
from rayfix_service.adapters.formats import OutputFormat, write
from rayfix_service.fusion.locator import Locator
from rayfix_service.fusion.report import Fix, Report
from rayfix_service.http.problems import internal_problem, report_problem
from rayfix_tables.errors import ReportError

_log = logging.getLogger(__name__)

# Routes are "async def" and compute right on the event loop. A fix with an angle takes a millisecond or a few, and
# in the thread pool that FastAPI has for "def" they would wait for each other's GIL: measured with two threads,
# 1.6 ms become 3.4. More worker processes use more processor cores. Only a report of very many measurements, which
# can take seconds, goes to a thread, so that /livez answers meanwhile.
_MEASUREMENTS_ON_LOOP = 16


async def locate(locator: Locator, report: Report) -> tuple[Fix, float]:
    """Locate a report; returns the fix and the time that it took, s.

    Raises
    ------
    ReportError
        When a station is not in the table.
    """
    start = perf_counter()
    if len(report.measurements) <= _MEASUREMENTS_ON_LOOP:
        fix = locator.locate(report)
    else:
        fix = await asyncio.to_thread(locator.locate, report)
    return fix, perf_counter() - start


async def answer(locator: Locator, report: Report | Adapted, output: OutputFormat) -> dict[str, Any]:
    """Locate a report and write the answer in a format.

    Raises
    ------
    ReportError
        When a station is not in the table, or the format needs a position and there is none.
    """
    site = locator.table.site
    if isinstance(report, Report):
        fix, seconds = await locate(locator, report)
        return write(fix, output, site, compute_seconds=seconds)
    try:
        fix, seconds = await locate(locator, report.report)
    except ReportError as error:
        raise error_in_message(error, report) from None
    return write(fix, output, site, compute_seconds=seconds, adapted=report)


async def answer_or_problem(
    locator: Locator, make_report: Callable[[], Report | Adapted], output: OutputFormat
) -> dict[str, Any]:
    """Answer one report of several, with a problem where it cannot be used."""
    try:
        return await answer(locator, make_report(), output)
    except ReportError as error:
        return report_problem(error)
    except Exception:
        # A defect that one report meets must not cost the other 999 their fix.
        _log.exception("a report of a batch failed")
        return internal_problem()
