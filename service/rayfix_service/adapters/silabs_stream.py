"""Joining the angles that Silicon Labs locators publish one by one, and turning them into reports."""

import logging
from collections.abc import Mapping
from datetime import UTC, datetime

from rayfix_service.adapters.adapted import Adapted, adapted_report, station_of
from rayfix_service.adapters.silabs import LEAST_STDEV_DEG, SilabsAngle, parse_silabs_angle, silabs_measurements
from rayfix_service.adapters.transmissions import Joiner, Transmission
from rayfix_service.fusion.measurements.report import Frame, Height
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo

_log = logging.getLogger(__name__)


class SilabsStream:
    """Takes messages of topics that end in ``<locator>/<tag>``, and gives a report for each packet of a tag.

    A message that cannot be used is passed over; the log tells of the first of each locator.

    Parameters
    ----------
    site : SiteInfo
        Its stations are those that may be heard of; when all have been, a packet's report is complete.
    window : float, s
        How long a packet waits for more locators.
    stations : Mapping, optional
        Stations by locator; a locator that it does not have is itself a station's identifier.
    frame : {"lcs", "scene", "north"}
        Frame of the angles.
    least_stdev_deg : float, deg
        Least standard deviation to believe.
    height : Height, optional
        What is known of the height of all tags.
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
    ) -> None:
        self._known = {station.id for station in site.stations}
        self._joiner: Joiner[tuple[datetime, SilabsAngle]] = Joiner(window=window, num_stations=len(self._known))
        self._stations = stations
        self._frame: Frame = frame
        self._least_stdev_deg = least_stdev_deg
        self._height = height
        self._told: set[str] = set()

    def receive(self, topic: str, payload: bytes, now: float) -> list[Adapted]:
        """Take a message that arrived at `now`, s of any clock; returns the reports that it completes."""
        levels = topic.split("/")
        if len(levels) < 2 or not (levels[-2] and levels[-1]):
            self._tell(topic, f"the topic '{topic}' does not end in <locator>/<tag>; subscribe to others")
            return []
        locator, tag = levels[-2:]
        station_id = station_of(locator, self._stations)
        if station_id not in self._known:
            self._tell(locator, f"station '{station_id}' is not in the table; name one, or say which one is meant")
            return []
        try:
            angle = parse_silabs_angle(payload)
        except ReportError as error:
            self._tell(locator, str(error))
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

    def _tell(self, source: str, text: str) -> None:
        level = logging.DEBUG if source in self._told else logging.WARNING
        # A broker may have topics without end.
        if len(self._told) < 1000:
            self._told.add(source)
        _log.log(level, "message of %s passed over: %s", source, text)
