"""The document of a measured path: one of several that a station reports."""

import math
from typing import Literal, Self

from pydantic import ConfigDict, Field, model_validator

from rayfix_service.fusion.measurements.report import Frame, MeasuredPath, PathClock
from rayfix_service.wire.fields import (
    METRES_PER_NANOSECOND,
    ArrivalM,
    AzimuthDeg,
    DelayNs,
    PowerDb,
    RangeM,
    StationId,
    StdevDeg,
    StdevM,
    StdevNs,
    WireModel,
    ZenithDeg,
    misfit,
)
from rayfix_tables.geometry.angles import wrap_one

_LENGTHS: dict[str, tuple[PathClock, str, float]] = {
    "range_m": ("known", "stdev_m", 1.0),
    "toa_m": ("ue", "stdev_m", 1.0),
    "delay_ns": ("station", "stdev_ns", METRES_PER_NANOSECOND),
}
"""Clock, deviation and unit of each way to give a length."""

_PAIRS = (("azimuth_deg", "azimuth_stdev_deg"), ("zenith_deg", "zenith_stdev_deg"))


class PathDocument(WireModel):
    """One of several paths that a station reports: its direction, its length, or both."""

    model_config = ConfigDict(
        title="MeasuredPath",
        json_schema_extra={
            "dependentRequired": {
                "azimuth_deg": ["azimuth_stdev_deg"],
                "azimuth_stdev_deg": ["azimuth_deg"],
                "zenith_deg": ["zenith_stdev_deg", "azimuth_deg"],
                "zenith_stdev_deg": ["zenith_deg"],
                "range_m": ["stdev_m"],
                "toa_m": ["stdev_m"],
                "delay_ns": ["stdev_ns"],
            }
        },
    )

    type: Literal["path"]
    station_id: StationId
    azimuth_deg: AzimuthDeg | None = None
    azimuth_stdev_deg: StdevDeg | None = None
    zenith_deg: ZenithDeg | None = None
    zenith_stdev_deg: StdevDeg | None = None
    frame: Frame = Field(default="scene", description='one of "scene", "lcs" (local to the station) and "north"')
    range_m: RangeM | None = None
    toa_m: ArrivalM | None = None
    stdev_m: StdevM | None = None
    delay_ns: DelayNs | None = None
    stdev_ns: StdevNs | None = None
    power_db: PowerDb | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        for name, stdev in _PAIRS:
            if (getattr(self, name) is None) != (getattr(self, stdev) is None):
                missing, given = (name, stdev) if getattr(self, name) is None else (stdev, name)
                raise misfit(missing, f"is missing although {given} is there; give both or neither")
        if self.zenith_deg is not None and self.azimuth_deg is None:
            raise misfit("azimuth_deg", "is missing although zenith_deg is there; give both or neither")
        lengths = [name for name in _LENGTHS if getattr(self, name) is not None]
        if len(lengths) > 1:
            raise misfit(lengths[1], f"is there beside {lengths[0]}; give one of range_m, toa_m and delay_ns")
        if not lengths and self.azimuth_deg is None:
            raise misfit(None, "has neither angles nor length; give azimuth_deg, or one of range_m, toa_m and delay_ns")
        wanted = _LENGTHS[lengths[0]][1] if lengths else None
        for stdev in ("stdev_m", "stdev_ns"):
            if (getattr(self, stdev) is None) != (stdev != wanted):
                of = lengths[0] if lengths else "a length, which is not there"
                raise misfit(
                    stdev, f"is missing although it is of {of}" if stdev == wanted else f"does not go with {of}"
                )
        return self

    def measurement(self) -> MeasuredPath:
        """Convert to radians and metres, the azimuth in (-pi, pi]."""
        clock: PathClock = "known"
        length = stdev = None
        for name, (of, deviation, unit) in _LENGTHS.items():
            value = getattr(self, name)
            if value is not None:
                clock, length, stdev = of, unit * value, unit * getattr(self, deviation)
        return MeasuredPath(
            station_id=self.station_id,
            azimuth=None if self.azimuth_deg is None else wrap_one(math.radians(self.azimuth_deg)),
            azimuth_stdev=_radians(self.azimuth_stdev_deg),
            zenith=_radians(self.zenith_deg),
            zenith_stdev=_radians(self.zenith_stdev_deg),
            frame=self.frame,
            length=length,
            stdev=stdev,
            clock=clock,
            power_db=self.power_db,
        )


def path_to_document(measured: MeasuredPath) -> dict[str, object]:
    """Write a measured path; azimuths as they are within one turn."""
    document: dict[str, object] = {"type": "path", "station_id": measured.station_id}
    for name in ("azimuth", "azimuth_stdev", "zenith", "zenith_stdev"):
        value = getattr(measured, name)
        if value is not None:
            document[f"{name}_deg"] = math.degrees(value)
    if measured.frame != "scene":
        document["frame"] = measured.frame
    for name, (clock, deviation, unit) in _LENGTHS.items():
        if measured.clock == clock and measured.length is not None and measured.stdev is not None:
            document |= {name: measured.length / unit, deviation: measured.stdev / unit}
    if measured.power_db is not None:
        document["power_db"] = measured.power_db
    return document


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)
