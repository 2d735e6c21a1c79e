"""Checking messages of other formats, with errors in the style of :mod:`rayfix_service.wire`."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar

from pydantic import Field, ValidationError

from rayfix_service.wire import FieldProblem, InvalidReportError, WireModel, read_json
from rayfix_service.wire.documents import HeightDocument
from rayfix_service.wire.fields import Rfc3339, misfit
from rayfix_service.wire.limits import USUAL_LIMITS, MessageLimits, has_more_values
from rayfix_service.wire.problems import invalid_report
from rayfix_tables.validation.problems import Path

_SHORT = 64 << 10
"""Bytes of a message up to which its values are not counted before the validation."""

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
"""Stations of the table by the names in the message; a name that is not in the map is itself a station's identifier."""

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
    """Validate a message, after a check of its size.

    Parameters
    ----------
    model : type of WireModel
        The model that the message must match.
    message : Mapping or bytes
        The parsed message, or its JSON text.
    what : str
        Name of the message in errors that concern all of it.
    limits : MessageLimits, optional
    check_counts : callable, optional
        Raises InvalidReportError when a message has too many elements. The message may be invalid.
    unwrap : callable, optional
        Extracts the message from its envelope.

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON.
    InvalidReportError
        For a message that does not match the model.
    """
    most = limits.message_values
    if isinstance(message, bytes) and len(message) > min(_SHORT, most) and has_more_values(message, most):
        raise too_much((), f"{what} has more than {most} values; leave out what is not read")
    data = read_json(message) if isinstance(message, bytes) else message
    if isinstance(data, Mapping):
        if isinstance(data.get("measurements"), list) and "measurements" not in model.model_fields:
            text = "this is a report in rayfix's own format; leave out the format, or post it to /v1/positions"
            raise InvalidReportError((FieldProblem(path=("measurements",), message=text),))
        data = dict(unwrap(data) if unwrap is not None else data)
        stations = data.get("stations")
        if isinstance(stations, Mapping) and len(stations) > limits.stations:
            raise too_much(("stations",), f"stations has {len(stations)} names; give at most {limits.stations}")
        if check_counts is not None:
            check_counts(data)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise invalid_report(error, model, data, what, limits.listed_problems) from None


def too_much(path: Path, text: str) -> InvalidReportError:
    """Make the error of a message that exceeds a limit."""
    return InvalidReportError((FieldProblem(path=path, message=text),))


def one_of(model: WireModel) -> tuple[str, Any]:
    """Return the alternative that a CHOICE of ASN.1 holds: its name and value.

    Raises
    ------
    PydanticCustomError
        When the model has no alternative, or several.
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
