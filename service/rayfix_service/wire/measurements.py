"""The measurement documents: every kind of measurement as JSON, and its way to the fusion."""

import math
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    HEAVY_TAILED,
    Angle,
    ErrorModel,
    Frame,
    LogRange,
    Range,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.measuring.ranging import range_from_rssi
from rayfix_service.wire.fields import (
    METRES_PER_NANOSECOND,
    ArrivalM,
    ArrivalNs,
    AzimuthDeg,
    Correlation,
    DelayNs,
    DepartureNs,
    DifferenceM,
    DifferenceNs,
    LosProbability,
    PathLossExponent,
    PowerDbm,
    RangeM,
    ReplyNs,
    RoundTripNs,
    StationId,
    StdevDb,
    StdevDeg,
    StdevM,
    StdevNs,
    TailScale,
    TailShare,
    WireModel,
    ZenithDeg,
    misfit,
)
from rayfix_service.wire.paths import PathDocument
from rayfix_tables.geometry.angles import wrap_one


class _WithErrorModel(WireModel):
    """Measurement of which the error may have heavy tails."""

    error_model: Literal["gaussian", "heavy_tailed"] = Field(
        default="gaussian", description='one of "gaussian" and "heavy_tailed" (now and then an error is much larger)'
    )
    tail_share: TailShare | None = None
    tail_scale: TailScale | None = None

    @model_validator(mode="after")
    def _tails_of_heavy_tails(self) -> Self:
        if self.error_model == "gaussian":
            for name in ("tail_share", "tail_scale"):
                if getattr(self, name) is not None:
                    raise misfit(name, 'is of a heavy-tailed error; give "error_model": "heavy_tailed" or leave it out')
        return self

    def _error_model(self) -> ErrorModel:
        if self.error_model == "gaussian":
            return GAUSSIAN
        return ErrorModel(
            tail_share=HEAVY_TAILED.tail_share if self.tail_share is None else self.tail_share,
            tail_scale=HEAVY_TAILED.tail_scale if self.tail_scale is None else self.tail_scale,
        )


class _OfOnePath(_WithErrorModel):
    """Measurement that may carry a line-of-sight indication."""

    los_probability: LosProbability | None = None


class AngleDocument(_OfOnePath):
    """An angle of arrival: the direction from the station towards the incoming ray."""

    model_config = ConfigDict(
        title="AngleOfArrival",
        json_schema_extra={
            "dependentRequired": {
                "zenith_deg": ["zenith_stdev_deg"],
                "zenith_stdev_deg": ["zenith_deg"],
                "correlation": ["zenith_deg"],
            }
        },
    )

    type: Literal["aoa"]
    station_id: StationId
    azimuth_deg: AzimuthDeg
    azimuth_stdev_deg: StdevDeg
    zenith_deg: ZenithDeg | None = None
    zenith_stdev_deg: StdevDeg | None = None
    correlation: Correlation | None = None
    frame: Frame = Field(default="scene", description='one of "scene", "lcs" (local to the station) and "north"')

    @model_validator(mode="after")
    def _zenith_whole(self) -> Self:
        if (self.zenith_deg is None) != (self.zenith_stdev_deg is None):
            missing, given = "zenith_stdev_deg", "zenith_deg"
            if self.zenith_deg is None:
                missing, given = given, missing
            raise misfit(missing, f"is missing although {given} is there; give both or neither")
        if self.correlation is not None and self.zenith_deg is None:
            raise misfit("zenith_deg", "is missing although correlation is there; give both or neither")
        return self

    def measurement(self) -> Angle:
        """Convert to radians, the azimuth in (-pi, pi]."""
        zenith, zenith_stdev = self.zenith_deg, self.zenith_stdev_deg
        return Angle(
            station_id=self.station_id,
            azimuth=wrap_one(math.radians(self.azimuth_deg)),
            azimuth_stdev=math.radians(self.azimuth_stdev_deg),
            zenith=None if zenith is None else math.radians(zenith),
            zenith_stdev=None if zenith_stdev is None else math.radians(zenith_stdev),
            correlation=self.correlation or 0.0,
            frame=self.frame,
            error_model=self._error_model(),
            los_probability=self.los_probability,
        )


