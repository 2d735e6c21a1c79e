"""Locate a report that lies in a file."""

import time
from pathlib import Path
from typing import Any

from rayfix_service.fusion.locator import Locator
from rayfix_service.wire import fix_to_document, parse_report
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table


def locate_file(table_path: Path, report_path: Path) -> dict[str, Any]:
    """Answer a report file as ``POST /v1/positions`` would.

    Raises
    ------
    TableError
        When the table cannot be used.
    ReportError
        When the report cannot be read or used; the message names the file.
    """
    try:
        body = report_path.read_bytes()
    except OSError as error:
        raise ReportError(f"{report_path} cannot be read ({error.strerror}); give a JSON report") from error
    table = Table.open(table_path)
    begin = time.perf_counter()
    try:
        fix = Locator(table).locate(parse_report(body))
    except ReportError as error:
        raise ReportError(f"{report_path}: {error}", path=error.path) from error
    return fix_to_document(fix, time.perf_counter() - begin)
