"""From the JSON of a report to the report."""

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError
from pydantic_core import from_json

from rayfix_service.fusion.measurements.report import Report
from rayfix_service.wire.documents import ReportDocument
from rayfix_service.wire.problems import InvalidReportError, MalformedJsonError, problems_of_validation


def read_json(body: bytes) -> object:
    """Parse a JSON text.

    The literals NaN and Infinity and numbers like 1e400 become floats that are not finite: the model then
    refuses them at their place, which helps more than "malformed" would.

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON.
    """
    if not body.strip():
        raise MalformedJsonError('the document is empty; give a JSON object, e.g. {"measurements": [...]}')
    try:
        return from_json(body)
    except ValueError as error:
        raise MalformedJsonError(f"the document is not JSON: {error}; give one complete JSON object in UTF-8") from None


def parse_report(document: Mapping[str, Any] | bytes) -> Report:
    """Turn a report's JSON into a :class:`Report`.

    Parameters
    ----------
    document : Mapping or bytes
        The parsed document, or its JSON text.

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON.
    InvalidReportError
        For a document that is not a valid report; it lists all its problems.
    """
    model = _validate_text(document) if isinstance(document, bytes) else _validate(document)
    return Report(
        measurements=tuple(m.measurement() for m in model.measurements),
        height=None if model.height is None else model.height.height(),
        confidence=model.confidence,
        target_id=model.target_id,
        timestamp=model.timestamp,
    )


def _validate_text(text: bytes) -> ReportDocument:
    try:
        return ReportDocument.model_validate_json(text)  # three times faster than by way of a dict
    except ValidationError:
        return _validate(read_json(text))  # finds the same, and has the values for the messages


def _validate(data: object) -> ReportDocument:
    try:
        return ReportDocument.model_validate(dict(data) if isinstance(data, Mapping) else data)
    except ValidationError as error:
        raise InvalidReportError(problems_of_validation(error)) from None
