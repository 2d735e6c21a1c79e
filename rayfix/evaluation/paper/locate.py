"""A report located by the paper's method as it would run online: launch, select, fit, multiply, arg max."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix.evaluation.paper.algorithms import PaperSettings, algorithm_1, algorithm_2
from rayfix.evaluation.paper.mixtures import Mixture, arg_max, multiply
from rayfix.evaluation.paper.points import Launcher, RayPoints, draw_directions, points_on_rays
from rayfix.evaluation.paper.selection import RelativeLength
from rayfix_service.fusion.directions import to_scene
from rayfix_service.fusion.lookup import NO_DIRECTION, Direction
from rayfix_service.fusion.report import Angle, Range, Report, TimeDifference, TimeOfArrival
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table


@dataclass(frozen=True, kw_only=True)
class PaperLocator:
    """Answers reports by the paper's method.

    Attributes
    ----------
    launcher : Launcher
    site : SiteInfo
        Stations.
    settings : PaperSettings
    """

    launcher: Launcher
    site: SiteInfo
    settings: PaperSettings

    @classmethod
    def of_table(cls, table: Table, settings: PaperSettings | None = None) -> "PaperLocator":
        """Locate in the scene and among the stations of a table."""
        return cls(launcher=Launcher.of_table(table), site=table.site, settings=settings or PaperSettings())

    def locate(self, report: Report, rng: np.random.Generator) -> NDArray[np.float64] | None:
        """Position of shape (3,), m, or None where no station's points agree with its measurements.

        Raises
        ------
        ReportError
            When the time differences do not share one reference, or a measurement is not the paper's.
        """
        mixtures = self.mixtures(report, rng)
        if not mixtures:
            return None
        product = multiply(mixtures, self.settings.most_products)
        return arg_max(mixtures, product.mean)

    def mixtures(self, report: Report, rng: np.random.Generator) -> list[Mixture]:
        """Mixture over the position that each station's measurements give."""
        directions, ranges, (reference, differences) = _sorted(report, self.site)
        names = list(dict.fromkeys([*directions, *ranges, *([reference] if reference else []), *differences]))
        points = {name: self._points(name, directions.get(name, NO_DIRECTION), rng) for name in names}
        found: list[Mixture] = []
        related: list[str] = [reference, *differences] if reference is not None else []
        if reference is not None:
            related_points = [points[name] for name in differences]
            fitted = algorithm_2(points[reference], related_points, list(differences.values()), self.settings, rng)
            if fitted is None:
                related = []  # no lengths agree: what angles say is left
            else:
                found.extend(fitted)
        for name in names:
            if name in related and name not in ranges:
                continue
            mixture = algorithm_1(points[name], ranges.get(name), self.settings, rng)
            if mixture is not None:
                found.append(mixture)
        return found

    def _points(self, name: str, measured: Direction, rng: np.random.Generator) -> RayPoints:
        settings = self.settings
        count = settings.num_isotropic_rays if measured is NO_DIRECTION else settings.num_rays
        (station,) = [s for s in self.site.stations if s.id == name]
        directions = draw_directions(measured, count, rng)
        return points_on_rays(self.launcher, np.array(station.position), directions, step=settings.step, rng=rng)


def _sorted(
    report: Report, site: SiteInfo
) -> tuple[dict[str, Direction], dict[str, tuple[float, float]], tuple[str | None, Mapping[str, RelativeLength]]]:
    """Directions, ranges and relative lengths of a report by station; the last with their reference."""
    stations = {station.id: station for station in site.stations}
    directions: dict[str, Direction] = {}
    ranges: dict[str, tuple[float, float]] = {}
    arrivals: dict[str, tuple[float, float]] = {}
    differences: dict[str, RelativeLength] = {}
    references: set[str] = set()
    for measurement in report.measurements:
        name = measurement.station_id
        if isinstance(measurement, Angle):
            directions[name] = to_scene(measurement, stations[name], site.north)
            if directions[name].tilt is not None:
                raise ReportError("the paper's method knows no azimuth in a tilted frame", path=("measurements",))
        elif isinstance(measurement, Range):
            ranges[name] = (measurement.path_length, measurement.stdev)
        elif isinstance(measurement, TimeOfArrival):
            arrivals[name] = (measurement.path_length, measurement.stdev)
        elif isinstance(measurement, TimeDifference):
            references.add(measurement.reference_station_id)
            differences[name] = RelativeLength(length_difference=measurement.length_difference, stdev=measurement.stdev)
        else:
            raise ReportError(f"the paper's method knows no {type(measurement).__name__}", path=("measurements",))
    if len(arrivals) > 1:
        first, (start, start_stdev) = next(iter(arrivals.items()))
        references.add(first)
        for name, (length, stdev) in arrivals.items():
            if name != first:
                both = float(np.hypot(stdev, start_stdev))
                differences[name] = RelativeLength(length_difference=length - start, stdev=both)
    if len(references) > 1:
        raise ReportError(
            f"the paper's method takes time differences to one reference, not to {', '.join(sorted(references))}",
            path=("measurements",),
        )
    return directions, ranges, (next(iter(references), None), differences)
