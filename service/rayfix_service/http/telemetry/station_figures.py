"""Figures by station: what became of its measurements, and how far they lie from the fixes."""

import math
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Histogram

from rayfix_service.fusion.diagnosis.residuals import Vector, angle_residual, range_residual
from rayfix_service.fusion.measurements.report import Angle, Measurement, Range, Report, TimeDifference
from rayfix_service.fusion.posterior.fix import Fix, Outcome
from rayfix_tables.site import SiteInfo

MOST_STATIONS = 200
"""Stations, of all tables that a process ever serves, with figures of their own; some 30 series each."""

OTHER = "other"
"""Table and station of the figures of all stations beyond :data:`MOST_STATIONS`."""

OUTCOMES = ("used", "outlier", "unused")
"""Outcomes of a measurement: used, used but more likely wrong than not, and not used."""

_DEGREES = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 45.0, 90.0)
_METERS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)


def outcome_name(outcome: Outcome) -> str:
    """Name the outcome of a measurement as the figures do."""
    return "unused" if not outcome.used else "outlier" if (outcome.outlier_probability or 0.0) > 0.5 else "used"


@dataclass(frozen=True, kw_only=True)
class _OneStation:
    """The figures of one station; to find them by their labels takes a lock for each."""

    outcomes: dict[str, Counter]
    outlier_probability: Counter
    angle: Histogram
    range: Histogram


class StationFigures:
    """Counts the measurements of fixes by their stations.

    Parameters
    ----------
    registry : CollectorRegistry
        To which the figures belong.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        labels = ("table", "station")
        self._outcomes = Counter(
            "rayfix_station_measurements",
            "Measurements of a station by what became of them; a time difference counts for both of its stations",
            (*labels, "outcome"),
            registry=registry,
        )
        self._outlier_probability = Counter(
            "rayfix_station_outlier_probability",
            "Sum of the outlier probabilities of a station's measurements, used and outlier",
            labels,
            registry=registry,
        )
        self._angle = Histogram(
            "rayfix_station_angle_residual_degrees",
            "Angle between a measured direction and the straight one to the fix, of fixes that are ok",
            labels,
            buckets=_DEGREES,
            registry=registry,
        )
        self._range = Histogram(
            "rayfix_station_range_residual_meters",
            "Difference of a measured path length and the distance to the fix, of fixes that are ok",
            labels,
            buckets=_METERS,
            registry=registry,
        )
        self._stations: dict[tuple[str, str], _OneStation] = {}
        self._other: _OneStation | None = None

    def add_table(self, table: str, site: SiteInfo) -> None:
        """Begin the figures of a table's stations at 0, so that a rate begins with the first measurement."""
        for station in site.stations:
            self._of(table, station.id)

    def count(self, table: str, site: SiteInfo, report: Report, fix: Fix) -> None:
        """Count the measurements of a report.

        Parameters
        ----------
        table : str
            Name of the table that answered.
        site : SiteInfo
            Of that table.
        report : Report
        fix : Fix
            Of that report.
        """
        position: Vector | None = None
        if fix.status == "ok" and fix.position is not None:
            x, y, z = fix.position.tolist()
            position = x, y, z
        for measurement, outcome in zip(report.measurements, fix.outcomes, strict=True):
            figures = self._of(table, measurement.station_id)
            _count_outcome(figures, outcome)
            if isinstance(measurement, TimeDifference):
                _count_outcome(self._of(table, measurement.reference_station_id), outcome)
            elif outcome.used and position is not None:
                _observe(figures, measurement, site, position)

    def _of(self, table: str, station: str) -> _OneStation:
        figures = self._stations.get((table, station))
        if figures is not None:
            return figures
        if len(self._stations) >= MOST_STATIONS:
            if self._other is None:
                self._other = self._labelled(OTHER, OTHER)
            return self._other
        figures = self._stations[table, station] = self._labelled(table, station)
        return figures

    def _labelled(self, table: str, station: str) -> _OneStation:
        return _OneStation(
            outcomes={outcome: self._outcomes.labels(table, station, outcome) for outcome in OUTCOMES},
            outlier_probability=self._outlier_probability.labels(table, station),
            angle=self._angle.labels(table, station),
            range=self._range.labels(table, station),
        )


def _count_outcome(figures: _OneStation, outcome: Outcome) -> None:
    figures.outcomes[outcome_name(outcome)].inc()
    if outcome.used and outcome.outlier_probability:
        figures.outlier_probability.inc(outcome.outlier_probability)


def _observe(figures: _OneStation, measurement: Measurement, site: SiteInfo, position: Vector) -> None:
    """Add the residual of a measurement that has one."""
    station = site.station_by_id[measurement.station_id]
    if isinstance(measurement, Angle):
        residual = angle_residual(measurement, station, site.north, position)
        if residual is not None:
            figures.angle.observe(math.degrees(residual))
    elif isinstance(measurement, Range):
        figures.range.observe(range_residual(measurement, station, position))
