"""Locate the reports of a file."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rayfix_service.adapters.adapted import check_stations, error_in_message
from rayfix_service.adapters.formats import InputFormat, OutputFormat, parse, write
from rayfix_service.adapters.ublox import USUAL_ERRORS, AngleErrors
from rayfix_service.fusion.measurements.report import Height
from rayfix_service.locator import Locator
from rayfix_tables.checked import open_checked
from rayfix_tables.errors import ReportError


def locate_file(
    table_path: Path,
    report_path: Path,
    *,
    input_format: InputFormat = "native",
    output_format: OutputFormat = "native",
    stations: Mapping[str, str] | None = None,
    height: Height | None = None,
    confidence: float | None = None,
    errors: AngleErrors | None = None,
) -> list[dict[str, Any]]:
    """Locate a file's report and return the HTTP interface's JSON; for u-blox lines, one answer per transmission.

    Parameters
    ----------
    table_path, report_path : pathlib.Path
    input_format, output_format : str
        Formats of docs/formats.md.
    stations : Mapping, optional
        Stations by their names in the file; a native report uses the stations' identifiers.
    height : Height, optional
        Prior of the target's height, for reports without one.
    confidence : float, optional
        Probability that the stated accuracies hold, instead of the report's.
    errors : AngleErrors, optional
        Errors of the angles of u-blox lines, which do not state them.

    Raises
    ------
    TableError
        When the table cannot be used.
    ReportError
        When the report cannot be read or used; the message names the file.
    """
    if stations and input_format == "native":
        raise ReportError("a native report names the stations of the table; --station is for other systems' messages")
    if errors is not None and input_format != "ublox":
        raise ReportError(
            f"{input_format} reports state the errors of their angles; --stdev and --tails are for u-blox lines"
        )
    try:
        body = report_path.read_bytes()
    except OSError as error:
        raise ReportError(f"{report_path} cannot be read ({error.strerror}); give a file with a report") from error
    if input_format == "native" and holds_lines(body):
        raise ReportError(f"{report_path} holds more than one report; add -o FIXES.jsonl, which locates logs")
    table = open_checked(table_path)
    check_stations(stations or {}, table.parts)
    locator = Locator(table)
    answers = []
    try:
        found = parse(
            body,
            input_format,
            stations=stations,
            height=height,
            confidence=confidence,
            errors=errors or USUAL_ERRORS,
        )
        for adapted in found:
            begin = time.perf_counter()
            try:
                fix = locator.locate(adapted.report)
            except ReportError as error:
                raise error if input_format == "native" else error_in_message(error, adapted) from None
            answers.append(
                write(
                    fix,
                    output_format,
                    table.site,
                    compute_seconds=time.perf_counter() - begin,
                    adapted=None if input_format == "native" else adapted,
                )
            )
    except ReportError as error:
        raise ReportError(f"{report_path}: {error}", path=error.path) from error
    return answers


def holds_lines(body: bytes) -> bool:
    """Whether a file that was taken for a report is a log with a report in each line."""
    lines = [line for line in body.splitlines() if line.strip()]
    return len(lines) > 1 and all(line.lstrip().startswith(b"{") and line.rstrip().endswith(b"}") for line in lines[:2])
