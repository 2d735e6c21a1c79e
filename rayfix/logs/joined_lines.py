"""Logs of one line for each station: u-blox anchors, and Silicon Labs locators as an MQTT client writes them."""

import heapq
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Generic, TypeVar

from rayfix.logs.entries import Entry, Place, Problem
from rayfix.logs.files import LONGEST, LogFile
from rayfix_service.adapters.adapted import adapted_report, station_of
from rayfix_service.adapters.silabs import SilabsAngle, parse_silabs_angle, silabs_measurements
from rayfix_service.adapters.transmissions import Joiner, Transmission
from rayfix_service.adapters.ublox import PREFIX, AngleErrors, UudfEvent, logged_time, parse_uudf, ublox_angle
from rayfix_service.fusion.measurements.report import Frame, Measurement
from rayfix_service.wire import MAX_REPORTS, InvalidReportError
from rayfix_tables.errors import ReportError

T = TypeVar("T")

_WINDOW = 1000
"""Lines that a transmission waits for more stations."""

_TOPIC = re.compile(
    r"^(?:(?P<time>\S+(?: \S+)?)\s+)?(?P<topic>\S+)/(?P<locator>[^/\s]+)/(?P<tag>[^/\s]+)\s+(?P<payload>\{.*)$"
)
"""A line of ``mosquitto_sub -F '%U %t %p'`` or ``-v``."""


@dataclass(frozen=True, kw_only=True)
class _Heard(Generic[T]):
    """A line: its number, what it says, and when."""

    number: int
    message: T
    time: datetime | None


@dataclass(frozen=True, kw_only=True)
class _Line(Generic[T]):
    """What a line says, and who measured whom."""

    target: str
    station: str
    sequence: int | None
    message: T
    time: datetime | None


def ublox_entries(log: LogFile, *, stations: Mapping[str, str], errors: AngleErrors) -> Iterator[Entry | Problem]:
    """Give a report for each transmission in the ``+UUDF`` lines of anchors, by the order of their first lines."""

    def read(line: str) -> _Line[UudfEvent]:
        place = line.find(PREFIX)
        if place < 0:
            raise ReportError(f"the line holds no {PREFIX}")
        event = parse_uudf(line[place:])
        time = logged_time(line[:place])
        return _Line(target=event.tag, station=event.anchor, sequence=event.sequence, message=event, time=time)

    def convert(anchor: str, event: UudfEvent) -> list[Measurement]:
        return [ublox_angle(event, station_of(anchor, stations), errors=errors)]

    yield from _joined(log, read, convert)


def silabs_topic_entries(
    log: LogFile, *, stations: Mapping[str, str], frame: Frame = "lcs"
) -> Iterator[Entry | Problem]:
    """Give a report for each packet in the messages of locators, each in a line with its topic."""

    def read(line: str) -> _Line[SilabsAngle]:
        found = _TOPIC.match(line)
        if found is None:
            raise ReportError("the line is no time (or none), topic that ends in LOCATOR/TAG, and JSON object")
        angle = parse_silabs_angle(found["payload"].encode())
        return _Line(
            target=found["tag"],
            station=found["locator"],
            sequence=angle.sequence,
            message=angle,
            time=_time_of(found["time"]),
        )

    def convert(locator: str, angle: SilabsAngle) -> list[Measurement]:
        return list(silabs_measurements(angle, station_of(locator, stations), frame=frame))

    yield from _joined(log, read, convert)


def has_topics(log: LogFile) -> bool:
    """Whether the first line of a log has a topic before its JSON."""
    lines = log.head().decode("utf-8", "replace").split("\n", 1)
    return bool(lines) and _TOPIC.match(lines[0].strip()) is not None


def _time_of(text: str | None) -> datetime | None:
    """Read the time before a topic: seconds since 1970, or ISO 8601."""
    if text is None:
        return None
    try:
        if re.fullmatch(r"\d{9,11}(\.\d+)?", text):
            return datetime.fromtimestamp(float(text), UTC)
    except (OverflowError, ValueError):
        return None
    return logged_time(text)


def _joined(
    log: LogFile,
    read: Callable[[str], _Line[T]],
    convert: Callable[[str, T], list[Measurement]],
) -> Iterator[Entry | Problem]:
    joiner: Joiner[_Heard[T]] = Joiner(window=_WINDOW, most=MAX_REPORTS)
    waiting: list[tuple[int, int, Transmission[_Heard[T]]]] = []  # a heap by first line
    count = 0

    def ended(transmissions: list[Transmission[_Heard[T]]]) -> None:
        nonlocal count
        for transmission in transmissions:
            count += 1
            first = min(heard.number for heard in transmission.heard.values())
            heapq.heappush(waiting, (first, count, transmission))

    def report(first: int, transmission: Transmission[_Heard[T]]) -> Entry | Problem:
        place = Place(log.name, first)
        heard = transmission.heard
        times = [each.time for each in heard.values() if each.time is not None]
        found = [
            (("lines", each.number), measurement)
            for station, each in heard.items()
            for measurement in convert(station, each.message)
        ]
        try:
            adapted = adapted_report(
                list(found), [], target_id=transmission.target, timestamp=min(times).isoformat() if times else None
            )
        except InvalidReportError as error:
            return Problem(place=place, text=str(error))
        return Entry(place=place, report=adapted.report)

    number = 0
    for number, raw in log.lines():
        text = raw.decode("utf-8", "replace").strip()
        if not text:
            continue
        try:
            if len(raw) > LONGEST:
                raise ReportError(f"the line has more than {LONGEST} bytes")
            line = read(text)
        except ReportError as error:
            yield Problem(place=Place(log.name, number), text=str(error))
            continue
        heard = _Heard(number=number, message=line.message, time=line.time)
        ended(joiner.add(line.target, line.station, line.sequence, heard, float(number)))
        # Those that began earlier have all ended: targets are followed in the order of their packets.
        while waiting and waiting[0][0] < number - _WINDOW:
            first, _, transmission = heapq.heappop(waiting)
            yield report(first, transmission)
    ended(joiner.flush())
    while waiting:
        first, _, transmission = heapq.heappop(waiting)
        yield report(first, transmission)
