"""Errors of a document, with messages that name the field, its value and the remedy.

::

    ReportError                 (rayfix_tables.errors)
    ├── MalformedJsonError      the bytes are not JSON
    └── InvalidReportError      JSON, but not a report; ``problems`` lists all that is wrong
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from rayfix_service.wire.documents import ReportDocument
from rayfix_service.wire.fields import MISFIT, WireModel
from rayfix_service.wire.limits import USUAL_LIMITS, models_within, names_of, trimmed
from rayfix_service.wire.measurements import MEASUREMENT_DOCUMENTS
from rayfix_tables.errors import ReportError
from rayfix_tables.validation.problems import Path, path_text, shown, unknown_key


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
    what: str,
    most: int = USUAL_LIMITS.listed_problems,
) -> InvalidReportError:
    """Translate pydantic's errors of a document into this project's messages.

    The time and memory that this takes do not grow with the number of errors, which a megabyte can have 100,000 of.

    Parameters
    ----------
    error : ValidationError
    model : type of WireModel
        Model of the document.
    document : object
        The document itself.
    what : str
        The document as a whole, in messages.
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
    # A misspelt key comes with a missing one; the first message should name the misspelt one.
    details.sort(key=lambda detail: detail["type"] != "extra_forbidden")
    problems = tuple(problem_of(model, detail, what) for detail in details[:most])
    return InvalidReportError(problems, found - len(problems))


def problem_of(root: type[WireModel], error: ErrorDetails, what: str) -> FieldProblem:
    """Translate one of pydantic's errors.

    Parameters
    ----------
    root : type of WireModel
        Model of the document.
    error : ErrorDetails
    what : str
        The document as a whole, in messages.
    """
    kind, value, context = error["type"], error["input"], error.get("ctx", {})
    path, owner, field = _look_up(root, error["loc"])
    if kind == MISFIT:
        path = path if context["field"] is None else (*path, context["field"])
        text = context["text"]
    elif kind in ("extra_forbidden", "invalid_key"):
        text = unknown_key(str(path[-1]), [f.alias or name for name, f in owner.model_fields.items()] if owner else [])
    elif kind in ("union_tag_invalid", "union_tag_not_found"):
        path = (*path, "type")
        found = f"is {shown(value['type'])}" if "type" in value else "is missing"
        text = f"{found}; give one of {', '.join(_tags(field))}"
    else:
        is_quoted = kind in ("float_type", "int_type") and isinstance(value, str)
        found = "is missing" if kind == "missing" else f"is {'the text ' if is_quoted else ''}{shown(value)}"
        text = f"{found}; give {_wanted(root, path, field)}"
    return FieldProblem(path=path, message=f"{path_text(path) or what} {text}")


def parameter_problem(error: Mapping[str, Any]) -> FieldProblem:
    """Translate FastAPI's error of a parameter of a request, for which there is no model."""
    path = tuple(error["loc"][1:])
    return FieldProblem(path=path, message=f"{path_text(path)}: {error['msg']}")


def _wanted(root: type[WireModel], path: Path, field: FieldInfo | None) -> str:
    if not path:
        return 'a JSON object, e.g. {"measurements": [...]}' if root is ReportDocument else "a JSON object"
    if isinstance(path[-1], int):
        # The description is that of the array, where the path ends in one of its elements.
        return 'a JSON object, e.g. {"type": "aoa", "station_id": "bs1", ...}' if _tags(field) else "a JSON object"
    if field is None:
        return "a JSON object"
    # For an optional field the description sits inside its annotation.
    inner = (m.description for a in get_args(field.annotation) for m in getattr(a, "__metadata__", ()))
    description = field.description or next(inner, None)
    if description:
        return description
    literals = _literals(field.annotation)
    return f"one of {', '.join(literals)}" if literals else "a JSON object"


def _literals(annotation: Any) -> list[str]:
    return [v for a in get_args(annotation) for v in ([a] if isinstance(a, str) else _literals(a))]


def _look_up(
    root: type[WireModel], location: Sequence[str | int]
) -> tuple[Path, type[BaseModel] | None, FieldInfo | None]:
    """Find the path in the document, the model that it ends in, and its field there.

    Elements of arrays and maps are their field.
    """
    path: list[str | int] = []
    owner: type[BaseModel] | None = root
    field: FieldInfo | None = None
    inner: type[BaseModel] | None = root
    tags: Mapping[str, type[WireModel]] = {}
    for step in location:
        if isinstance(step, str) and step in tags:
            # pydantic puts the tag of a union into the location; the document has no such step.
            inner, tags = tags[step], {}
            continue
        path.append(step)
        if isinstance(step, int) or inner is None:
            continue
        owner = inner
        field = next((f for name, f in owner.model_fields.items() if (f.alias or name) == step), None)
        inner = next(iter(models_within(field.annotation)), None) if field else None
        tags = _tags(field)
    return tuple(path), owner, field


def _tags(field: FieldInfo | None) -> Mapping[str, type[WireModel]]:
    """Models by their tags, where a field holds a union that has them."""
    of_measurements = field is ReportDocument.model_fields["measurements"]
    return MEASUREMENT_DOCUMENTS if of_measurements else {}
