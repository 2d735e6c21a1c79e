"""Which of several tables a log speaks for: the log evidence of its reports with each of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.locator import Locator
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table

__all__ = ["LEAST_REPORTS", "Comparison", "TableEvidence", "compare_tables", "standard_error"]

_CHUNK = 512
"""Reports that are located at a time, between which the progress is told."""

LEAST_REPORTS = 10
"""Fewer reports tell nothing: neither are they typical, nor is their scatter known."""

_LEAST_BLOCKS = 8
"""Blocks that a standard error is worked out from at least, where there are so many reports."""

_SURE_ERRORS = 3.0
"""Standard errors from which on a difference is none of chance."""

_SURE_NATS = 3.0
"""Summed difference from which on a log speaks for a table; a factor of 20 in probability."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class TableEvidence:
    """How well a table explains the reports that all tables can answer.

    Attributes
    ----------
    table : Table
    total, mean : float
        Log evidence of all reports, and of a report, nats.
    difference : float
        Of ``mean`` from that of the best table, nats a report; 0 for the best, below it for the others.
    difference_error : float
        Standard error of ``difference``; NaN for the best, and where one report is all.
    inconsistent : int
        Reports whose fix is ``inconsistent``.
    unanswered : int
        Reports of the log that this table could not answer, or not with all measurements that another one used.
    """

    table: Table
    total: float
    mean: float
    difference: float
    difference_error: float
    inconsistent: int
    unanswered: int

    def is_worse(self, count: int) -> bool:
        """Whether ``count`` reports tell that this table is worse than the best."""
        return (
            count >= LEAST_REPORTS
            and -self.difference * count >= _SURE_NATS
            and -self.difference >= _SURE_ERRORS * self.difference_error
        )


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Tables beside each other.

    Attributes
    ----------
    tables : tuple of TableEvidence
        In the order in which they were given.
    count : int
        Reports that all tables answered from the same measurements; they alone are compared.
    left_out : int
        Other reports.
    """

    tables: tuple[TableEvidence, ...]
    count: int
    left_out: int

    @property
    def best(self) -> TableEvidence:
        """The table with the most evidence, whether or not that tells."""
        return max(self.tables, key=lambda each: each.difference)

    @property
    def told(self) -> bool:
        """Whether the log tells that the best table is better than all others."""
        return all(each.is_worse(self.count) for each in self.tables if each is not self.best)


def compare_tables(
    reports: Sequence[Report],
    tables: Sequence[Table],
    *,
    jobs: int = -1,
    progress: Progress = lambda stage, done, total: None,
) -> Comparison:
    """Locate reports with each table, and compare the log evidence of those that all tables can answer.

    An evidence is a density of what was measured, so that only evidences of the same measurements compare: a report
    counts where each table uses the same ones of it.

    Parameters
    ----------
    reports : sequence of Report
        In the order of the log.
    tables : sequence of Table
        Two or more, of sites whose stations have the same names.
    jobs : int
        Processes; -1 for one per core.
    progress : callable
        Given a stage, and how many of how many fixes are done.

    Raises
    ------
    ReportError
        When no report can be answered by all tables.
    """
    answers: list[list[Fix | ReportError]] = []
    total = len(reports) * len(tables)
    for number, table in enumerate(tables):
        locator = Locator(table)
        found: list[Fix | ReportError] = []
        for begin in range(0, len(reports), _CHUNK):
            progress("locating", number * len(reports) + begin, total)
            found += locator.locate_batch(reports[begin : begin + _CHUNK], jobs=jobs)
        answers.append(found)
    progress("locating", total, total)
    used = [[_used(answer) for answer in found] for found in answers]
    common = [n for n, each in enumerate(zip(*used, strict=True)) if each[0] and all(u == each[0] for u in each)]
    if not common:
        reasons = {str(answer) for found in answers for answer in found if isinstance(answer, ReportError)}
        why = f"; the first reason: {min(reasons)}" if reasons else ""
        raise ReportError(
            f"none of {len(reports)} reports can be answered by all tables from the same measurements{why}"
        )
    evidence = np.array([[_fix(found[n]).log_evidence for n in common] for found in answers])
    targets = [reports[n].target_id or "" for n in common]
    inconsistent = [sum(_fix(found[n]).status == "inconsistent" for n in common) for found in answers]
    return Comparison(
        tables=_evidences(tables, evidence, targets, inconsistent, [_unanswered(used, n) for n in range(len(tables))]),
        count=len(common),
        left_out=len(reports) - len(common),
    )


def standard_error(values: NDArray[np.float64], targets: Sequence[str]) -> float:
    """Return the standard error of the mean of values that may be correlated along the track of a target.

    Parameters
    ----------
    values : ndarray of shape (n,)
        In the order of the log.
    targets : sequence of n str
        Whose they are; those of a target follow each other in blocks.

    Returns
    -------
    float
        The largest of the standard errors from means of blocks of 1, 2, 4, ... values, as long as there are enough
        blocks (Flyvbjerg and Petersen 1989): that of independent values does not grow with the blocks. NaN for a single
        value.
    """
    if len(values) < 2:
        return float("nan")
    ordered = values[np.argsort(np.asarray(targets), kind="stable")]
    errors, size = [], 1
    while size == 1 or len(ordered) // size >= _LEAST_BLOCKS:
        count = len(ordered) // size
        means = ordered[: count * size].reshape(count, size).mean(axis=1)
        errors.append(means.std(ddof=1) / np.sqrt(count))
        size *= 2
    return float(max(errors))


def _used(answer: Fix | ReportError) -> tuple[bool, ...]:
    """Return which measurements a fix is made of; none where there is none."""
    if isinstance(answer, ReportError) or not np.isfinite(answer.log_evidence):
        return ()
    used = tuple(outcome.used for outcome in answer.outcomes)
    return used if any(used) else ()


def _unanswered(used: Sequence[Sequence[tuple[bool, ...]]], number: int) -> int:
    """Count the reports of which a table uses less than another one."""
    return sum(any(sum(other[n]) > sum(mine) for other in used) for n, mine in enumerate(used[number]))


def _fix(answer: Fix | ReportError) -> Fix:
    assert isinstance(answer, Fix)
    return answer


def _evidences(
    tables: Sequence[Table],
    evidence: NDArray[np.float64],
    targets: Sequence[str],
    inconsistent: Sequence[int],
    unanswered: Sequence[int],
) -> tuple[TableEvidence, ...]:
    mean = evidence.mean(axis=1)
    best = int(mean.argmax())
    return tuple(
        TableEvidence(
            table=table,
            total=float(evidence[n].sum()),
            mean=float(mean[n]),
            difference=float(mean[n] - mean[best]),
            difference_error=float("nan") if n == best else standard_error(evidence[n] - evidence[best], targets),
            inconsistent=inconsistent[n],
            unanswered=unanswered[n],
        )
        for n, table in enumerate(tables)
    )
