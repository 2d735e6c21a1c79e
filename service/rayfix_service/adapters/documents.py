"""Checking messages of other formats, with errors in the style of :mod:`rayfix_service.wire`."""

import difflib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from rayfix_service.wire import FieldProblem, InvalidReportError, WireModel, path_text, read_json
from rayfix_service.wire.documents import HeightDocument
from rayfix_service.wire.fields import MISFIT, Rfc3339, misfit
from rayfix_service.wire.limits import USUAL_LIMITS, MessageLimits, has_more_values
from rayfix_service.wire.problems import Path, invalid_report, shown

_SHORT = 64 << 10
"""Bytes of a message that is validated without a look at how many values it has."""

M = TypeVar("M", bound=WireModel)


def integer(high: int, what: str, *, low: int = 0) -> Any:
    """Field of an integer between `low` and `high`, both included."""
    return Field(ge=low, le=high, description=f"{what}, an integer from {low} to {high}")


def not_used(name: str) -> Any:
    """Field of a key that the format has and the conversion does not read; it may hold anything."""
    return Field(default=None, alias=name, description="anything; it is not read")


Stations = Annotated[
    dict[str, Annotated[str, Field(min_length=1, max_length=128)]] | None,
    Field(description='an object of station identifiers of the table by the names in the message, e.g. {"1": "bs1"}'),
]
"""Which station of the table a name of the message means; a name that is not in it is a station's identifier."""

TargetId = Annotated[
    str | None, Field(max_length=256, description="your name for the target, a text of at most 256 characters")
]

Timestamp = Annotated[
    Rfc3339 | None,
    Field(
        max_length=64,
        description='an RFC 3339 date-time such as "2026-01-31T10:00:00.250Z"',
        json_schema_extra={"format": "date-time"},
    ),
]

KnownHeight = Annotated[
    HeightDocument | None,
    Field(description='an object such as {"z_m": 1.2, "stdev_m": 0.1}: the known height of the target'),
]


def check(
    model: type[M],
    message: Mapping[str, Any] | bytes,
    *,
    what: str,
    limits: MessageLimits = USUAL_LIMITS,
    check_counts: Callable[[Mapping[str, Any]], None] | None = None,
    unwrap: Callable[[Mapping[str, Any]], Mapping[str, Any]] | None = None,
) -> M:
    """Validate a message; how much it holds is looked at first.

    Parameters
    ----------
    model : type of WireModel
        What the message must be like.
    message : Mapping or bytes
        The parsed message, or its JSON text.
    what : str
        What the message is called in errors about the whole of it.
    limits : MessageLimits, optional
    check_counts : callable, optional
        Raises InvalidReportError when a message, which need not be valid, has too much of something.
    unwrap : callable, optional
        Takes the message out of what it is sent in.

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON.
    InvalidReportError
        For a message that does not fit.
    """
    most = limits.message_values
    if isinstance(message, bytes) and len(message) > min(_SHORT, most) and has_more_values(message, most):
        raise too_much((), f"{what} has more than {most} values; leave out what is not read")
    data = read_json(message) if isinstance(message, bytes) else message
    if isinstance(data, Mapping):
        data = dict(unwrap(data) if unwrap is not None else data)
        stations = data.get("stations")
        if isinstance(stations, Mapping) and len(stations) > limits.stations:
            raise too_much(("stations",), f"stations has {len(stations)} names; give at most {limits.stations}")
        if check_counts is not None:
            check_counts(data)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        problem_of = partial(_problem, model, what)
        raise invalid_report(error, model, data, problem_of, limits.listed_problems) from None


def too_much(path: Path, text: str) -> InvalidReportError:
    """Make the error of a message that has too much of something."""
    return InvalidReportError((FieldProblem(path=path, message=text),))


def one_of(model: WireModel) -> tuple[str, Any]:
    """Return the alternative that a CHOICE of ASN.1 holds: its name and value.

    Raises
    ------
    PydanticCustomError
        When the model holds none or several.
    """
    fields = type(model).model_fields
    given = [
        (field.alias or name, getattr(model, name)) for name, field in fields.items() if name in model.model_fields_set
    ]
    if len(given) == 1 and given[0][1] is not None:
        return given[0]
    found = " and ".join(name for name, _ in given) or "nothing"
    names = ", ".join(field.alias or name for name, field in fields.items())
    raise misfit(None, f"holds {found}; give exactly one of {names}")


def _problem(root: type[WireModel], what: str, error: ErrorDetails) -> FieldProblem:
    path, kind, value = error["loc"], error["type"], error["input"]
    owner, field = _look_up(root, path)
    if kind == MISFIT:
        context = error["ctx"]
        path = path if context["field"] is None else (*path, context["field"])
        text = context["text"]
    elif kind in ("extra_forbidden", "invalid_key"):
        known = [f.alias or name for name, f in owner.model_fields.items()] if owner else []
        close = difflib.get_close_matches(str(path[-1])[:60], known, n=1, cutoff=0.7)
        remedy = f"did you mean {close[0]}?" if close else f"leave it out or use one of {', '.join(known)}"
        text = f"is an unknown key; {remedy}"
    else:
        found = "is missing" if kind == "missing" else f"is {shown(value)}"
        # The description is that of the array, where the path ends in one of its elements.
        text = f"{found}; give {'a JSON object' if path and isinstance(path[-1], int) else _wanted(field)}"
    return FieldProblem(path=path, message=f"{path_text(path) or what} {text}")


def _wanted(field: FieldInfo | None) -> str:
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


def _look_up(root: type[WireModel], path: Path) -> tuple[type[BaseModel] | None, FieldInfo | None]:
    """Find the model that a path ends in, and its field there; elements of arrays and maps are their field."""
    owner: type[BaseModel] | None = root
    field: FieldInfo | None = None
    inner: type[BaseModel] | None = root
    for step in path:
        if isinstance(step, int) or inner is None:
            continue
        owner = inner
        field = next((f for name, f in owner.model_fields.items() if (f.alias or name) == step), None)
        inner = _model_within(field.annotation) if field else None
    return owner, field


def _model_within(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for a in get_args(annotation) if (model := _model_within(a))), None)
