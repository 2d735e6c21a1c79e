"""Checks of a report that was built in Python; one that comes as JSON is checked while it is read."""

import math
import sys
from typing import get_args

from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    Angle,
    ErrorModel,
    Height,
    LogRange,
    MeasuredPath,
    Measurement,
    PathClock,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_tables.errors import ReportError
from rayfix_tables.site import Rule, Selection
from rayfix_tables.validation.limits import Limits
from rayfix_tables.validation.problems import path_text

_FINITE = Limits()
_STDEV = Limits(above=0.0)
_PROBABILITY = Limits(least=0.0, most=1.0)
_TURN = Limits(least=-2.0 * math.pi, most=2.0 * math.pi)

_LIMITS: dict[type, dict[str, Limits]] = {
    Angle: {
        "azimuth": _TURN,
        "azimuth_stdev": _STDEV,
        "zenith": Limits(least=0.0, most=math.pi),
        "zenith_stdev": _STDEV,
        "correlation": Limits(above=-1.0, below=1.0),
        "los_probability": _PROBABILITY,
    },
    Range: {"path_length": _FINITE, "stdev": _STDEV, "los_probability": _PROBABILITY},
    LogRange: {"path_length": Limits(above=0.0), "log_stdev": _STDEV},
    TimeOfArrival: {"path_length": _FINITE, "stdev": _STDEV, "los_probability": _PROBABILITY},
    TimeDifference: {"length_difference": _FINITE, "stdev": _STDEV},
    MeasuredPath: {
        "azimuth": _TURN,
        "azimuth_stdev": _STDEV,
        "zenith": Limits(least=0.0, most=math.pi),
        "zenith_stdev": _STDEV,
        "length": _FINITE,
        "stdev": _STDEV,
        "power_db": _FINITE,
    },
    Height: {"z": _FINITE, "stdev": _STDEV},
    ErrorModel: {"tail_share": Limits(least=0.0, below=1.0), "tail_scale": Limits(least=1.0)},
    Report: {"confidence": Limits(above=0.0, below=1.0)},
    Selection: {"exponent": Limits(least=0.0, most=20.0), "within_db": Limits(above=0.0, most=100.0)},
}
_OPTIONAL = frozenset({"zenith", "zenith_stdev", "los_probability", "within_db"})
_OPTIONAL_OF_PATHS = frozenset({"azimuth", "azimuth_stdev", "length", "stdev", "power_db"})


def _closed(limits: Limits) -> tuple[float, float]:
    """Least and greatest number of a range."""
    low, high = -sys.float_info.max, sys.float_info.max
    if limits.least is not None:
        low = limits.least
    if limits.above is not None:
        low = max(low, math.nextafter(limits.above, math.inf))
    if limits.most is not None:
        high = limits.most
    if limits.below is not None:
        high = min(high, math.nextafter(limits.below, -math.inf))
    return low, high


_FIELDS = {
    kind: [(name, *_closed(limits), limits) for name, limits in ranges.items()] for kind, ranges in _LIMITS.items()
}
"""Name, least number, greatest number and range of each field: comparing with two numbers is what takes least."""

_KINDS = "an Angle, a Range, a LogRange, a TimeOfArrival, a TimeDifference or a MeasuredPath"


def check_report(report: Report) -> Report:
    """Return the report, if all its numbers are in their ranges.

    Parameters
    ----------
    report : Report

    Raises
    ------
    ReportError
        When a number is out of its range or missing, or a measurement is of no known kind; ``path`` names the field.
    """
    _check(report, ())
    if report.height is not None:
        _check(report.height, ("height",))
    if report.selection is not None:
        if report.selection.rule not in get_args(Rule):
            _refuse(("selection", "rule"), report.selection.rule, f"one of {', '.join(get_args(Rule))}")
        _check(report.selection, ("selection",))
    for index, measurement in enumerate(report.measurements):
        path = ("measurements", index)
        if not isinstance(measurement, Measurement):
            raise ReportError(f"measurements[{index}] is {measurement!r}; give {_KINDS}", path=path)
        _check(measurement, path)
        if isinstance(measurement, MeasuredPath):
            _check_whole(measurement, path)
            continue
        if not isinstance(measurement, LogRange) and measurement.error_model is not GAUSSIAN:
            _check(measurement.error_model, (*path, "error_model"))
        if isinstance(measurement, Angle) and (measurement.zenith is None) != (measurement.zenith_stdev is None):
            missing = "zenith" if measurement.zenith is None else "zenith_stdev"
            _refuse((*path, missing), None, "a number, or neither zenith nor zenith_stdev")
    return report


def _check_whole(measured: MeasuredPath, path: tuple[str | int, ...]) -> None:
    """Check that what was measured of a path comes with its deviation, and that there is something."""
    for name, stdev in (("azimuth", "azimuth_stdev"), ("zenith", "zenith_stdev"), ("length", "stdev")):
        if (getattr(measured, name) is None) != (getattr(measured, stdev) is None):
            missing = name if getattr(measured, name) is None else stdev
            _refuse((*path, missing), None, f"a number, or neither {name} nor {stdev}")
    if measured.azimuth is None and (measured.zenith is not None or measured.length is None):
        _refuse((*path, "azimuth"), None, "a number, or no zenith but a length")
    if measured.clock not in get_args(PathClock):
        _refuse((*path, "clock"), measured.clock, f"one of {', '.join(get_args(PathClock))}")


def _check(part: object, path: tuple[str | int, ...]) -> None:
    for name, low, high, limits in _FIELDS[type(part)]:
        value = getattr(part, name)
        if value is None and (name in _OPTIONAL or (isinstance(part, MeasuredPath) and name in _OPTIONAL_OF_PATHS)):
            continue
        try:
            within = low <= value <= high
        except (TypeError, ValueError):
            within = False
        if not within:
            unit = ", in radians" if name.startswith(("azimuth", "zenith")) else ""
            _refuse((*path, name), value, f"a finite number {limits}".rstrip() + unit)


def _refuse(path: tuple[str | int, ...], value: object, wanted: str) -> None:
    raise ReportError(f"{path_text(path)} is {value!r}; give {wanted}", path=path)
