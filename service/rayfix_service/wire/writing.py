"""From a report back to its JSON."""

import math
from typing import Any

from rayfix_service.fusion.measurements.report import (
    CONFIDENCE,
    GAUSSIAN,
    Angle,
    ErrorModel,
    LogRange,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)


def report_to_document(report: Report) -> dict[str, Any]:
    """Write a report as JSON-compatible data of which :func:`rayfix_service.wire.parse_report` makes it again.

    Lengths are given as lengths, and a path length with a relative error as the signal strength of some model. What
    has its default is left out.
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
    document["measurements"] = [_measurement(measurement) for measurement in report.measurements]
    return document


def _measurement(measurement: Measurement) -> dict[str, Any]:
    match measurement:
        case Angle():
            return _angle(measurement) | _sight(measurement)
        case LogRange():
            return _signal_strength(measurement)
        case TimeDifference():
            document: dict[str, Any] = {
                "type": "tdoa",
                "station_id": measurement.station_id,
                "reference_station_id": measurement.reference_station_id,
                "range_difference_m": measurement.length_difference,
            }
        case Range() | TimeOfArrival():
            document = {
                "type": "pt" if isinstance(measurement, Range) else "toa",
                "station_id": measurement.station_id,
                "range_m": measurement.path_length,
                **_sight(measurement),
            }
    return {**document, "stdev_m": measurement.stdev, **_error_model(measurement.error_model)}


def _angle(angle: Angle) -> dict[str, Any]:
    document: dict[str, Any] = {
        "type": "aoa",
        "station_id": angle.station_id,
        "azimuth_deg": _degrees(angle.azimuth),
        "azimuth_stdev_deg": _degrees(angle.azimuth_stdev),
    }
    if angle.zenith is not None and angle.zenith_stdev is not None:
        document |= {"zenith_deg": _degrees(angle.zenith), "zenith_stdev_deg": _degrees(angle.zenith_stdev)}
    if angle.correlation:
        document["correlation"] = angle.correlation
    if angle.frame != "scene":
        document["frame"] = angle.frame
    return document | _error_model(angle.error_model)


def _signal_strength(measurement: LogRange) -> dict[str, Any]:
    """Find a path-loss model of the same median and spread; exponent 2 unless the shadowing is then out of range."""
    decibels = 10.0 / math.log(10.0)
    shadowing = min(max(2.0 * decibels * measurement.log_stdev, 0.1), 15.0)
    exponent = shadowing / (decibels * measurement.log_stdev)
    loss = exponent * decibels * math.log(measurement.path_length)
    return {
        "type": "rssi",
        "station_id": measurement.station_id,
        "rssi_dbm": -50.0 - 0.5 * loss,
        "power_at_1m_dbm": -50.0 + 0.5 * loss,
        "path_loss_exponent": exponent,
        "shadowing_stdev_db": shadowing,
    }


def _error_model(model: ErrorModel) -> dict[str, Any]:
    if model == GAUSSIAN:
        return {}
    return {"error_model": "heavy_tailed", "tail_share": model.tail_share, "tail_scale": model.tail_scale}


def _sight(measurement: Angle | Range | TimeOfArrival) -> dict[str, Any]:
    return {} if measurement.los_probability is None else {"los_probability": measurement.los_probability}


def _degrees(radians: float) -> float:
    """Convert to degrees, without the last digits that the way through radians cost."""
    return round(math.degrees(radians), 12)
