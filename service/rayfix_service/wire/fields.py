"""Types of the fields of the request documents.

The description of each field gives its range, and how to convert to it; it serves the OpenAPI document
and the error messages alike.
"""

import re
from datetime import date
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

METRES_PER_NANOSECOND = 0.299792458
"""Speed of light, exact by the definition of the metre."""

MISFIT = "rayfix_misfit"
"""Type of the validation error for fields that are fine each but do not fit together."""


class WireModel(BaseModel):
    """Base of the documents: unknown keys, numbers as text, NaN and infinity are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


def misfit(field: str | None, text: str) -> PydanticCustomError:
    """Error of fields that do not fit together; `field` is the one to point at, if any."""
    return PydanticCustomError(MISFIT, "{text}", {"text": text, "field": field})


def _number(low: float, high: float, what: str, hint: str = "") -> Any:
    """Field of a number between `low` and `high`, both included."""
    return Field(ge=low, le=high, description=f"{what}, {low:g} to {high:g}" + (hint and f" ({hint})"))


# datetime.fromisoformat takes more (2026-W05) and less (leap seconds) than RFC 3339.
_DATE_TIME = re.compile(
    r"[0-9]{4}-[0-9]{2}-[0-9]{2}[Tt ](?:[01][0-9]|2[0-3]):[0-5][0-9]:(?:[0-5][0-9]|60)(?:\.[0-9]+)?"
    r"(?:[Zz]|[+-](?:[01][0-9]|2[0-3]):[0-5][0-9])"
)


def _rfc3339(text: str) -> str:
    """Return `text` as it is, if it is an RFC 3339 date-time."""
    if _DATE_TIME.fullmatch(text) is None:
        raise ValueError("not of the form of RFC 3339")
    date.fromisoformat(text[:10])  # refuses the days that a month has not
    return text


Rfc3339 = Annotated[str, AfterValidator(_rfc3339)]
"""A date-time of RFC 3339, kept as the text it is."""

StationId = Annotated[
    str,
    Field(
        min_length=1,
        max_length=128,
        description="the identifier of a station of the table, 1 to 128 characters",
    ),
]

AzimuthDeg = Annotated[
    float,
    _number(
        -180,
        360,
        "an azimuth in degrees, counter-clockwise from the frame's +x axis",
        "take whole turns of 360 off",
    ),
]
ZenithDeg = Annotated[float, _number(0, 180, "a zenith angle in degrees, that is 90 minus the elevation")]
Correlation = Annotated[float, _number(-0.999, 0.999, "the correlation of the errors of azimuth and zenith")]

# Below 1e-6, squares and inverses leave what float64 resolves; no instrument comes near.
StdevDeg = Annotated[float, _number(1e-6, 360, "a positive standard deviation in degrees")]
StdevM = Annotated[float, _number(1e-6, 1e6, "a positive standard deviation in metres")]
StdevNs = Annotated[float, _number(1e-6, 1e6, "a positive standard deviation in nanoseconds")]
StdevDb = Annotated[float, _number(0.1, 15, "a positive standard deviation in decibels")]

# A short range may be measured as a negative one; to refuse that would cut the noise off on one side.
RangeM = Annotated[float, _number(-1e6, 1e6, "a path length in metres")]
DelayNs = Annotated[float, _number(-1e6, 1e6, "a propagation time in nanoseconds")]
RoundTripNs = Annotated[
    float, _number(-1e12, 1e12, "the time from sending a signal to receiving its reply, in nanoseconds")
]
ReplyNs = Annotated[float, _number(0, 1e12, "the time that the other side took to reply, in nanoseconds")]

# float64 still resolves 0.1 mm at 1e12 m, which is an hour of light; clocks that count from 1970 are beyond.
_EPOCH = "subtract a common epoch from all times of the report"
ArrivalM = Annotated[float, _number(-1e12, 1e12, "a time of arrival times the speed of light, in metres", _EPOCH)]
ArrivalNs = Annotated[float, _number(-1e12, 1e12, "a time of arrival in nanoseconds", _EPOCH)]
DepartureNs = Annotated[float, _number(-1e12, 1e12, "a time of departure in nanoseconds", _EPOCH)]

DifferenceM = Annotated[float, _number(-1e6, 1e6, "a difference of path lengths in metres")]
DifferenceNs = Annotated[float, _number(-1e6, 1e6, "a difference of arrival times in nanoseconds")]

PowerDbm = Annotated[float, _number(-200, 100, "a power in dBm")]
PathLossExponent = Annotated[float, _number(0.5, 10, "a path-loss exponent")]

# Finer than a millimetre, the squares of a height in a large frame leave what float64 resolves.
HeightM = Annotated[float, _number(-1e4, 1e4, "a height in metres, z in the scene frame")]
HeightStdevM = Annotated[float, _number(1e-3, 1e4, "a positive standard deviation in metres")]

# Of some thousand points that stand for a posterior, ten are beyond 99 %.
Confidence = Annotated[
    float, _number(0.01, 0.99, "the probability with which the accuracies of the answer are to hold")
]

LosProbability = Annotated[
    float, _number(0, 1, "the probability that the path is direct, in the receiver's judgement of the signal's shape")
]

PowerDb = Annotated[float, _number(-300, 300, "a power in decibels, relative to anything common to the paths")]

SelectionExponent = Annotated[float, _number(0, 20, "how much the strong paths are preferred")]
WithinDb = Annotated[
    float, _number(0.1, 100, "how much weaker than all paths together an audible one may be, in decibels")
]

TailShare = Annotated[float, _number(1e-3, 0.5, "the fraction of errors that are of the wide part")]
TailScale = Annotated[float, _number(1.5, 20, "how many times wider the wide part is")]
