"""Joining the angles that Silicon Labs locators publish one by one, and turning them into reports."""

import logging
from collections.abc import Mapping
from datetime import UTC, datetime

from rayfix_service.adapters.adapted import Adapted, adapted_report, station_of
from rayfix_service.adapters.silabs import LEAST_STDEV_DEG, SilabsAngle, parse_silabs_angle, silabs_measurements
from rayfix_service.adapters.transmissions import Joiner, Transmission
from rayfix_service.fusion.measurements.report import Frame, Height
from rayfix_service.wire.names import MAX_NAME, in_log
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo

_log = logging.getLogger(__name__)

PAYLOAD_BYTES = 64 << 10
"""Default limit of a message, bytes; an angle has about a hundred."""

_MOST_PACKETS = 20_000
"""Largest number of packets that wait for locators, and of ended packets that are remembered; the oldest end early."""

_MOST_SOURCES = 1000
"""Largest number of locators that are remembered as logged, because a broker may have any number of topics."""


class SilabsStream:
    """Joins messages of topics that end in ``<locator>/<tag>`` into one report for each packet of a tag.

    A message that cannot be used is skipped and counted; the first one of each locator is logged. One that is
    delivered twice, as MQTT may with quality of service 1, is taken once.

    Parameters
    ----------
    site : SiteInfo
        A packet's report is complete when all of its stations have measured.
    window : float, s
        How long a packet waits for more locators.
    stations : Mapping, optional
        Stations by locator; a locator that is not in the map is itself a station's identifier.
    frame : {"lcs", "scene", "north"}
        Frame of the angles.
    least_stdev_deg : float, deg
        Smallest standard deviation that is used.
    height : Height, optional
        What is known of the height of all tags.
    payload_bytes : int
        Longest message that is read.

    Attributes
    ----------
    num_passed_over : int
        Messages that could not be used.
    """

    def __init__(
        self,
        site: SiteInfo,
        *,
        window: float,
        stations: Mapping[str, str] | None = None,
        frame: Frame = "lcs",
        least_stdev_deg: float = LEAST_STDEV_DEG,
        height: Height | None = None,
        payload_bytes: int = PAYLOAD_BYTES,
    ) -> None:
        self._site = site
        self._known = {station.id for station in site.stations}
        self._joiner: Joiner[tuple[datetime, SilabsAngle]] = Joiner(
            window=window, num_stations=len(self._known), repeats=_same_angle, most=_MOST_PACKETS
        )
        self._stations = stations
        self._frame: Frame = frame
        self._least_stdev_deg = least_stdev_deg
        self._height = height
        self._payload_bytes = payload_bytes
        self._told: set[str] = set()
        self.num_passed_over = 0

    @property
    def num_repeated(self) -> int:
        """Messages that were delivered twice."""
        return self._joiner.num_repeated

    def follow(self, site: SiteInfo) -> None:
        """Take messages of the stations of this site from now on."""
        if site is not self._site:
            self._site = site
            self._known = {station.id for station in site.stations}
            self._joiner.expect(len(self._known))

    def receive(self, topic: str, payload: bytes, now: float) -> list[Adapted]:
        """Process a message that arrived at `now`, s of any clock, and return the reports that it completes."""
        levels = topic.split("/")
        if len(levels) < 2 or not (levels[-2] and levels[-1]):
            self._log_skipped(
                topic, f"the topic '{in_log(topic)}' does not end in <locator>/<tag>; subscribe to others"
            )
            return []
        locator, tag = levels[-2:]
        if len(tag) > MAX_NAME:
            self._log_skipped(locator, f"the tag '{in_log(tag)}' has {len(tag)} characters; give it at most {MAX_NAME}")
            return []
        if len(payload) > self._payload_bytes:
            self._log_skipped(locator, f"the message has {len(payload)} bytes; an angle may have {self._payload_bytes}")
            return []
        station_id = station_of(locator, self._stations)
        if station_id not in self._known:
            self._log_skipped(
                locator, f"station '{in_log(station_id)}' is not in the table; name one, or map the locator to one"
            )
            return []
        try:
            angle = parse_silabs_angle(payload)
        except ReportError as error:
            self._log_skipped(locator, in_log(str(error), most=1000))
            return []
        moment = datetime.now(UTC)
        return self._reports(self._joiner.add(tag, station_id, angle.sequence, (moment, angle), now))

    def due(self, now: float) -> list[Adapted]:
        """Return the reports whose window has passed at `now`, s."""
        return self._reports(self._joiner.due(now))

    def _reports(self, transmissions: list[Transmission[tuple[datetime, SilabsAngle]]]) -> list[Adapted]:
        return [self._report(transmission) for transmission in transmissions]

    def _report(self, transmission: Transmission[tuple[datetime, SilabsAngle]]) -> Adapted:
        measurements = [
            ((station_id,), measurement)
            for station_id, (_, angle) in transmission.heard.items()
            for measurement in silabs_measurements(
                angle, station_id, frame=self._frame, least_stdev_deg=self._least_stdev_deg
            )
        ]
        first = min(moment for moment, _ in transmission.heard.values())
        timestamp = first.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        return adapted_report(
            list(measurements), [], target_id=transmission.target, timestamp=timestamp, height=self._height
        )

    def _log_skipped(self, source: str, text: str) -> None:
        self.num_passed_over += 1
        source = in_log(source)
        level = logging.DEBUG if source in self._told or len(self._told) >= _MOST_SOURCES else logging.WARNING
        if level == logging.WARNING:
            self._told.add(source)
        _log.log(level, "message of %s passed over: %s", source, text)


def _same_angle(before: tuple[datetime, SilabsAngle], after: tuple[datetime, SilabsAngle]) -> bool:
    """Whether an angle is the same message that its locator sent before."""
    return before[1] == after[1]
