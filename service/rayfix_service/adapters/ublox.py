"""From the ``+UUDF`` lines of u-blox direction-finding anchors (NINA-B4 with u-connectLocate) to reports."""

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from rayfix_service.adapters.adapted import Adapted, Skipped, adapted_report, station_of
from rayfix_service.adapters.transmissions import Joiner, Transmission
from rayfix_service.fusion.measurements.report import Angle
from rayfix_service.wire import MAX_REPORTS, FieldProblem, InvalidReportError
from rayfix_tables.angles import wrap_one
from rayfix_tables.problems import Path, shown

STDEV_DEG = 5.0
"""Anchors give no uncertainty; this is taken for the standard deviation of their angles."""

_PREFIX = "+UUDF:"

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
        Periodic advertising sequence number, the same for all anchors; older firmware does not give it.
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
    if not text.startswith(_PREFIX):
        raise _invalid(f"is {shown(text)}; give a line that begins with {_PREFIX}")
    try:
        fields = next(csv.reader([text.removeprefix(_PREFIX)], skipinitialspace=True))
    except csv.Error as error:
        raise _invalid(f"cannot be split into fields ({error}); give it as the anchor wrote it") from None
    if len(fields) not in (9, 10):
        raise _invalid(f"has {len(fields)} fields; give 9, or 10 with the sequence number")
    numbers: dict[int, int] = {}
    for index, name, low, high in _INTEGERS[: len(fields) - 3]:
        numbers[index] = int(fields[index]) if re.fullmatch("-?[0-9]{1,20}", fields[index]) else low - 1
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


def ublox_angle(event: UudfEvent, station_id: str, *, stdev_deg: float = STDEV_DEG) -> Angle:
    """Turn an event into an angle of the anchor's local frame, whose x axis is the boresight."""
    stdev = math.radians(stdev_deg)
    return Angle(
        station_id=station_id,
        azimuth=wrap_one(math.radians(-event.azimuth)),
        azimuth_stdev=stdev,
        zenith=math.radians(90 - event.elevation),
        zenith_stdev=stdev,
        frame="lcs",
    )


def parse_ublox(
    text: str | bytes, *, stations: Mapping[str, str] | None = None, stdev_deg: float = STDEV_DEG
) -> tuple[Adapted, ...]:
    """Turn the lines of several anchors into reports, one for each transmission of each tag.

    Lines with one sequence number belong together. Where there is none, an anchor that reports a tag again begins
    that tag's next report: anchors' clocks differ. In a line, what stands before ``+UUDF:`` is passed over, such as a
    log's time. Lines without it are passed over too, and counted in what the first report skips.

    Parameters
    ----------
    text : str or bytes
        Lines in UTF-8.
    stations : Mapping, optional
        Stations by anchor id; an anchor that it does not have is itself a station's identifier.
    stdev_deg : float, deg
        Standard deviation of the angles.

    Raises
    ------
    InvalidReportError
        For a line that is not valid, no such line at all, or too many reports.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8", errors="replace")
    joiner: Joiner[tuple[int, UudfEvent]] = Joiner(window=math.inf)
    joined: list[Transmission[tuple[int, UudfEvent]]] = []
    others: list[int] = []
    for number, line in enumerate(text.splitlines()):
        place = line.find(_PREFIX)
        if place < 0:
            if line.strip():
                others.append(number)
            continue
        try:
            event = parse_uudf(line[place:])
        except InvalidReportError as error:
            message = f"line {number + 1} {str(error).removeprefix('the line ')}"
            raise InvalidReportError((FieldProblem(path=("lines", number), message=message),)) from None
        joined += joiner.add(event.tag, event.anchor, event.sequence, (number, event), 0.0)
        if len(joined) + len(joiner) > MAX_REPORTS:
            text = f"the lines are more than {MAX_REPORTS} reports; give at most {MAX_REPORTS} at once"
            raise InvalidReportError((FieldProblem(path=(), message=text),))
    joined += joiner.flush()
    if not joined:
        raise InvalidReportError((FieldProblem(path=(), message=f"no line holds {_PREFIX}; give at least one"),))
    joined.sort(key=lambda transmission: min(number for number, _ in transmission.heard.values()))
    reports: list[Adapted] = []
    for transmission in joined:
        angles: list[tuple[Path, Angle]] = [
            (("lines", number), ublox_angle(event, station_of(event.anchor, stations), stdev_deg=stdev_deg))
            for number, event in transmission.heard.values()
        ]
        skipped = [] if reports else _passed_over(others)
        reports.append(adapted_report(list(angles), skipped, target_id=transmission.target, timestamp=None))
    return tuple(reports)


def _passed_over(lines: list[int]) -> list[Skipped]:
    """Tell of the lines that hold no event, at the first of them."""
    if not lines:
        return []
    more = len(lines) - 1
    others = f" and {more} more {'line holds' if more == 1 else 'lines hold'}" if more else " holds"
    return [Skipped(path=("lines", lines[0]), reason=f"this line{others} no {_PREFIX}")]


def _invalid(text: str) -> InvalidReportError:
    return InvalidReportError((FieldProblem(path=(), message=f"the line {text}"),))
