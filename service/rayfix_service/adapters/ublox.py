"""Conversion of ``+UUDF`` lines of u-blox direction-finding anchors (NINA-B4 with u-connectLocate) into reports."""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Annotated

from rayfix_service.adapters.adapted import Adapted, Skipped, adapted_report, station_of
from rayfix_service.adapters.transmissions import Joiner, Transmission
from rayfix_service.fusion.measurements.report import Angle, ErrorModel
from rayfix_service.wire import MAX_REPORTS, FieldProblem, InvalidReportError
from rayfix_tables.geometry.angles import wrap_one
from rayfix_tables.validation.limits import Limits, check_limits
from rayfix_tables.validation.problems import Path, shown

PREFIX = "+UUDF:"
"""What an event begins with."""

_TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:[.,]\d{1,9})?(?:Z|[+-]\d\d:?\d\d)?")
"""Time that a log writes before an event: ISO 8601, UTC unless it has a time zone."""

_INTEGER = re.compile("-?[0-9]{1,20}")

_LONGEST_MS = 24 * 3600 * 1000
"""Lines are at most a day older than the last one of their message; a larger difference is an anchor's restart."""

_LISTED = 20
"""Largest number of unreadable lines that are listed; further ones are only counted."""


@dataclass(frozen=True, kw_only=True)
class AngleErrors:
    """Errors of anchors' angles, which the anchors do not report.

    The defaults are cautious values for Bluetooth angles indoors, whose errors are far wider than the noise of packets:
    four of five have a standard deviation of 10 deg, one in five has three times that.

    Attributes
    ----------
    stdev_deg : float, deg
        Standard deviation of azimuth and elevation.
    tail_share : float
        Probability that the error is of the wider Gaussian.
    tail_scale : float
        Standard deviation of the wider Gaussian divided by that of the narrower one.

    Raises
    ------
    SettingsError
        When a value is out of its range.
    """

    stdev_deg: Annotated[float, Limits(least=1e-3, most=180.0)] = 10.0
    tail_share: Annotated[float, Limits(least=0.0, below=1.0)] = 0.2
    tail_scale: Annotated[float, Limits(least=1.0, most=100.0)] = 3.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_limits(self)


USUAL_ERRORS = AngleErrors()

_INTEGERS = (
    (1, "rssi_pol1", -1000, 1000),
    (2, "angle_azimuth", -90, 90),
    (3, "angle_elevation", -90, 90),
    (4, "rssi_pol2", -1000, 1000),
    (5, "channel", 0, 39),
    (8, "timestamp_ms", 0, 2**64),
    (9, "sequence number", 0, 2**32),
)


@dataclass(frozen=True, kw_only=True)
class UudfEvent:
    """An angle calculation event.

    Attributes
    ----------
    tag : str
        Eddystone instance id of the tag.
    rssi : int, dBm
        Of the first polarisation.
    azimuth, elevation : int, deg
        From the anchor's boresight: positive to the right as the anchor sees it, and upwards.
    channel : int
        Bluetooth channel.
    anchor : str
    timestamp_ms : int
        Time since the anchor booted; clocks of anchors differ.
    sequence : int or None
        Periodic advertising sequence number, the same for all anchors; None from older firmware.
    """

    tag: str
    rssi: int
    azimuth: int
    elevation: int
    channel: int
    anchor: str
    timestamp_ms: int
    sequence: int | None


def parse_uudf(line: str) -> UudfEvent:
    """Read one line.

    The fields are those of the u-blox XPLR-AOA user guide, UBX-21004616, in its order: instance id, RSSI, azimuth,
    elevation, RSSI of the second polarisation (reserved), channel, anchor, user's text, milliseconds, and from
    later firmware on the sequence number.

    Raises
    ------
    InvalidReportError
        For anything else.
    """
    text = line.strip()
    if not text.startswith(PREFIX):
        raise _invalid(f"is {shown(text)}; give a line that begins with {PREFIX}")
    try:
        fields = next(csv.reader([text.removeprefix(PREFIX)], skipinitialspace=True))
    except csv.Error as error:
        raise _invalid(f"cannot be split into fields ({error}); give it as the anchor wrote it") from None
    if len(fields) not in (9, 10):
        raise _invalid(f"has {len(fields)} fields; give 9, or 10 with the sequence number")
    numbers: dict[int, int] = {}
    for index, name, low, high in _INTEGERS[: len(fields) - 3]:
        numbers[index] = int(fields[index]) if _INTEGER.fullmatch(fields[index]) else low - 1
        if not low <= numbers[index] <= high:
            raise _invalid(f"has {name} {shown(fields[index])}; give an integer from {low} to {high}")
    for index, name in ((0, "instance id"), (6, "anchor id")):
        if not 0 < len(fields[index]) <= 128:
            raise _invalid(f"has {name} {shown(fields[index])}; give 1 to 128 characters")
    return UudfEvent(
        tag=fields[0],
        rssi=numbers[1],
        azimuth=numbers[2],
        elevation=numbers[3],
        channel=numbers[5],
        anchor=fields[6],
        timestamp_ms=numbers[8],
        sequence=numbers.get(9),
    )


def ublox_angle(event: UudfEvent, station_id: str, *, errors: AngleErrors = USUAL_ERRORS) -> Angle:
    """Convert an event into an angle in the anchor's local frame, where the boresight is the x axis."""
    stdev = math.radians(errors.stdev_deg)
    return Angle(
        station_id=station_id,
        azimuth=wrap_one(math.radians(-event.azimuth)),
        azimuth_stdev=stdev,
        zenith=math.radians(90 - event.elevation),
        zenith_stdev=stdev,
        frame="lcs",
        error_model=ErrorModel(tail_share=errors.tail_share, tail_scale=errors.tail_scale),
    )


