"""The paper's method run online for a report: launch, select, fit, multiply, arg max."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.paper.algorithms import PaperSettings, algorithm_1, algorithm_2
from rayfix_evaluation.paper.mixtures import Mixture, arg_max, multiply
from rayfix_evaluation.paper.points import Launcher, RayPoints, draw_directions, points_on_rays
from rayfix_evaluation.paper.reports import sort_for_paper
from rayfix_service.fusion.measurements.directions import NO_DIRECTION, Direction
from rayfix_service.fusion.measurements.report import Report
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table


@dataclass(frozen=True, kw_only=True)
class PaperLocator:
    """Locates reports by the paper's method.

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
        """Create the method for a table's scene and stations."""
        return cls(launcher=Launcher.of_table(table), site=table.site, settings=settings or PaperSettings())

    def locate(self, report: Report, rng: np.random.Generator) -> NDArray[np.float64] | None:
        """Position of shape (3,), m, or None if no station's points agree with its measurements.

        Raises
        ------
        ReportError
            When the report has measurements that the paper's method does not support.
        """
        mixtures = self.mixtures(report, rng)
        if not mixtures:
            return None
        product = multiply(mixtures, self.settings.most_products)
        return arg_max(mixtures, product.mean)

    def mixtures(self, report: Report, rng: np.random.Generator) -> list[Mixture]:
        """Mixture over the position for each station's measurements."""
        sorted_report = sort_for_paper(report, self.site)
        directions, ranges = sorted_report.directions, sorted_report.ranges
        reference, differences = sorted_report.reference, sorted_report.differences
        names = sorted_report.names
        points = {name: self._points(name, directions.get(name, NO_DIRECTION), rng) for name in names}
        found: list[Mixture] = []
        related: list[str] = [reference, *differences] if reference is not None else []
        if reference is not None:
            related_points = [points[name] for name in differences]
            fitted = algorithm_2(points[reference], related_points, list(differences.values()), self.settings, rng)
            if fitted is None:
                related = []  # no lengths agree: use the angles only
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
