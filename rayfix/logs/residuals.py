"""What a fix says of each of its measurements, for the summary of a log."""

import math
from typing import Literal, NamedTuple

from rayfix_service.fusion.diagnosis.residuals import Vector, signed_angle_residual
from rayfix_service.fusion.measurements.calibrated import with_deviations
from rayfix_service.fusion.measurements.report import Angle, Measurement, Range, Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_tables.site import SiteInfo

Quantity = Literal["azimuth_deg", "zenith_deg", "range_m"]


class Residual(NamedTuple):
    """What became of one measurement.

    Attributes
    ----------
    station_id : str
    used : bool
    outlier : bool
        Whether it is one with a probability above one half.
    differences : tuple of (quantity, value, stdev)
        Measured minus that of the straight path to the position, and the deviation that counts: the
        stated one, or that which the station's calibration found. Empty where it says nothing.
    """

    station_id: str
    used: bool
    outlier: bool
    differences: tuple[tuple[Quantity, float, float], ...]


def residuals(report: Report, fix: Fix, site: SiteInfo) -> tuple[Residual, ...]:
    """Compare the measurements of a report with the position of its fix."""
    position = None if fix.position is None else (*map(float, fix.position),)
    report = with_deviations(report, site)
    found = []
    for measurement, outcome in zip(report.measurements, fix.outcomes, strict=True):
        outlier = outcome.used and (outcome.outlier_probability or 0.0) > 0.5
        differences: tuple[tuple[Quantity, float, float], ...] = ()
        if outcome.used and not outlier and position is not None and fix.status == "ok":
            differences = _differences(measurement, site, (position[0], position[1], position[2]))
        found.append(Residual(measurement.station_id, outcome.used, outlier, differences))
    return tuple(found)


def _differences(
    measurement: Measurement, site: SiteInfo, position: Vector
) -> tuple[tuple[Quantity, float, float], ...]:
    station = site.station_by_id[measurement.station_id]
    match measurement:
        case Angle():
            apart = signed_angle_residual(measurement, station, site.north, position)
            if apart is None:
                return ()
            azimuth, zenith = apart
            one: tuple[Quantity, float, float] = (
                "azimuth_deg",
                math.degrees(azimuth),
                math.degrees(measurement.azimuth_stdev),
            )
            if zenith is None or measurement.zenith_stdev is None:
                return (one,)
            return one, ("zenith_deg", math.degrees(zenith), math.degrees(measurement.zenith_stdev))
        case Range():
            length = measurement.path_length - station.bias.range
            return (("range_m", length - math.dist(position, station.position), measurement.stdev),)
    return ()
