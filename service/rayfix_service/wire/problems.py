"""What can be wrong with a document, in words that name the field, its value and the remedy.

::

    ReportError                 (rayfix_tables.errors)
    ├── MalformedJsonError      the bytes are not JSON
    └── InvalidReportError      JSON, but not a report; ``problems`` lists all that is wrong
"""

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import get_args

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from rayfix_service.wire.documents import HeightDocument, ReportDocument
from rayfix_service.wire.fields import MISFIT, WireModel
from rayfix_service.wire.limits import USUAL_LIMITS, names_of, trimmed
from rayfix_service.wire.measurements import MEASUREMENT_DOCUMENTS
from rayfix_tables.errors import ReportError

_MAX_SHOWN = 60  # characters of a value or a key that a message repeats

Path = tuple[str | int, ...]


@dataclass(frozen=True, kw_only=True)
class FieldProblem:
    """One thing that is wrong with a document.

    Attributes
    ----------
    path : tuple of (str or int)
        The offending field, e.g. ``("measurements", 0, "azimuth_deg")``; empty for the document as a whole.
    message : str
        The field, its value, and what to do about it.
    """

    path: Path
    message: str


class MalformedJsonError(ReportError):
    """The bytes are not a JSON text."""


class InvalidReportError(ReportError):
    """A document that is not a valid report.

    Parameters
    ----------
    problems : tuple of FieldProblem
        At least one; the first gives the error its message and its ``path``.
    more : int
        Problems that were found besides. A megabyte of unknown keys must not become megabytes of text.
    """

    def __init__(self, problems: tuple[FieldProblem, ...], more: int = 0) -> None:
        others = len(problems) - 1 + more
        text = f" (and {others} more)" if others else ""
        super().__init__(problems[0].message + text, path=problems[0].path)
        self.problems = problems
        self.more = more

    def __reduce__(self) -> tuple[type["InvalidReportError"], tuple[tuple[FieldProblem, ...], int]]:
        """Pickle what it is made from: processes of a batch hand errors to each other."""
        return type(self), (self.problems, self.more)


def problems_of(error: ReportError) -> tuple[FieldProblem, ...]:
    """List all that is wrong according to `error`: one thing, unless it is an :class:`InvalidReportError`."""
    if isinstance(error, InvalidReportError):
        return error.problems
    return (FieldProblem(path=error.path, message=str(error)),)


def more_problems(error: ReportError) -> int:
    """Count what is wrong according to `error` beyond what :func:`problems_of` lists."""
    return error.more if isinstance(error, InvalidReportError) else 0


def invalid_report(
    error: ValidationError,
    model: type[WireModel],
    document: object,
    problem_of: Callable[[ErrorDetails], FieldProblem],
    most: int,
) -> InvalidReportError:
    """Say in this project's words what pydantic found wrong with a document.

    The time and memory that this takes do not grow with the number of errors, which a megabyte can have 100,000 of.

    Parameters
    ----------
    error : ValidationError
    model : type of WireModel
        Model of the document.
    document : object
        The document itself.
    problem_of : callable
        Words an error.
    most : int
        Problems that the error lists at most, the first ones; the others are counted.
    """
    found = error.error_count()
    looked_at = max(most, USUAL_LIMITS.listed_problems)
    if found > looked_at:
        try:
            model.model_validate(trimmed(document, names_of(model), looked_at))
        except ValidationError as fewer:
            error = fewer
    details = error.errors(include_url=False)[:looked_at]
    # A misspelt key comes with a missing one; the first message should be the one that says so.
    details.sort(key=lambda detail: detail["type"] != "extra_forbidden")
    problems = tuple(problem_of(detail) for detail in details[:most])
    return InvalidReportError(problems, found - len(problems))


def path_text(path: Path) -> str:
    """Write a path as people do: ``measurements[0].azimuth_deg``."""
    text = ""
    for step in path:
        # What is no plain name is quoted, and its control characters with it.
        plain = isinstance(step, str) and step.isidentifier() and len(step) <= _MAX_SHOWN
        text += f".{step}" if plain else f"[{step if isinstance(step, int) else repr(_shortened(step))}]"
    return text.removeprefix(".")


def shown(value: object) -> str:
    """Name a value of a document in a message, briefly and in the words of JSON."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    if isinstance(value, Mapping):
        return "an object"
    if isinstance(value, list | tuple):
        return f"an array of length {len(value)}"
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "infinite"
    if isinstance(value, int) and abs(value) > 10**20:
        return "a number of more than 20 digits"  # repr fails beyond 4300
    if isinstance(value, str):
        return repr(_shortened(value))
    if isinstance(value, int | float):
        return repr(value)
    return f"a Python {type(value).__name__}"


def _shortened(text: str) -> str:
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


def report_problem_of(error: ErrorDetails) -> FieldProblem:
    """Word what pydantic found wrong with a report."""
    path, kind, value, context = error["loc"], error["type"], error["input"], error.get("ctx", {})
    model: type[WireModel] = ReportDocument
    if len(path) > 2 and path[0] == "measurements":
        # pydantic puts the tag of the union into the path; the document has no such step.
        model, path = MEASUREMENT_DOCUMENTS[str(path[2])], (*path[:2], *path[3:])
    elif len(path) > 1 and path[0] == "height":
        model = HeightDocument
    if kind == MISFIT:
        path = path if context["field"] is None else (*path, context["field"])
        text = context["text"]
    elif kind in ("extra_forbidden", "invalid_key"):
        known = list(model.model_fields)
        close = difflib.get_close_matches(_shortened(str(path[-1])), known, n=1)
        remedy = f"did you mean {close[0]}?" if close else f"leave it out or use one of {', '.join(known)}"
        text = f"is an unknown key; {remedy}"
    elif kind in ("union_tag_invalid", "union_tag_not_found"):
        path = (*path, "type")
        found = f"is {shown(value['type'])}" if "type" in value else "is missing"
        text = f"{found}; give one of {', '.join(MEASUREMENT_DOCUMENTS)}"
    elif not path:
        text = f'is {shown(value)}; give a JSON object, e.g. {{"measurements": [...]}}'
    elif len(path) == 2 and path[0] == "measurements":
        text = f'is {shown(value)}; give a JSON object, e.g. {{"type": "aoa", "station_id": "bs1", ...}}'
    else:
        found = "is missing" if kind == "missing" else f"is {shown(value)}"
        text = f"{found}; give {_description(model, str(path[-1]))}"
    return FieldProblem(path=path, message=f"{path_text(path) or 'the report'} {text}")


def _description(model: type[WireModel], name: str) -> str:
    """Find what a field takes; for an optional field this sits inside its annotation."""
    field = model.model_fields[name]
    inner = (m.description for a in get_args(field.annotation) for m in getattr(a, "__metadata__", ()))
    return field.description or next(inner, None) or f"one of {', '.join(get_args(field.annotation))}"