_Form = tuple[str, ...]
"""Keys of one form of a measurement, the standard deviation last, in the order of the document's fields."""


class _Forms:
    """The forms of a measurement."""

    def __init__(self, *forms: _Form) -> None:
        self._forms = frozenset(forms)
        self._keys = tuple(dict.fromkeys(key for form in forms for key in form if not key.startswith("stdev")))
        self._keys += tuple(dict.fromkeys(form[-1] for form in forms))
        self._ways = " or ".join(f"{', '.join(form[:-1])} with {form[-1]}" for form in forms)
        self.schema: dict[str, Any] = {"oneOf": [{"required": list(form)} for form in forms]}

    def values(self, document: WireModel) -> tuple[_Form, list[float]]:
        """Form that a document has, and its values."""
        fields = vars(document)
        form = tuple([key for key in self._keys if fields[key] is not None])
        if form in self._forms:
            return form, [fields[key] for key in form]
        found = ", ".join(key for key in fields if key in form) or "neither length nor time"
        raise misfit(None, f"has {found}; give either {self._ways}, not both")


_RANGE_FORMS = _Forms(
    ("range_m", "stdev_m"),
    ("delay_ns", "stdev_ns"),
    ("toa_ns", "tod_ns", "stdev_ns"),
    ("round_trip_ns", "reply_ns", "stdev_ns"),
)
_ARRIVAL_FORMS = _Forms(("range_m", "stdev_m"), ("delay_ns", "stdev_ns"))
_DIFFERENCE_FORMS = _Forms(("range_difference_m", "stdev_m"), ("delay_difference_ns", "stdev_ns"))


def _length(document: WireModel, forms: _Forms) -> tuple[float, float]:
    """Length and its standard deviation, m."""
    form, values = forms.values(document)
    stdev = values.pop() * (1.0 if form[-1] == "stdev_m" else METRES_PER_NANOSECOND)
    if form[-1] == "stdev_m":
        return values[0], stdev
    if form[0] == "round_trip_ns":
        return 0.5 * METRES_PER_NANOSECOND * (values[0] - values[1]), 0.5 * stdev
    return METRES_PER_NANOSECOND * (values[0] - (values[1] if len(values) > 1 else 0.0)), stdev


class RangeDocument(_OfOnePath):
    """A propagation time: a path length, a delay, arrival and departure, or a round trip and the time of the reply."""

    model_config = ConfigDict(title="PropagationTime", json_schema_extra=_RANGE_FORMS.schema)

    type: Literal["pt"]
    station_id: StationId
    range_m: RangeM | None = None
    stdev_m: StdevM | None = None
    delay_ns: DelayNs | None = None
    toa_ns: ArrivalNs | None = None
    tod_ns: DepartureNs | None = None
    round_trip_ns: RoundTripNs | None = None
    reply_ns: ReplyNs | None = None
    stdev_ns: StdevNs | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        length, _ = _length(self, _RANGE_FORMS)
        if abs(length) > _LONGEST:
            raise misfit(None, f"is of a path of {length:.3g} m; give times of one clock, in nanoseconds")
        return self

    def measurement(self) -> Range:
        """Convert to metres."""
        length, stdev = _length(self, _RANGE_FORMS)
        return Range(
            station_id=self.station_id,
            path_length=length,
            stdev=stdev,
            error_model=self._error_model(),
            los_probability=self.los_probability,
        )


_LONGEST = 1e6
"""No difference of times is of a longer path, m."""


class TimeOfArrivalDocument(_OfOnePath):
    """A time of arrival, with an unknown clock offset that is common to all times of arrival of a report."""

    model_config = ConfigDict(title="TimeOfArrival", json_schema_extra=_ARRIVAL_FORMS.schema)

    type: Literal["toa"]
    station_id: StationId
    range_m: ArrivalM | None = None
    stdev_m: StdevM | None = None
    delay_ns: ArrivalNs | None = None
    stdev_ns: StdevNs | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        _ARRIVAL_FORMS.values(self)
        return self

    def measurement(self) -> TimeOfArrival:
        """Convert to metres."""
        length, stdev = _length(self, _ARRIVAL_FORMS)
        return TimeOfArrival(
            station_id=self.station_id,
            path_length=length,
            stdev=stdev,
            error_model=self._error_model(),
            los_probability=self.los_probability,
        )


