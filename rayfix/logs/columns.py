"""Columns of logs in CSV: their names, and what a row of them says."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from typing import Any

from pydantic import ValidationError

from rayfix_service.adapters.adapted import station_of
from rayfix_service.fusion.measurements.report import CONFIDENCE, Height, Measurement
from rayfix_service.wire.documents import HeightDocument, ReportDocument
from rayfix_service.wire.measurements import MEASUREMENT_DOCUMENTS
from rayfix_service.wire.problems import invalid_report
from rayfix_tables.errors import ReportError

_TEXTS = ("type", "station_id", "reference_station_id", "frame", "error_model")

_DIRECTIONS = ("azimuth_deg", "azimuth_stdev_deg", "zenith_deg", "zenith_stdev_deg", "frame")
_ANGLES = (*_DIRECTIONS, "correlation")
_OF_PATH = ("toa_m", "power_db")
"""What a row has only where it is one of several paths of a station."""
_TIMES = ("range_m", "delay_ns", "toa_ns", "tod_ns", "round_trip_ns", "reply_ns")
_DIFFERENCES = ("range_difference_m", "delay_difference_ns", "reference_station_id")
_STRENGTHS = ("rssi_dbm", "power_at_1m_dbm", "path_loss_exponent", "shadowing_stdev_db")
_SPREADS = ("stdev_m", "stdev_ns")
_ERRORS = ("error_model", "tail_share", "tail_scale")
_SIGHT = ("los_probability",)

_KEYS: dict[str, tuple[str, ...]] = {
    "aoa": (*_ANGLES, *_ERRORS, *_SIGHT),
    "pt": (*_TIMES, *_SPREADS, *_ERRORS, *_SIGHT),
    "toa": ("range_m", "delay_ns", *_SPREADS, *_ERRORS, *_SIGHT),
    "tdoa": (*_DIFFERENCES, *_SPREADS, *_ERRORS),
    "rssi": _STRENGTHS,
    "path": (*_DIRECTIONS, "range_m", "delay_ns", *_SPREADS, *_OF_PATH),
}
"""Keys of the measurement documents that a row may fill, by type; all have station_id besides."""

_OTHER_SIGN = {"azimuth_clockwise_deg": "azimuth_deg", "elevation_deg": "zenith_deg"}
_OTHER_NAME = {"elevation_stdev_deg": "zenith_stdev_deg"}

_UNIX_TIMES = {"timestamp_s": 1, "timestamp_ms": 1_000, "timestamp_us": 1_000_000, "timestamp_ns": 1_000_000_000}
"""Columns of times since 1970, UTC, and how many of the unit a second has."""

OF_REPORT = ("report", "target_id", "timestamp", *_UNIX_TIMES, "height_z_m", "height_stdev_m", "confidence")
"""Columns that belong to the report and not to the measurement."""

COLUMNS = (
    *OF_REPORT,
    *dict.fromkeys(
        ("type", "station_id", *_OTHER_SIGN, *_OTHER_NAME, *(key for keys in _KEYS.values() for key in keys))
    ),
)
"""All columns that are read."""


@dataclass(frozen=True, kw_only=True)
class RowHead:
    """What a row says of its report.

    Attributes
    ----------
    key : tuple
        Rows next to each other with the same key belong to one report.
    """

    key: tuple[str | None, ...]
    target_id: str | None
    timestamp: str | None
    height: Height | None
    confidence: float


def head_of(row: Mapping[str, str]) -> RowHead:
    """Read what a row says of its report.

    Raises
    ------
    ReportError
        When a value is none.
    """
    timestamp = _timestamp(row)
    target = row.get("target_id")
    height = None
    if "height_z_m" in row or "height_stdev_m" in row:
        found = {"z_m": row.get("height_z_m"), "stdev_m": row.get("height_stdev_m")}
        document = {key: _number(f"height_{key}", text) for key, text in found.items() if text is not None}
        try:
            height = HeightDocument.model_validate(document).height()
        except ValidationError as error:
            raise invalid_report(error, HeightDocument, document, "the height") from None
    confidence = _number("confidence", row["confidence"]) if "confidence" in row else CONFIDENCE
    head = {"target_id": target, "timestamp": timestamp, "confidence": confidence, "measurements": [_PLACEHOLDER]}
    try:
        ReportDocument.model_validate(head)
    except ValidationError as error:
        raise invalid_report(error, ReportDocument, head, "the row") from None
    key = (row["report"],) if "report" in row else (target, timestamp)
    return RowHead(key=key, target_id=target, timestamp=timestamp, height=height, confidence=confidence)


_PLACEHOLDER = {"type": "pt", "station_id": "s", "range_m": 1.0, "stdev_m": 1.0}


def measurements_of(row: Mapping[str, str], stations: Mapping[str, str]) -> list[Measurement]:
    """Read the measurements of a row: that of its type, or those whose columns it fills.

    Parameters
    ----------
    row : Mapping
        Texts by column, without the empty ones.
    stations : Mapping
        Stations by their names in the log, of those that have others there.

    Raises
    ------
    ReportError
        When it has none, or one that is not valid.
    """
    kinds = [row["type"]] if "type" in row else _kinds_of(row)
    if not kinds:
        raise ReportError("the row has no measurement; give e.g. azimuth_deg or range_m, or map columns by --column")
    found = []
    for kind in kinds:
        model = MEASUREMENT_DOCUMENTS.get(kind)
        if model is None:
            raise ReportError(f"type is {kind!r}; give one of {', '.join(MEASUREMENT_DOCUMENTS)}")
        document = _document(kind, row, stations, alone=len(kinds) == 1 and "type" in row)
        try:
            found.append(model.model_validate(document).measurement())  # type: ignore[attr-defined]
        except ValidationError as error:
            raise invalid_report(error, model, document, f"the {kind} measurement") from None
    return found


def _kinds_of(row: Mapping[str, str]) -> list[str]:
    if any(key in row for key in _OF_PATH):
        return ["path"]
    kinds = []
    if "azimuth_deg" in row or "azimuth_clockwise_deg" in row:
        kinds.append("aoa")
    if any(key in row for key in ("range_difference_m", "delay_difference_ns")):
        kinds.append("tdoa")
    elif any(key in row for key in _TIMES):
        kinds.append("pt")
    if "rssi_dbm" in row and "power_at_1m_dbm" in row:
        kinds.append("rssi")
    return kinds


def _document(kind: str, row: Mapping[str, str], stations: Mapping[str, str], *, alone: bool) -> dict[str, Any]:
    """Write a row as a measurement's document; of a row of one type all keys count, so that none is passed over."""
    document: dict[str, Any] = {"type": kind}
    for name in ("station_id", "reference_station_id"):
        if name in row and (name == "station_id" or name in _KEYS[kind]):
            document[name] = station_of(row[name], stations)
    names = [n for n in row if n not in OF_REPORT] if alone else [n for n in row if _key(n) in _KEYS[kind]]
    for name in names:
        if name in _TEXTS:
            document.setdefault(name, row[name])
            continue
        value = _number(name, row[name])
        key = _key(name)
        if key in document:
            raise ReportError(f"{name} and another column both give {key}; leave one of them out")
        if name == "azimuth_clockwise_deg":
            value = -value if value <= 180.0 else 360.0 - value
        elif name == "elevation_deg":
            value = 90.0 - value
        document[key] = value
    if kind in ("aoa", "path") and "zenith_deg" not in document and not alone:
        document.pop("zenith_stdev_deg", None)
    if kind == "path" and "azimuth_deg" not in document and not alone:
        document.pop("azimuth_stdev_deg", None)
    return document


def _key(name: str) -> str:
    return _OTHER_SIGN.get(name) or _OTHER_NAME.get(name) or name


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ReportError(f"{name} is {text!r}; give a number") from None


def _timestamp(row: Mapping[str, str]) -> str | None:
    """Time of a row as RFC 3339, whichever column has it."""
    if "timestamp" in row:
        text = row["timestamp"].strip()
        return text if _has_zone(text) else f"{text}Z"
    for name, per_second in _UNIX_TIMES.items():
        if name in row:
            try:
                # Exact: binary floats would be off by microseconds in our days.
                seconds = Fraction(row[name].strip()) / per_second
                moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=round(seconds * 1_000_000))
            except (ValueError, OverflowError, ZeroDivisionError):
                raise ReportError(f"{name} is {row[name]!r}; give a time since 1970 in this unit") from None
            return moment.isoformat().replace("+00:00", "Z")
    return None


def _has_zone(text: str) -> bool:
    return text[-1:] in "Zz" or text[-6:-5] in ("+", "-") or len(text) < 19
