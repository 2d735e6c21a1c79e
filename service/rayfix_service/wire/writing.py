"""From a report back to its JSON."""

import math
from typing import Any

from rayfix_service.fusion.measurements.report import (
    CONFIDENCE,
    Angle,
    ErrorModel,
    LogRange,
    MeasuredPath,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.wire.fields import METRES_PER_NANOSECOND
from rayfix_service.wire.paths import path_to_document
from rayfix_service.wire.problems import FieldProblem, InvalidReportError
from rayfix_service.wire.request import parse_report
from rayfix_tables.geometry.angles import wrap_one
from rayfix_tables.site import Selection


def report_to_document(report: Report) -> dict[str, Any]:
    """Write a report as JSON-compatible data of which :func:`rayfix_service.wire.parse_report` makes it again.

    Lengths are given as lengths unless their deviation is too small for it, then as times, and a path length with a
    relative error as the signal strength of some model. Azimuths are written as they are within one turn. What has its
    default is left out, and so is an error model that is Gaussian by its numbers.

    Raises
    ------
    InvalidReportError
        For a report that the document cannot carry: a value out of range, an identifier that is too long.
    """
    document: dict[str, Any] = {}
    if report.target_id is not None:
        document["target_id"] = report.target_id
    if report.timestamp is not None:
        document["timestamp"] = report.timestamp
    if report.height is not None:
        document["height"] = {"z_m": report.height.z, "stdev_m": report.height.stdev}
    if report.confidence != CONFIDENCE:
        document["confidence"] = report.confidence
    if report.selection is not None:
        document["selection"] = _selection(report.selection)
    document["measurements"] = [_measurement(measurement) for measurement in report.measurements]
    parse_report(document)
    return document


def _selection(selection: Selection) -> dict[str, Any]:
    if selection.rule == "strongest":
        return {"rule": selection.rule, "exponent": selection.exponent}
    within = {} if selection.within_db is None else {"within_db": selection.within_db}
    return {"rule": selection.rule, **within}


def _measurement(measurement: Measurement) -> dict[str, Any]:
    match measurement:
        case Angle():
            return _angle(measurement) | _line_of_sight(measurement)
        case MeasuredPath():
            return path_to_document(measurement)
        case LogRange():
            return _signal_strength(measurement)
        case TimeDifference():
            document: dict[str, Any] = {
                "type": "tdoa",
                "station_id": measurement.station_id,
                "reference_station_id": measurement.reference_station_id,
                **_length(
                    "range_difference_m", "delay_difference_ns", measurement.length_difference, measurement.stdev
                ),
            }
        case Range():
            document = {
                "type": "pt",
                "station_id": measurement.station_id,
                **_line_of_sight(measurement),
                **_range(measurement),
            }
        case TimeOfArrival():
            document = {
                "type": "toa",
                "station_id": measurement.station_id,
                **_line_of_sight(measurement),
                **_length("range_m", "delay_ns", measurement.path_length, measurement.stdev),
            }
    return document | _error_model(measurement.error_model)


_LEAST = 1e-6
"""Least standard deviation in whichever unit."""


def _length(length_key: str, time_key: str, length: float, stdev: float) -> dict[str, float]:
    """Write a length and its standard deviation, m; as a time, if that is too small for a length."""
    if not stdev < _LEAST:
        return {length_key: length, "stdev_m": stdev}
    return {
        time_key: _toward_zero(length, METRES_PER_NANOSECOND),
        "stdev_ns": _snapped(stdev / METRES_PER_NANOSECOND, _LEAST),
    }


def _range(measurement: Range) -> dict[str, float]:
    """Write a range; as a round trip, which allows the smallest standard deviation, if it is too small for a length."""
    if not measurement.stdev < _LEAST:
        return {"range_m": measurement.path_length, "stdev_m": measurement.stdev}
    return {
        "round_trip_ns": _toward_zero(measurement.path_length, 0.5 * METRES_PER_NANOSECOND),
        "reply_ns": 0.0,
        "stdev_ns": _snapped(measurement.stdev / (0.5 * METRES_PER_NANOSECOND), _LEAST),
    }


def _toward_zero(value: float, unit: float) -> float:
    """Divide by a unit, so that the product with it is not beyond the value, which may be the largest allowed."""
    quotient = value / unit
    return math.nextafter(quotient, 0.0) if abs(quotient * unit) > abs(value) else quotient


def _snapped(value: float, *limits: float) -> float:
    """Return the limit from which a value differs in its last digits only, which may be beyond it."""
    return next((limit for limit in limits if math.isclose(value, limit, rel_tol=1e-12)), value)


def _angle(angle: Angle) -> dict[str, Any]:
    document: dict[str, Any] = {
        "type": "aoa",
        "station_id": angle.station_id,
        "azimuth_deg": _degrees(wrap_one(angle.azimuth) if math.isfinite(angle.azimuth) else angle.azimuth),
        "azimuth_stdev_deg": _degrees(angle.azimuth_stdev),
    }
    if angle.zenith is not None:
        document["zenith_deg"] = _degrees(angle.zenith)
    if angle.zenith_stdev is not None:
        document["zenith_stdev_deg"] = _degrees(angle.zenith_stdev)
    if angle.correlation:
        document["correlation"] = angle.correlation
    if angle.frame != "scene":
        document["frame"] = angle.frame
    return document | _error_model(angle.error_model)


def _signal_strength(measurement: LogRange) -> dict[str, Any]:
    """Find a path-loss model of the same median and spread; exponent 2 unless something is then out of range."""
    length, log_stdev = measurement.path_length, measurement.log_stdev
    if not (0.0 < length < math.inf and 0.0 < log_stdev < math.inf):
        text = f"a signal strength is of a path of {length!r} m with a deviation of its logarithm of {log_stdev!r}"
        raise InvalidReportError(
            (FieldProblem(path=("measurements",), message=f"{text}; give positive finite numbers"),)
        )
    decibels = 10.0 / math.log(10.0)  # of a factor of e, for each unit of exponent
    spread, loss = decibels * log_stdev, decibels * math.log(length)
    # The shadowing is from 0.1 to 15 dB, powers are from -200 to 100 dBm, the exponent is from 0.5 to 10.
    least = max(0.5, 0.1 / spread)
    most = min(10.0, 15.0 / spread, 300.0 / abs(loss) if loss else math.inf)
    exponent = min(max(2.0, least), most)
    return {
        "type": "rssi",
        "station_id": measurement.station_id,
        "rssi_dbm": _snapped(-50.0 - 0.5 * exponent * loss, -200.0, 100.0),
        "power_at_1m_dbm": _snapped(-50.0 + 0.5 * exponent * loss, -200.0, 100.0),
        "path_loss_exponent": exponent,
        "shadowing_stdev_db": _snapped(exponent * spread, 0.1, 15.0),
    }


def _error_model(model: ErrorModel) -> dict[str, Any]:
    if model.tail_share == 0.0 or model.tail_scale == 1.0:
        return {}
    return {"error_model": "heavy_tailed", "tail_share": model.tail_share, "tail_scale": model.tail_scale}


def _line_of_sight(measurement: Angle | Range | TimeOfArrival) -> dict[str, Any]:
    return {} if measurement.los_probability is None else {"los_probability": measurement.los_probability}


def _degrees(radians: float) -> float:
    """Convert to degrees, without the last digits that the way through radians cost."""
    return float(f"{math.degrees(radians):.14g}")