class TimeDifferenceDocument(_WithErrorModel):
    """A time difference of arrival, t(station) - t(reference station)."""

    model_config = ConfigDict(title="TimeDifferenceOfArrival", json_schema_extra=_DIFFERENCE_FORMS.schema)

    type: Literal["tdoa"]
    station_id: StationId
    reference_station_id: StationId
    range_difference_m: DifferenceM | None = None
    stdev_m: StdevM | None = None
    delay_difference_ns: DifferenceNs | None = None
    stdev_ns: StdevNs | None = None

    @model_validator(mode="after")
    def _two_stations_one_form(self) -> Self:
        if self.station_id == self.reference_station_id:
            raise misfit(
                "reference_station_id",
                f"is {self.reference_station_id!r}, the station itself; name the other one of the difference",
            )
        _DIFFERENCE_FORMS.values(self)
        return self

    def measurement(self) -> TimeDifference:
        """Convert to metres."""
        length, stdev = _length(self, _DIFFERENCE_FORMS)
        return TimeDifference(
            station_id=self.station_id,
            reference_station_id=self.reference_station_id,
            length_difference=length,
            stdev=stdev,
            error_model=self._error_model(),
        )


class SignalStrengthDocument(WireModel):
    """A received signal strength with its path-loss model: power at 1 m, exponent, shadowing."""

    model_config = ConfigDict(title="SignalStrength")

    type: Literal["rssi"]
    station_id: StationId
    rssi_dbm: PowerDbm
    power_at_1m_dbm: PowerDbm
    path_loss_exponent: PathLossExponent
    shadowing_stdev_db: StdevDb

    @model_validator(mode="after")
    def _near_enough(self) -> Self:
        length, log_stdev = self._range()
        if not _SHORTEST * (1.0 - _DIGITS) <= length <= _LONGEST * (1.0 + _DIGITS):
            raise misfit(
                "rssi_dbm", f"is of a path of {length:.3g} m by this model; check power_at_1m_dbm and exponent"
            )
        if log_stdev > _WIDEST_LOG * (1.0 + _DIGITS):
            raise misfit(
                "shadowing_stdev_db", "leaves the distance open; give at most 6.5 dB for each unit of exponent"
            )
        return self

    def _range(self) -> tuple[float, float]:
        found = range_from_rssi(
            rssi_dbm=self.rssi_dbm,
            power_at_1m_dbm=self.power_at_1m_dbm,
            path_loss_exponent=self.path_loss_exponent,
            shadowing_stdev_db=self.shadowing_stdev_db,
        )
        return found.path_length, found.log_stdev

    def measurement(self) -> LogRange:
        """Convert to a path length and the standard deviation of its logarithm."""
        length, log_stdev = self._range()
        return LogRange(
            station_id=self.station_id,
            path_length=min(max(length, _SHORTEST), _LONGEST),
            log_stdev=min(log_stdev, _WIDEST_LOG),
        )


_SHORTEST = 1e-3
"""Shortest path that a signal strength may be of, m."""

_DIGITS = 1e-9
"""Fraction of a limit by which rounding may exceed it, where a model's numbers are made of a length at the limit."""

_WIDEST_LOG = 1.5
"""Largest standard deviation of a distance's logarithm that the fusion takes: a factor of 4.5."""

MEASUREMENT_DOCUMENTS: dict[str, type[WireModel]] = {
    "aoa": AngleDocument,
    "pt": RangeDocument,
    "toa": TimeOfArrivalDocument,
    "tdoa": TimeDifferenceDocument,
    "rssi": SignalStrengthDocument,
    "path": PathDocument,
}
"""Model of each value that ``type`` takes."""

MeasurementDocument = Annotated[
    AngleDocument
    | RangeDocument
    | TimeOfArrivalDocument
    | TimeDifferenceDocument
    | SignalStrengthDocument
    | PathDocument,
    Field(discriminator="type"),
]
