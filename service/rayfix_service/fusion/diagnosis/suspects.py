"""Name the measurements that an inconsistent fix takes for outliers."""

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
from rayfix_service.fusion.posterior.fix import Fix

_MOST_NAMED = 6
_SUSPECT = 0.5
"""Outliers at least this probable are named."""


def suspects(report: Report, fix: Fix) -> str:
    """Say which measurements of a report do not fit the others, by kind, station and index.

    Parameters
    ----------
    report : Report
    fix : Fix
        Of that report, with the status "inconsistent".
    """
    found = [
        f"{named(measurement)} (measurements[{n}])"
        for n, (measurement, outcome) in enumerate(zip(report.measurements, fix.outcomes, strict=True))
        if (outcome.outlier_probability or 0.0) >= _SUSPECT
    ]
    if len(found) > _MOST_NAMED:
        found[_MOST_NAMED:] = [f"{len(found) - _MOST_NAMED} more"]
    # Of many rivals, each may blame other measurements, so that none is an outlier in more than half of them.
    which = f"probably outliers are {_listed(found)}" if found else "which of them are outliers is open"
    return f"the measurements contradict each other or the table: {which}; the position cannot be trusted"


def named(measurement: Measurement) -> str:
    """Name a measurement by its kind and station."""
    match measurement:
        case Angle():
            kind = "the angle"
        case Range():
            kind = "the propagation time"
        case LogRange():
            kind = "the signal strength"
        case TimeOfArrival():
            kind = "the time of arrival"
        case MeasuredPath():
            kind = "the path"
        case TimeDifference(reference_station_id=reference):
            return f"the time difference of station '{measurement.station_id}' to '{reference}'"
    return f"{kind} of station '{measurement.station_id}'"


def _listed(items: list[str]) -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"
