"""Figures of reports by the way that they came, whichever route, stream or broker that is."""

from time import perf_counter
from types import TracebackType
from typing import Literal, get_args

from prometheus_client import CollectorRegistry, Counter, Histogram

from rayfix_service.http.problems import ProblemError
from rayfix_tables.errors import ReportError

Source = Literal["positions", "batch", "nrppa", "nrppa_batch", "silabs", "silabs_batch", "ublox", "stream", "mqtt"]
"""How a report came: by ``POST /v1/positions``, a route below it, ``WS /v1/stream`` or an MQTT broker."""

ReportOutcome = Literal["answered", "refused", "failed"]
"""What became of a report: ``refused`` for a fault of its sender, ``failed`` for one of the service."""

SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


def report_outcome(error: BaseException | None) -> ReportOutcome:
    """Name the outcome of a report that ended with an error, or with none."""
    if error is None:
        return "answered"
    if isinstance(error, ReportError) or (isinstance(error, ProblemError) and error.kind.status < 500):
        return "refused"
    return "failed"


class ReportFigures:
    """Counts reports and their times.

    Parameters
    ----------
    registry : CollectorRegistry
        To which the figures belong.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        reports = Counter(
            "rayfix_reports",
            "Reports by how they came and what became of them: answered, refused or failed",
            ("source", "outcome"),
            registry=registry,
        )
        seconds = Histogram(
            "rayfix_report_seconds",
            "Time from the text of a report to its answer, waiting for a thread included",
            ("source",),
            buckets=SECONDS,
            registry=registry,
        )
        # All that there can be is there from the start, at 0, so that a rate begins with the first.
        self._reports = {
            (source, outcome): reports.labels(source, outcome)
            for source in get_args(Source)
            for outcome in get_args(ReportOutcome)
        }
        self._seconds = {source: seconds.labels(source) for source in get_args(Source)}

    def done(self, source: Source, outcome: ReportOutcome, seconds: float | None = None) -> None:
        """Count a report, and the time that its answer took, s, where there is one."""
        self._reports[source, outcome].inc()
        if seconds is not None:
            self._seconds[source].observe(seconds)

    def timed(self, source: Source) -> "TimedReport":
        """Return a context that counts the report that is answered in it."""
        return TimedReport(self, source)


class TimedReport:
    """Counts a report and its time, by whether its context ends with an error."""

    def __init__(self, figures: ReportFigures, source: Source) -> None:
        self._figures = figures
        self._source: Source = source
        self._start = 0.0

    def __enter__(self) -> None:
        """Start the clock."""
        self._start = perf_counter()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Count the report."""
        outcome = report_outcome(error)
        seconds = perf_counter() - self._start if outcome == "answered" else None
        self._figures.done(self._source, outcome, seconds)