@dataclass(frozen=True, kw_only=True)
class _Line:
    """An event, its line number, and the time before it in the line."""

    number: int
    event: UudfEvent
    logged: datetime | None


def parse_ublox(
    text: str | bytes,
    *,
    stations: Mapping[str, str] | None = None,
    errors: AngleErrors = USUAL_ERRORS,
    received: datetime | None = None,
) -> tuple[Adapted, ...]:
    """Turn the lines of several anchors into reports, one for each transmission of each tag.

    Lines with the same sequence number belong together. Without sequence numbers, a tag's next report begins when an
    anchor reports the tag again, because anchors' clocks differ. Text before ``+UUDF:`` in a line is ignored, except
    for a log's time. A line without a valid event is left out; the first report lists it as skipped.

    A report's time is that of its first line in the log. If lines have no time, it is counted back from ``received``,
    the time of the last line, by the anchors' clocks. Without ``received``, the report has no time.

    Parameters
    ----------
    text : str or bytes
        Lines in UTF-8.
    stations : Mapping, optional
        Stations by anchor id; an anchor that is not in the map is itself a station's identifier.
    errors : AngleErrors, optional
    received : datetime, optional
        When the lines were received, with a time zone.

    Raises
    ------
    InvalidReportError
        When no line has a valid event, or for too many reports.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8", errors="replace")
    joiner: Joiner[_Line] = Joiner(window=math.inf)
    joined: list[Transmission[_Line]] = []
    others: list[int] = []
    faulty: list[FieldProblem] = []
    latest: dict[str, int] = {}
    for number, line in enumerate(text.splitlines()):
        place = line.find(PREFIX)
        if place < 0:
            if line.strip():
                others.append(number)
            continue
        try:
            event = parse_uudf(line[place:])
        except InvalidReportError as error:
            message = f"line {number + 1} {str(error).removeprefix('the line ')}"
            faulty.append(FieldProblem(path=("lines", number), message=message))
            continue
        latest[event.anchor] = event.timestamp_ms
        found = _Line(number=number, event=event, logged=logged_time(line[:place]))
        joined += joiner.add(event.tag, event.anchor, event.sequence, found, 0.0)
        if len(joined) + len(joiner) > MAX_REPORTS:
            text = f"the lines are more than {MAX_REPORTS} reports; give at most {MAX_REPORTS} at once"
            raise InvalidReportError((FieldProblem(path=(), message=text),))
    joined += joiner.flush()
    if not joined:
        empty = FieldProblem(path=(), message=f"no line holds {PREFIX}; give at least one")
        raise InvalidReportError(tuple(faulty[:_LISTED]) or (empty,), max(0, len(faulty) - _LISTED))
    joined.sort(key=lambda transmission: min(line.number for line in transmission.heard.values()))
    reports: list[Adapted] = []
    for transmission in joined:
        lines = list(transmission.heard.values())
        angles: list[tuple[Path, Angle]] = [
            (("lines", line.number), ublox_angle(line.event, station_of(line.event.anchor, stations), errors=errors))
            for line in lines
        ]
        skipped = [] if reports else [*_not_valid(faulty), *_without_event(others)]
        timestamp = _time_of(lines, latest, received)
        reports.append(adapted_report(list(angles), skipped, target_id=transmission.target, timestamp=timestamp))
    return tuple(reports)


def logged_time(before: str) -> datetime | None:
    """Read the time that a log writes before an event; of several, the last one."""
    found = _TIME.findall(before)
    if not found:
        return None
    try:
        moment = datetime.fromisoformat(found[-1].replace(",", "."))
    except ValueError:
        return None
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)


def _time_of(lines: Sequence[_Line], latest: Mapping[str, int], received: datetime | None) -> str | None:
    """Return the time of a transmission, RFC 3339, or None if it is unknown.

    An anchor that restarted between its lines counts from zero again: of the earlier ones the age is unknown.

    Parameters
    ----------
    lines : sequence of _Line
        Of the transmission.
    latest : Mapping
        Time of each anchor's last line, in milliseconds since that anchor started.
    received : datetime or None
        When the last line was received.
    """
    logged = [line.logged for line in lines if line.logged is not None]
    if logged:
        return min(logged).isoformat()
    if received is None:
        return None
    ages = [latest[line.event.anchor] - line.event.timestamp_ms for line in lines]
    known = [age for age in ages if 0 <= age <= _LONGEST_MS]
    return (received - timedelta(milliseconds=max(known))).isoformat() if known else None


def _not_valid(faulty: Sequence[FieldProblem]) -> list[Skipped]:
    """List the lines whose events are not valid; many are counted at the last one listed."""
    skipped = [Skipped(path=problem.path, reason=f"left out: {problem.message}") for problem in faulty[:_LISTED]]
    if more := len(faulty) - len(skipped):
        skipped.append(
            Skipped(path=faulty[_LISTED].path, reason=f"this and {more - 1} later lines are not valid either")
        )
    return skipped


def _without_event(lines: Sequence[int]) -> list[Skipped]:
    """Count the lines that hold no event, at the first of them."""
    if not lines:
        return []
    more = len(lines) - 1
    others = f" and {more} more {'line holds' if more == 1 else 'lines hold'}" if more else " holds"
    return [Skipped(path=("lines", lines[0]), reason=f"this line{others} no {PREFIX}")]


def _invalid(text: str) -> InvalidReportError:
    return InvalidReportError((FieldProblem(path=(), message=f"the line {text}"),))
