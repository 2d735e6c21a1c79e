"""Tables beside each other on a log: ``rayfix compare``."""

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rayfix.commands.arguments import (
    TABLE_SUFFIXES,
    AddCommand,
    add_jobs_argument,
    add_progress_argument,
    at_least_one,
)
from rayfix.commands.logs import add_source_arguments, log_reading
from rayfix.errors import ReportError
from rayfix.extras import needs_extra

if TYPE_CHECKING:
    from rayfix.logs.reading import Reading
    from rayfix_evaluation.recorded.comparison import Comparison, TableEvidence
    from rayfix_service.fusion.measurements.report import Height, Report

_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def add_commands(add: AddCommand) -> None:
    """Add the command to the command line."""
    compare = add("compare", _compare, "tell which of several tables a recorded log speaks for")
    compare.add_argument(
        "files", type=Path, nargs="+", metavar="T.h5|LOG", help="two or more tables, and logs as those of rayfix locate"
    )
    compare.add_argument(
        "--reports",
        type=at_least_one,
        default=4000,
        metavar="N",
        help="take at most so many reports, spread evenly over the logs (default: 4000)",
    )
    add_source_arguments(compare)
    add_jobs_argument(compare, "processes that locate the reports")
    add_progress_argument(compare)
    compare.add_argument("--json", action="store_true", help="print the figures as JSON")


def _compare(options: argparse.Namespace) -> int:
    with needs_extra("service"):
        from rayfix_evaluation.recorded.comparison import compare_tables
        from rayfix_service.adapters.adapted import known_height
        from rayfix_tables.checked import open_checked

    from rayfix.progress import stage_progress

    table_paths, logs = _sorted(options.files)
    tables = [open_checked(path) for path in table_paths]
    reading = log_reading(options, tables[0])
    reports, num_problems = _reports(logs, reading, known_height(*(options.height or (None, None))))
    step = max(1, -(-len(reports) // options.reports))
    taken = reports[::step]
    if not taken:
        raise ReportError("the logs hold no report that can be used; check them by rayfix locate")
    with stage_progress(enabled=not options.no_progress) as progress:
        found = compare_tables(taken, tables, jobs=options.jobs, progress=progress)
    if options.json:
        print(json.dumps(_document(found, num_problems, len(reports)), indent=2))
        return 0
    for line in _lines(found, num_problems, len(reports)):
        print(line)
    return 0


def _sorted(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Tell tables, which are HDF5, from logs."""
    tables = [path for path in files if path.suffix.lower() in TABLE_SUFFIXES or _is_hdf5(path)]
    logs = [path for path in files if path not in tables]
    if len(tables) < 2:
        number = "1 of the files is a table" if tables else "none of the files is a table"
        raise ReportError(f"{number}; give two or more (.h5), and a log")
    if not logs:
        raise ReportError("all files are tables; give a log as well, as for rayfix locate")
    twice = {path for path in tables if tables.count(path) > 1}
    if twice:
        raise ReportError(f"{min(twice)} is given twice; give tables that differ")
    return tables, logs


def _is_hdf5(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(_SIGNATURE)) == _SIGNATURE
    except OSError:
        return False  # the reader of logs says what is wrong with it


def _reports(logs: Sequence[Path], reading: "Reading", height: "Height | None") -> "tuple[list[Report], int]":
    """Read the reports of logs; entries that are none are counted."""
    from rayfix.logs.entries import Problem
    from rayfix.logs.reading import read_logs
    from rayfix_service.wire import parse_report

    reports, num_problems = [], 0
    for entry in read_logs(logs, reading):
        try:
            if isinstance(entry, Problem):
                raise ReportError(entry.text)
            report = parse_report(entry.report) if isinstance(entry.report, bytes) else entry.report
        except ReportError:
            num_problems += 1
            continue
        reports.append(replace(report, height=height) if report.height is None and height is not None else report)
    return reports, num_problems


def _document(found: "Comparison", num_problems: int, num_reports: int) -> dict[str, Any]:
    best = found.best
    return {
        "reports": found.count,
        "reports_left_out": found.left_out,
        "reports_of_the_logs": num_reports,
        "problems": num_problems,
        "tables": [
            {
                "path": str(each.table.path),
                "table_id": each.table.table_id,
                "site": each.table.site.name,
                "opaque_walls": not each.table.passes_walls,
                "log_evidence": each.total,
                "log_evidence_per_report": each.mean,
                "below_best": abs(each.difference) * found.count,
                "below_best_per_report": abs(each.difference),
                "below_best_per_report_error": _or_none(each.difference_error),
                "worse": each is not best and each.is_worse(found.count),
                "inconsistent": each.inconsistent,
                "unanswered": each.unanswered,
            }
            for each in found.tables
        ],
        "best": str(best.table.path) if found.told else None,
        "verdict": _verdict(found),
    }


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _lines(found: "Comparison", num_problems: int, num_reports: int) -> list[str]:
    """Describe a comparison."""
    from rayfix.console import counted, walls_of

    compared = found.count + found.left_out
    lines = []
    for each in found.tables:
        lines += [
            f"{each.table.path}: site '{each.table.site.name}'; {walls_of(each.table)}",
            f"  log evidence {each.total:.1f}, of a report {each.mean:.3f}{_below(each, found)}",
            f"  inconsistent in {each.inconsistent} of {counted(found.count, 'report')}",
        ]
    lines.append(
        f"{counted(found.count, 'report')} of {compared} could be answered by all tables from the same measurements"
    )
    lines += [
        f"  {each.table.path} could not use all that another one used of {counted(each.unanswered, 'report')}"
        for each in found.tables
        if each.unanswered
    ]
    if num_reports > compared:
        lines.append(f"{compared} of {num_reports} reports of the logs were taken, spread evenly; --reports takes more")
    if num_problems:
        entries = "1 entry is no report" if num_problems == 1 else f"{num_problems} entries are no reports"
        lines.append(f"{entries}; 'rayfix locate' lists them")
    return [*lines, _verdict(found)]


def _below(each: "TableEvidence", found: "Comparison") -> str:
    if each is found.best:
        return ", the most"
    total, error = -each.difference * found.count, each.difference_error * found.count
    return f", {total:.1f} ± {error:.1f} below the best, {-each.difference:.3f} ± {each.difference_error:.3f} a report"


def _verdict(found: "Comparison") -> str:
    """Say which table is ahead, if the log tells."""
    from rayfix_evaluation.recorded.comparison import LEAST_REPORTS

    best = found.best
    others = [each for each in found.tables if each is not best]
    if found.count < LEAST_REPORTS:
        reports = "1 report is" if found.count == 1 else f"{found.count} reports are"
        return f"{reports} too few to tell which table is the better one; give a log of {LEAST_REPORTS} or more"
    alike = [each for each in others if not each.is_worse(found.count)]
    if alike:
        names = ", ".join(str(each.table.path) for each in [best, *alike])
        worse = [str(each.table.path) for each in others if each not in alike]
        rest = f"; {', '.join(worse)} explain{'s' if len(worse) == 1 else ''} it worse" if worse else ""
        return f"the log does not tell which of {names} is the better one{rest}"
    nearest = max(others, key=lambda each: each.difference)
    return (
        f"{best.table.path} is ahead: it explains a report better than {nearest.table.path} by "
        f"{-nearest.difference:.2f} ± {nearest.difference_error:.2f} nats; both may be wrong"
    )
