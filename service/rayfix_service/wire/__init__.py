"""The JSON of the HTTP interface, and its way to a report and back from a fix.

On the wire an angle is in degrees, a length in metres and a delay in nanoseconds, and each name has its unit.
Inside, everything is SI and radians. Only this package converts between them.
"""

from rayfix_service.wire.documents import (
    MAX_MEASUREMENTS,
    MAX_REPORTS,
    BatchDocument,
    ReportDocument,
)
from rayfix_service.wire.fields import METRES_PER_NANOSECOND, WireModel
from rayfix_service.wire.points import Point
from rayfix_service.wire.problems import (
    FieldProblem,
    InvalidReportError,
    MalformedJsonError,
    more_problems,
    problems_of,
)
from rayfix_service.wire.request import parse_report, read_json
from rayfix_service.wire.response import FixDocument, fix_to_document
from rayfix_service.wire.writing import report_to_document
from rayfix_tables.validation.problems import path_text

__all__ = [
    "MAX_MEASUREMENTS",
    "MAX_REPORTS",
    "METRES_PER_NANOSECOND",
    "BatchDocument",
    "FieldProblem",
    "FixDocument",
    "InvalidReportError",
    "MalformedJsonError",
    "Point",
    "ReportDocument",
    "WireModel",
    "fix_to_document",
    "more_problems",
    "parse_report",
    "path_text",
    "problems_of",
    "read_json",
    "report_to_document",
]
