"""Taking the JSON text of a batch apart into those of its reports.

A batch is never parsed as a whole: 16 MB of JSON can become 1.6 GB of objects, and nothing else of the process runs
meanwhile.
"""

import re

from pydantic_core import to_json

from rayfix_service.wire.documents import MAX_REPORTS
from rayfix_service.wire.limits import MAX_DEPTH, TOKEN, USUAL_LIMITS, MessageLimits
from rayfix_service.wire.problems import FieldProblem, InvalidReportError, MalformedJsonError
from rayfix_service.wire.request import read_json
from rayfix_tables.validation.problems import Path, path_text

_HEAD = re.compile(rb'\s*\{\s*"reports"\s*:\s*\[')


def split_batch(body: bytes, *, limits: MessageLimits = USUAL_LIMITS) -> list[bytes]:
    """Return the JSON texts of a batch's reports, each of which may still be anything.

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON, as far as they lie outside of the reports.
    InvalidReportError
        For what is not a batch, or one of too many reports.
    """
    head = _HEAD.match(body)
    if head is None:
        return _short_batch(body, limits)
    reports, end = _elements(body, head.end())
    rest = len(body) - end
    if rest > limits.batch_rest_bytes:
        raise _refused((), f"the batch has {rest} bytes after its reports; a batch has the key reports alone")
    if _short_batch(body[: head.end()] + body[end:], limits):
        raise _refused(("reports",), "reports is there twice; give one array")
    return reports


def _elements(body: bytes, begin: int) -> tuple[list[bytes], int]:
    """Split the array that begins at an index; returns its elements and the index of its closing bracket."""
    elements: list[bytes] = []
    depth, start = 0, begin
    for token in TOKEN.finditer(body, begin):
        mark = body[token.start()]
        if mark in b"[{":
            depth += 1
            if depth > MAX_DEPTH:
                raise MalformedJsonError(
                    f"the document is nested more than {MAX_DEPTH} deep; give reports as documented"
                )
        elif mark in b"]}" and depth:
            depth -= 1
        elif not depth and mark in b",]}":
            if mark == _COMMA or elements or body[start : token.start()].strip():
                elements.append(body[start : token.start()])
            if len(elements) > MAX_REPORTS:
                text = f"reports is an array of more than {MAX_REPORTS}; give at most {MAX_REPORTS} at once"
                raise _refused(("reports",), text)
            if mark != _COMMA:
                return elements, token.start()  # a "}" here is no JSON, as the rest then shows
            start = token.end()
    raise MalformedJsonError("the document is not JSON: it ends within reports; give one complete JSON object in UTF-8")


_COMMA = ord(",")


def _short_batch(body: bytes, limits: MessageLimits) -> list[bytes]:
    """Take a batch apart by parsing it as a whole."""
    if len(body) > len(b'{"reports":[') + limits.batch_rest_bytes:
        raise _refused((), 'the batch does not begin with its reports; give {"reports": [...]}')
    document = read_json(body)
    path: Path = ()
    if not isinstance(document, dict):
        text = 'the batch is no JSON object; give {"reports": [...]}'
    elif unknown := [key for key in document if key != "reports"]:
        path = (unknown[0],)
        text = f"{path_text(path)} is an unknown key; a batch has the key reports alone"
    elif not isinstance(document.get("reports"), list):
        path = ("reports",)
        text = "reports is missing or no array; give an array of reports"
    else:
        return [to_json(report) for report in document["reports"]]
    raise _refused(path, text)


def _refused(path: Path, text: str) -> InvalidReportError:
    return InvalidReportError((FieldProblem(path=path, message=text),))
