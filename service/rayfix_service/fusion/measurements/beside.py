"""Times of arrival of single paths beside stations that report several.

A time of arrival is a length of one path on the UE's clock, which measured paths with a time on that clock share. So it
is a set of one measured path, whichever path of its station that is; with the angle of its station, if there is one,
since they are of the same path.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from rayfix_service.fusion.measurements.clocks import ALONE
from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    Angle,
    LogRange,
    MeasuredPath,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_tables.errors import ReportError

_REMEDY = "beside measurements of type path; give it as a path with toa_m"


class PathsAndTimes(NamedTuple):
    """A report whose times of arrival are measured paths.

    Attributes
    ----------
    report : Report
        Measurements that are part of a measured path are themselves measured paths, which count no more.
    measured : tuple of (int, MeasuredPath)
        All measured paths, with their indices.
    single : mapping of int to (int or None)
        Indices of those that are a set of one, and of the angles that are part of them.
    unused : mapping of int to str
        Why others do not contribute.
    """

    report: Report
    measured: tuple[tuple[int, MeasuredPath], ...]
    single: Mapping[int, int | None]
    unused: Mapping[int, str]


def paths_and_times(report: Report) -> PathsAndTimes:
    """Take times of arrival for measured paths, where the report has any measured path.

    Raises
    ------
    ReportError
        For times that are no such path: time differences, and times whose errors are not Gaussian, that have a
        line-of-sight indication, or of which it is open which measurement they belong to.
    """
    paths = [(n, m) for n, m in enumerate(report.measurements) if isinstance(m, MeasuredPath)]
    if not paths:
        return PathsAndTimes(report, (), {}, {})
    of_station: defaultdict[str, list[int]] = defaultdict(list)
    for index, measurement in enumerate(report.measurements):
        if isinstance(measurement, TimeDifference):
            raise ReportError(
                f"measurements[{index}] is a time difference (tdoa) beside measurements of type path; give the times "
                "of arrival that it is of, as toa",
                path=("measurements", index),
            )
        if not isinstance(measurement, MeasuredPath):
            of_station[measurement.station_id].append(index)
    measurements: list[Measurement] = list(report.measurements)
    single: dict[int, int | None] = {}
    for index, measurement in enumerate(report.measurements):
        if isinstance(measurement, TimeOfArrival):
            angle = _angle_of(report, index, of_station[measurement.station_id])
            measured = MeasuredPath(
                station_id=measurement.station_id,
                length=measurement.path_length,
                stdev=measurement.stdev,
                clock="ue",
            )
            if angle is not None:
                direction = _direction(report.measurements[angle])
                measurements[angle] = direction
                measured = replace(direction, length=measured.length, stdev=measured.stdev, clock="ue")
            measurements[index] = measured
            single[index] = angle
    on_clock = [n for n, m in paths if m.clock == "ue" and m.length is not None]
    unused: dict[int, str] = {}
    if len(single) == 1 and not on_clock:
        ((index, angle),) = single.items()
        unused[index] = ALONE
        if angle is not None:  # the angle tells of the position without the time
            measurements[angle] = report.measurements[angle]
        single = {}
    kept = [(n, m) for n, m in enumerate(measurements) if n in single and isinstance(m, MeasuredPath)]
    return PathsAndTimes(replace(report, measurements=tuple(measurements)), (*paths, *kept), single, unused)


def _angle_of(report: Report, index: int, others: list[int]) -> int | None:
    """Index of the angle that is of the same path as a time of arrival; None where there is none."""
    time = report.measurements[index]
    assert isinstance(time, TimeOfArrival)
    where = ("measurements", index)
    if time.error_model != GAUSSIAN:
        raise ReportError(f"measurements[{index}] is a toa of heavy-tailed errors {_REMEDY}", path=where)
    if time.los_probability is not None:
        raise ReportError(f"measurements[{index}] is a toa with a los_probability {_REMEDY}", path=where)
    angles = []
    for other in others:
        measurement = report.measurements[other]
        if isinstance(measurement, Range | LogRange) or (other != index and isinstance(measurement, TimeOfArrival)):
            raise ReportError(
                f"measurements[{index}] is one of several times or signal strengths of station '{time.station_id}' "
                f"{_REMEDY}",
                path=where,
            )
        if isinstance(measurement, Angle):
            angles.append(other)
    if not angles:
        return None
    angle = report.measurements[angles[0]]
    assert isinstance(angle, Angle)
    plain = angle.error_model == GAUSSIAN and angle.los_probability is None and angle.correlation == 0.0
    if len(angles) > 1 or not plain:
        raise ReportError(
            f"measurements[{index}] is a toa of a station whose aoa are several, correlated, heavy-tailed or have a "
            "los_probability, beside measurements of type path; give angle and time as a path with toa_m",
            path=where,
        )
    return angles[0]


def _direction(angle: Measurement) -> MeasuredPath:
    assert isinstance(angle, Angle)
    return MeasuredPath(
        station_id=angle.station_id,
        azimuth=angle.azimuth,
        azimuth_stdev=angle.azimuth_stdev,
        zenith=angle.zenith,
        zenith_stdev=angle.zenith_stdev,
        frame=angle.frame,
    )
