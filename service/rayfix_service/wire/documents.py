"""The request documents: what a report looks like as JSON.

The description of each field says what the field takes and how to get there; it serves the OpenAPI document
and the error messages alike.
"""

import math
import re
from datetime import date
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from rayfix_service.fusion.report import Angle, Frame, Range, TimeDifference, TimeOfArrival
from rayfix_tables.angles import wrap

METRES_PER_NANOSECOND = 0.299792458
"""Speed of light, exact by the definition of the metre."""

MAX_MEASUREMENTS = 256
"""Measurements that one report may have."""

MAX_REPORTS = 1000
"""Reports that one batch may have."""

MISFIT = "rayfix_misfit"
"""Type of the validation error for fields that are fine each but do not fit together."""


def _rfc3339(text: str) -> str:
    """Return `text` as it is, if it is an RFC 3339 date-time."""
    # datetime.fromisoformat takes more (2026-W05) and less (leap seconds) than RFC 3339.
    match = re.fullmatch(
        r"([0-9]{4})-([0-9]{2})-([0-9]{2})[Tt ]([0-9]{2}):([0-9]{2}):([0-9]{2})(?:\.[0-9]+)?"
        r"(?:[Zz]|[+-]([0-9]{2}):([0-9]{2}))",
        text,
    )
    if match is None:
        raise ValueError("not of the form of RFC 3339")
    year, month, day, hour, minute, second, offset_hour, offset_minute = (int(g or 0) for g in match.groups())
    date(year, month, day)
    if hour > 23 or minute > 59 or second > 60 or offset_hour > 23 or offset_minute > 59:
        raise ValueError("no such time of day")
    return text


Rfc3339 = Annotated[str, AfterValidator(_rfc3339)]
"""A date-time of RFC 3339, kept as the text it is."""


def _number(low: float, high: float, what: str, hint: str = "") -> Any:
    """Field of a number between `low` and `high`, both included."""
    return Field(ge=low, le=high, description=f"{what}, {low:g} to {high:g}" + (hint and f" ({hint})"))


# Below 1e-6, squares and inverses leave what float64 resolves; no instrument comes near.
_StdevDeg = Annotated[float, _number(1e-6, 360, "a positive standard deviation in degrees")]
_StdevM = Annotated[float, _number(1e-6, 1e6, "a positive standard deviation in metres")]
_StdevNs = Annotated[float, _number(1e-6, 1e6, "a positive standard deviation in nanoseconds")]

# A short range may be measured as a negative one; to refuse that would cut the noise off on one side.
_RangeM = Annotated[float, _number(-1e6, 1e6, "a path length in metres")]
_DelayNs = Annotated[float, _number(-1e6, 1e6, "a propagation time in nanoseconds")]

# float64 still resolves 0.1 mm at 1e12 m, which is an hour of light; clocks that count from 1970 are beyond.
_EPOCH = "subtract a common epoch from all times of arrival of the report"
_ArrivalM = Annotated[float, _number(-1e12, 1e12, "a time of arrival times the speed of light, in metres", _EPOCH)]
_ArrivalNs = Annotated[float, _number(-1e12, 1e12, "a time of arrival in nanoseconds", _EPOCH)]

_DifferenceM = Annotated[float, _number(-1e6, 1e6, "a difference of path lengths in metres")]
_DifferenceNs = Annotated[float, _number(-1e6, 1e6, "a difference of arrival times in nanoseconds")]

_StationId = Annotated[
    str,
    Field(
        min_length=1,
        max_length=128,
        description="the identifier of a station of the table, 1 to 128 characters",
    ),
]


class WireModel(BaseModel):
    """Base of the documents: unknown keys, numbers as text, NaN and infinity are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class AngleDocument(WireModel):
    """An angle of arrival: the direction from the station towards the incoming ray."""

    model_config = ConfigDict(
        title="AngleOfArrival",
        json_schema_extra={
            "dependentRequired": {"zenith_deg": ["zenith_stdev_deg"], "zenith_stdev_deg": ["zenith_deg"]}
        },
    )

    type: Literal["aoa"]
    station_id: _StationId
    azimuth_deg: Annotated[
        float,
        _number(
            -180,
            360,
            "an azimuth in degrees, counter-clockwise from the frame's +x axis",
            "take whole turns of 360 off",
        ),
    ]
    azimuth_stdev_deg: _StdevDeg
    zenith_deg: (
        Annotated[float, _number(0, 180, "a zenith angle in degrees, that is 90 minus the elevation")] | None
    ) = None
    zenith_stdev_deg: _StdevDeg | None = None
    frame: Frame = Field(default="scene", description='one of "scene", "lcs" (local to the station) and "north"')

    @model_validator(mode="after")
    def _zenith_whole(self) -> Self:
        if (self.zenith_deg is None) != (self.zenith_stdev_deg is None):
            missing, given = "zenith_stdev_deg", "zenith_deg"
            if self.zenith_deg is None:
                missing, given = given, missing
            raise _misfit(missing, f"is missing although {given} is there; give both or neither")
        return self

    def measurement(self) -> Angle:
        """Convert to radians, the azimuth in (-pi, pi]."""
        zenith, zenith_stdev = self.zenith_deg, self.zenith_stdev_deg
        return Angle(
            station_id=self.station_id,
            azimuth=float(wrap(math.radians(self.azimuth_deg))),
            azimuth_stdev=math.radians(self.azimuth_stdev_deg),
            zenith=None if zenith is None else math.radians(zenith),
            zenith_stdev=None if zenith_stdev is None else math.radians(zenith_stdev),
            frame=self.frame,
        )


def _two_forms(metres: str, nanoseconds: str) -> dict[str, Any]:
    """JSON schema of "either these two keys or those two"."""
    return {"oneOf": [{"required": [metres, "stdev_m"]}, {"required": [nanoseconds, "stdev_ns"]}]}


class RangeDocument(WireModel):
    """A propagation time, as a path length in metres or a delay in nanoseconds."""

    model_config = ConfigDict(title="PropagationTime", json_schema_extra=_two_forms("range_m", "delay_ns"))

    type: Literal["pt"]
    station_id: _StationId
    range_m: _RangeM | None = None
    stdev_m: _StdevM | None = None
    delay_ns: _DelayNs | None = None
    stdev_ns: _StdevNs | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        _length(self, "range_m", "delay_ns")
        return self

    def measurement(self) -> Range:
        """Convert to metres."""
        length, stdev = _length(self, "range_m", "delay_ns")
        return Range(station_id=self.station_id, path_length=length, stdev=stdev)


class TimeOfArrivalDocument(WireModel):
    """A time of arrival, with an unknown clock offset that all of a report's times of arrival share."""

    model_config = ConfigDict(title="TimeOfArrival", json_schema_extra=_two_forms("range_m", "delay_ns"))

    type: Literal["toa"]
    station_id: _StationId
    range_m: _ArrivalM | None = None
    stdev_m: _StdevM | None = None
    delay_ns: _ArrivalNs | None = None
    stdev_ns: _StdevNs | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        _length(self, "range_m", "delay_ns")
        return self

    def measurement(self) -> TimeOfArrival:
        """Convert to metres."""
        length, stdev = _length(self, "range_m", "delay_ns")
        return TimeOfArrival(station_id=self.station_id, path_length=length, stdev=stdev)


