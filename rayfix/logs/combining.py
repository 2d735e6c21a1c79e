"""Joining the packets of a target: one report for all of a short time."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean, median
from typing import Literal

from rayfix.logs.entries import Entry, Place, Problem
from rayfix_service.fusion.measurements.report import (
    Angle,
    LogRange,
    MeasuredPath,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.measuring.timestamps import utc_moment
from rayfix_service.wire import MAX_MEASUREMENTS, parse_report
from rayfix_tables.errors import ReportError
from rayfix_tables.geometry.angles import wrap_one

Combine = Literal["median", "mean", "none"]

_MOST_TARGETS = 10_000
"""Targets whose packets wait; of more, the window of the one that waits longest ends early."""

_PATIENCE = 10.0
"""A window ends when other targets are so many windows ahead."""


@dataclass(kw_only=True)
class _Window:
    begin: float
    place: Place
    reports: list[Report] = field(default_factory=list)


def joined(entries: Iterator[Entry | Problem], seconds: float, combine: Combine) -> Iterator[Entry | Problem]:
    """Join the reports of each target that lie within a window.

    A window begins with a target's first report after the one before, and ends `seconds` later. With "median" and
    "mean", measurements of the same kind and station become one; with "none", the report has all of them. A report
    without a time is a problem.

    Parameters
    ----------
    entries : iterator of Entry or Problem
    seconds : float, s
        Length of a window.
    combine : {"median", "mean", "none"}
    """
    open_windows: dict[str | None, _Window] = {}
    newest = -math.inf
    for entry in entries:
        if isinstance(entry, Problem):
            yield entry
            continue
        try:
            report = parse_report(entry.report) if isinstance(entry.report, bytes) else entry.report
            if report.timestamp is None:
                raise ReportError("the report has no timestamp, by which packets are joined; leave --window out")
        except ReportError as error:
            yield Problem(place=entry.place, text=str(error))
            continue
        now = utc_moment(report.timestamp).timestamp()
        newest = max(newest, now)
        window = open_windows.get(report.target_id)
        if window is not None and not -seconds <= now - window.begin < seconds:
            yield _report_of(open_windows.pop(report.target_id), combine)
            window = None
        if window is None:
            window = open_windows[report.target_id] = _Window(begin=now, place=entry.place)
        window.reports.append(report)
        # The oldest window is the first of the dict.
        while len(open_windows) > _MOST_TARGETS or _first(open_windows).begin < newest - _PATIENCE * seconds:
            target = next(iter(open_windows))
            if target == report.target_id and len(open_windows) == 1:
                break
            yield _report_of(open_windows.pop(target), combine)
    for window in open_windows.values():
        yield _report_of(window, combine)


def _first(windows: dict[str | None, _Window]) -> _Window:
    return next(iter(windows.values()))


def _report_of(window: _Window, combine: Combine) -> Entry | Problem:
    reports = window.reports
    measured: list[Measurement] = []
    if combine == "none":
        measured = list(dict.fromkeys(m for report in reports for m in report.measurements))
    else:
        middle = median if combine == "median" else fmean
        groups: dict[tuple[object, ...], list[Measurement]] = {}
        for report in reports:
            count: dict[tuple[object, ...], int] = {}
            for measurement in report.measurements:
                kind = _kind(measurement)
                # Receivers list the paths of a station in one order: the first with the first of other packets.
                count[kind] = ordinal = count.get(kind, -1) + 1
                groups.setdefault((*kind, ordinal), []).append(measurement)
        measured = [_middle(group, middle) for group in groups.values()]
    if len(measured) > MAX_MEASUREMENTS:
        return Problem(
            place=window.place,
            text=f"the window has {len(measured)} measurements, at most {MAX_MEASUREMENTS} are taken; give a shorter "
            "--window, or --combine median",
        )
    times = [utc_moment(r.timestamp) for r in reports if r.timestamp is not None]
    first = min(times)
    # Of the middle of the packets, in whole microseconds.
    moment = first + sum((t - first for t in times), start=first - first) / len(times)
    height = next((r.height for r in reports if r.height is not None), None)
    timestamp = moment.isoformat().replace("+00:00", "Z")
    return Entry(
        place=window.place,
        report=replace(reports[0], measurements=tuple(measured), height=height, timestamp=timestamp),
    )


def _kind(measurement: Measurement) -> tuple[object, ...]:
    """Give what measurements must have in common to be joined."""
    match measurement:
        case Angle():
            return "angle", measurement.station_id, measurement.frame, measurement.zenith is None
        case TimeDifference():
            return "difference", measurement.station_id, measurement.reference_station_id
        case MeasuredPath():
            return "path", measurement  # which paths of two packets are the same one is for the fusion to find
    return type(measurement).__name__, measurement.station_id


def _middle(group: Sequence[Measurement], middle: Callable[[Sequence[float]], float]) -> Measurement:
    """Join measurements of one kind; the deviation is the middle of theirs, since their errors are not independent."""
    first = group[0]
    if len(group) == 1:
        return first

    def of(name: str) -> float:
        return float(middle([getattr(m, name) for m in group]))

    def known(name: str) -> float | None:
        values = [v for m in group if (v := getattr(m, name)) is not None]
        return float(middle(values)) if values else None

    match first:
        case Angle():
            azimuths = [m.azimuth for m in group if isinstance(m, Angle)]
            # About their circular mean, so that angles on both sides of 180 deg have their middle there.
            centre = math.atan2(fmean(map(math.sin, azimuths)), fmean(map(math.cos, azimuths)))
            turned = float(middle([math.remainder(a - centre, 2.0 * math.pi) for a in azimuths]))
            return replace(
                first,
                azimuth=wrap_one(centre + turned),
                azimuth_stdev=of("azimuth_stdev"),
                zenith=known("zenith"),
                zenith_stdev=known("zenith_stdev"),
                correlation=of("correlation"),
                los_probability=known("los_probability"),
            )
        case Range() | TimeOfArrival():
            return replace(
                first, path_length=of("path_length"), stdev=of("stdev"), los_probability=known("los_probability")
            )
        case LogRange():
            return replace(first, path_length=of("path_length"), log_stdev=of("log_stdev"))
        case MeasuredPath():
            return first
        case TimeDifference():
            return replace(first, length_difference=of("length_difference"), stdev=of("stdev"))
