"""Conversion of angles from Silicon Labs' Bluetooth locators into a report.

A locator publishes one JSON object per packet that it received (Bluetooth SDK, ``aoa_serialize_angle``): degrees and
metres, with the sequence number of the packet. Only the MQTT topic names locator and tag.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field, model_validator

from rayfix_service.adapters.adapted import Adapted, adapted_report, station_of
from rayfix_service.adapters.documents import KnownHeight, Stations, TargetId, Timestamp, check
from rayfix_service.fusion.measurements.report import CONFIDENCE, Angle, Frame, Measurement, Range
from rayfix_service.wire import MAX_MEASUREMENTS, MAX_REPORTS, WireModel
from rayfix_service.wire.fields import Confidence, misfit
from rayfix_service.wire.limits import USUAL_LIMITS, MessageLimits
from rayfix_tables.geometry.angles import wrap_one
from rayfix_tables.validation.problems import Path

_Stdev = Field(ge=0, le=360, description="a standard deviation in degrees, 0 to 360")

LEAST_STDEV_DEG = 0.5
"""Smallest standard deviation that is used: locators estimate the noise of an angle, not the error of their array."""


class SilabsAngle(WireModel):
    """The message that a locator publishes for one packet. Unknown keys, which later software may add, are ignored."""

    model_config = ConfigDict(extra="ignore")

    azimuth: float = Field(ge=-360, le=360, description="an azimuth in degrees, clockwise, -360 to 360")
    azimuth_stdev: Annotated[float, _Stdev]
    elevation: Annotated[float, Field(ge=-90, le=90, description="an elevation in degrees, -90 to 90")] | None = None
    elevation_stdev: Annotated[float, _Stdev] | None = None
    distance: Annotated[float, Field(ge=0, le=1e6, description="a distance in metres, 0 to 1e+06")] | None = None
    distance_stdev: (
        Annotated[float, Field(ge=0, le=1e6, description="a standard deviation in metres, 0 to 1e+06")] | None
    ) = None
    sequence: (
        Annotated[int, Field(ge=-(2**31), lt=2**32, description="the sequence number of the packet, an integer")] | None
    ) = None

    @model_validator(mode="after")
    def _elevation_whole(self) -> Self:
        if (self.elevation is None) != (self.elevation_stdev is None):
            missing = "elevation" if self.elevation is None else "elevation_stdev"
            raise misfit(missing, "is missing; give elevation and elevation_stdev, or neither")
        return self


class SilabsLocatorAngle(SilabsAngle):
    """The same with the locator's name, which in MQTT is part of the topic."""

    locator_id: str = Field(min_length=1, max_length=128, description="the locator's name, 1 to 128 characters")


class SilabsDocument(WireModel):
    """The angles that several locators measured for one packet of a tag."""

    model_config = ConfigDict(title="SilabsReport")

    target_id: TargetId = None
    timestamp: Timestamp = None
    stations: Stations = None
    height: KnownHeight = None
    confidence: Confidence = CONFIDENCE
    frame: Frame = Field(default="lcs", description='one of "lcs", "scene" and "north", the frame of the angles')
    least_stdev_deg: float = Field(
        default=LEAST_STDEV_DEG, ge=1e-6, le=360, description="the least standard deviation to believe, 1e-06 to 360"
    )
    angles: list[SilabsLocatorAngle] = Field(
        min_length=1, max_length=MAX_MEASUREMENTS, description=f"an array of 1 to {MAX_MEASUREMENTS} angles"
    )


class SilabsBatchDocument(WireModel):
    """The angles of many packets, answered in their order; each packet is validated separately."""

    model_config = ConfigDict(title="SilabsBatch")

    reports: list[SilabsDocument] = Field(
        max_length=MAX_REPORTS, description=f"an array of at most {MAX_REPORTS} messages"
    )


def parse_silabs(
    message: Mapping[str, Any] | bytes,
    *,
    stations: Mapping[str, str] | None = None,
    limits: MessageLimits = USUAL_LIMITS,
) -> Adapted:
    """Turn the angles of one packet into a report.

    Parameters
    ----------
    message : Mapping or bytes
        The message as :class:`SilabsDocument` describes it, or its JSON text.
    stations : Mapping, optional
        Stations by locator, for those that the message's own map does not have. A locator in neither is itself a
        station's identifier.
    limits : MessageLimits, optional

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON.
    InvalidReportError
        For a message that is not valid.
    """
    document = check(SilabsDocument, message, what="the message", limits=limits)
    measurements: list[tuple[Path, Measurement]] = []
    for n, angle in enumerate(document.angles):
        station_id = station_of(angle.locator_id, document.stations, stations)
        found = silabs_measurements(angle, station_id, frame=document.frame, least_stdev_deg=document.least_stdev_deg)
        measurements += [(("angles", n), one) for one in found]
    return adapted_report(
        measurements,
        [],
        target_id=document.target_id,
        timestamp=document.timestamp,
        height=None if document.height is None else document.height.height(),
        confidence=document.confidence,
    )


def parse_silabs_angle(payload: bytes) -> SilabsAngle:
    """Read the payload of a locator's MQTT message.

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON.
    InvalidReportError
        For JSON that is not an angle.
    """
    return check(SilabsAngle, payload, what="the angle")


def silabs_measurements(
    angle: SilabsAngle, station_id: str, *, frame: Frame = "lcs", least_stdev_deg: float = LEAST_STDEV_DEG
) -> tuple[Measurement, ...]:
    """Convert one locator's angle into measurements: the azimuth changes its sign, and zenith = 90 deg - elevation.

    The distance, which locators estimate from the signal strength, becomes a propagation time if it has a positive
    standard deviation. The smallest standard deviation applies to angles only.
    """
    least = math.radians(least_stdev_deg)
    measured = Angle(
        station_id=station_id,
        azimuth=wrap_one(math.radians(-angle.azimuth)),
        azimuth_stdev=max(math.radians(angle.azimuth_stdev), least),
        zenith=None if angle.elevation is None else math.radians(90.0 - angle.elevation),
        zenith_stdev=None if angle.elevation_stdev is None else max(math.radians(angle.elevation_stdev), least),
        frame=frame,
    )
    if angle.distance is None or not angle.distance_stdev:
        return (measured,)
    return measured, Range(station_id=station_id, path_length=angle.distance, stdev=max(angle.distance_stdev, 1e-6))
