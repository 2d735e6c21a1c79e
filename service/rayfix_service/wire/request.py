"""From the JSON of a report to the report."""

import codecs
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError
from pydantic_core import from_json

from rayfix_service.fusion.measurements.report import Report
from rayfix_service.wire.documents import MAX_MEASUREMENTS, ReportDocument
from rayfix_service.wire.limits import USUAL_LIMITS, MessageLimits, has_more_values
from rayfix_service.wire.problems import (
    FieldProblem,
    InvalidReportError,
    MalformedJsonError,
    invalid_report,
)

_SHORT = 16 << 10
"""Bytes of a report up to which its values are not counted before the validation."""


def read_json(body: bytes) -> object:
    """Parse a JSON text; a byte order mark before it, as some editors write one, is skipped.

    The literals NaN and Infinity and numbers like 1e400 become floats that are not finite: the model then
    refuses them with their path, which helps more than "malformed" would.

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON.
    """
    body = body.removeprefix(codecs.BOM_UTF8)
    if not body.strip():
        raise MalformedJsonError('the document is empty; give a JSON object, e.g. {"measurements": [...]}')
    try:
        return from_json(body)
    except ValueError as error:
        raise MalformedJsonError(f"the document is not JSON: {error}; give one complete JSON object in UTF-8") from None


def parse_report(document: Mapping[str, Any] | bytes, *, limits: MessageLimits = USUAL_LIMITS) -> Report:
    """Turn a report's JSON into a :class:`Report`.

    Parameters
    ----------
    document : Mapping or bytes
        The parsed document, or its JSON text.
    limits : MessageLimits, optional

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON.
    InvalidReportError
        For a document that is not a valid report, or a text of more values than a report can have.
    """
    if isinstance(document, bytes):
        document = document.removeprefix(codecs.BOM_UTF8)
        model = _validate_text(document, limits)
    else:
        model = _validate(document, limits)
    return Report(
        measurements=tuple(m.measurement() for m in model.measurements),
        height=None if model.height is None else model.height.height(),
        confidence=model.confidence,
        selection=None if model.selection is None else model.selection.selection(),
        target_id=model.target_id,
        timestamp=model.timestamp,
    )


def _validate_text(text: bytes, limits: MessageLimits) -> ReportDocument:
    most = limits.report_values
    if len(text) > min(_SHORT, most) and has_more_values(text, most):
        message = f"the report has more than {most} values; give at most {MAX_MEASUREMENTS} measurements"
        raise InvalidReportError((FieldProblem(path=(), message=message),))
    try:
        return ReportDocument.model_validate_json(text)  # three times faster than by way of a dict
    except ValidationError:
        return _validate(read_json(text), limits)  # finds the same, and has the values for the messages


def _validate(data: object, limits: MessageLimits) -> ReportDocument:
    document = dict(data) if isinstance(data, Mapping) else data
    try:
        return ReportDocument.model_validate(document)
    except ValidationError as error:
        raise invalid_report(error, ReportDocument, document, "the report", limits.listed_problems) from None