class TimeDifferenceDocument(WireModel):
    """A time difference of arrival, t(station) - t(reference station)."""

    model_config = ConfigDict(
        title="TimeDifferenceOfArrival",
        json_schema_extra=_two_forms("range_difference_m", "delay_difference_ns"),
    )

    type: Literal["tdoa"]
    station_id: _StationId
    reference_station_id: _StationId
    range_difference_m: _DifferenceM | None = None
    stdev_m: _StdevM | None = None
    delay_difference_ns: _DifferenceNs | None = None
    stdev_ns: _StdevNs | None = None

    @model_validator(mode="after")
    def _two_stations_one_form(self) -> Self:
        if self.station_id == self.reference_station_id:
            raise _misfit(
                "reference_station_id",
                f"is {self.reference_station_id!r}, the station itself; name the other one of the difference",
            )
        _length(self, "range_difference_m", "delay_difference_ns")
        return self

    def measurement(self) -> TimeDifference:
        """Convert to metres."""
        length, stdev = _length(self, "range_difference_m", "delay_difference_ns")
        return TimeDifference(
            station_id=self.station_id,
            reference_station_id=self.reference_station_id,
            length_difference=length,
            stdev=stdev,
        )


MEASUREMENT_DOCUMENTS: dict[str, type[WireModel]] = {
    "aoa": AngleDocument,
    "pt": RangeDocument,
    "toa": TimeOfArrivalDocument,
    "tdoa": TimeDifferenceDocument,
}
"""Model of each value that ``type`` takes."""

MeasurementDocument = Annotated[
    AngleDocument | RangeDocument | TimeOfArrivalDocument | TimeDifferenceDocument,
    Field(discriminator="type"),
]


class ReportDocument(WireModel):
    """The measurements of one transmission."""

    model_config = ConfigDict(title="Report")

    target_id: str | None = Field(
        default=None,
        max_length=256,
        description="your name for the target, a text of at most 256 characters, sent back as it is",
    )
    timestamp: Annotated[str, AfterValidator(_rfc3339)] | None = Field(
        default=None,
        max_length=64,
        description='an RFC 3339 date-time such as "2026-01-31T10:00:00.250Z", sent back as it is',
        json_schema_extra={"format": "date-time"},
    )
    measurements: list[MeasurementDocument] = Field(
        strict=False,  # a tuple is as good, where the document comes from Python
        min_length=1,
        max_length=MAX_MEASUREMENTS,
        description=f"an array of 1 to {MAX_MEASUREMENTS} measurements",
    )


class BatchDocument(WireModel):
    """Many reports, answered in their order.

    This is for the OpenAPI document: a batch is never validated as a whole, since one bad report must not
    cost the others their fix.
    """

    model_config = ConfigDict(title="Batch")

    reports: list[ReportDocument] = Field(
        max_length=MAX_REPORTS, description=f"an array of at most {MAX_REPORTS} reports"
    )


def _length(document: WireModel, metres: str, nanoseconds: str) -> tuple[float, float]:
    """Length and its standard deviation, m, of a document that has them in exactly one of two units."""
    values = {name: getattr(document, name) for name in (metres, "stdev_m", nanoseconds, "stdev_ns")}
    given = [name for name, value in values.items() if value is not None]
    if given == [metres, "stdev_m"]:
        return values[metres], values["stdev_m"]
    if given == [nanoseconds, "stdev_ns"]:
        return values[nanoseconds] * METRES_PER_NANOSECOND, values["stdev_ns"] * METRES_PER_NANOSECOND
    found = ", ".join(given) or "neither length nor delay"
    raise _misfit(None, f"has {found}; give either {metres} with stdev_m or {nanoseconds} with stdev_ns, not both")


def _misfit(field: str | None, text: str) -> PydanticCustomError:
    """Error of fields that do not fit together; `field` is the one to point at, if any."""
    return PydanticCustomError(MISFIT, "{text}", {"text": text, "field": field})
