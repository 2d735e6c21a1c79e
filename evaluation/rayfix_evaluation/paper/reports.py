"""Reports in the form of the paper's method: one angle and one time per station, differences to one reference."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from rayfix_evaluation.paper.selection import RelativeLength
from rayfix_service.fusion.measurements.directions import Direction, to_scene, without_bias
from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    Angle,
    LogRange,
    MeasuredPath,
    Range,
    Report,
    TimeDifference,
)
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station


@dataclass(frozen=True, kw_only=True)
class PaperReport:
    """Measurements by station, with the stations' biases subtracted.

    Attributes
    ----------
    directions : mapping of str to Direction
        In the scene frame.
    ranges : mapping of str to (length, stdev), m
    reference : str or None
        Station that the differences are relative to.
    differences : mapping of str to RelativeLength
        Differences of all other stations with a time.
    """

    directions: Mapping[str, Direction]
    ranges: Mapping[str, tuple[float, float]]
    reference: str | None
    differences: Mapping[str, RelativeLength]

    @property
    def names(self) -> list[str]:
        """Stations that measured something."""
        reference = [] if self.reference is None else [self.reference]
        return list(dict.fromkeys([*self.directions, *self.ranges, *reference, *self.differences]))


def sort_for_paper(report: Report, site: SiteInfo) -> PaperReport:
    """Sort a report by station; times of arrival become differences to the first of them.

    Raises
    ------
    ReportError
        When a station is unknown, or the report has data that the paper's method does not support: a height, a signal
        strength, errors that are not Gaussian, an azimuth without a zenith, two measurements of a kind from one
        station, or time differences to more than one reference.
    """
    if report.height is not None:
        raise ReportError("the paper's method does not support a height; leave it out", path=("height",))
    stations = {station.id: station for station in site.stations}
    directions: dict[str, Direction] = {}
    ranges: dict[str, tuple[float, float]] = {}
    arrivals: dict[str, tuple[float, float]] = {}
    differences: dict[str, RelativeLength] = {}
    references: set[str] = set()
    for index, measurement in enumerate(report.measurements):
        station = _station(measurement.station_id, stations, index)
        name, bias = station.id, station.bias
        if isinstance(measurement, LogRange | MeasuredPath) or measurement.error_model != GAUSSIAN:
            _refuse(index, f"knows Gaussian errors only, which this {type(measurement).__name__} has not")
        known: Mapping[str, object]
        if isinstance(measurement, Angle):
            known = directions
        elif isinstance(measurement, TimeDifference):
            known = differences
        else:
            known = ranges if isinstance(measurement, Range) else arrivals
        if name in known:
            _refuse(index, f"takes one measurement of a kind from a station, and '{name}' has two")
        if isinstance(measurement, Angle):
            directions[name] = to_scene(without_bias(measurement, station), station, site.north)
            if directions[name].zenith is None:
                _refuse(index, "takes azimuth and zenith; leave the lone azimuth out")
        elif isinstance(measurement, TimeDifference):
            other = _station(measurement.reference_station_id, stations, index)
            references.add(other.id)
            differences[name] = RelativeLength(
                length_difference=measurement.length_difference - (bias.range - other.bias.range),
                stdev=float(np.hypot(measurement.stdev, np.hypot(bias.range_stdev, other.bias.range_stdev))),
            )
        else:
            times = ranges if isinstance(measurement, Range) else arrivals
            deviation = float(np.hypot(measurement.stdev, bias.range_stdev))
            times[name] = (measurement.path_length - bias.range, deviation)
    if len(arrivals) > 1:
        first, *others = arrivals
        references.add(first)
        start, start_stdev = arrivals[first]
        for name in others:
            length, stdev = arrivals[name]
            both = float(np.hypot(stdev, start_stdev))
            differences[name] = RelativeLength(length_difference=length - start, stdev=both)
    if len(references) > 1:
        raise ReportError(
            f"the paper's method takes time differences to one reference, not to {', '.join(sorted(references))}",
            path=("measurements",),
        )
    return PaperReport(
        directions=directions, ranges=ranges, reference=next(iter(references), None), differences=differences
    )


def _refuse(index: int, reason: str) -> NoReturn:
    raise ReportError(f"the paper's method {reason}", path=("measurements", index))


def _station(name: str, stations: Mapping[str, Station], index: int) -> Station:
    if name not in stations:
        known = ", ".join(stations)
        raise ReportError(f"station '{name}' is not in the site; it has {known}", path=("measurements", index))
    return stations[name]
