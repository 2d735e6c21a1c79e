"""The paper's predecessor in two dimensions: intersections of noisy rays with the plane of the known height.

V. Corlay, V.-H. Nguyen, N. Gresset, "Probabilistic positioning via ray tracing with noisy angle of arrival
measurements", IEEE Communications Letters 28 (2024), arXiv:2403.00611, after arXiv:2308.08441: rays are launched around
each measured angle, a Gaussian mixture is fitted to the points where they cross the horizontal plane of the
transmitter, and the mixtures of the stations are multiplied. Angles alone are used.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.baselines.reports import sort_for_rivals, station_positions
from rayfix_evaluation.paper.algorithms import PaperSettings
from rayfix_evaluation.paper.mixtures import Mixture, arg_max, fit_mixture, multiply
from rayfix_evaluation.paper.points import Launcher, draw_directions
from rayfix_service.fusion.measurements.report import Report
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PlanarPredecessor:
    """Plane crossings, 2D mixtures, their product.

    Attributes
    ----------
    launcher : Launcher
    site : SiteInfo
        Stations.
    height : float or None, m
        z of the transmitter if a report does not state it.
    settings : PaperSettings
        The numbers of rays, points, components and products are used.
    seed : int
        Seed of the draws, which are the same for each report.
    """

    launcher: Launcher
    site: SiteInfo
    height: float | None = None
    settings: PaperSettings = field(default_factory=PaperSettings)
    seed: int = 1
    name: str = "2D predecessor"

    @classmethod
    def of_table(cls, table: Table, *, height: float | None = None, seed: int = 1) -> "PlanarPredecessor":
        """Create the method for a table's scene and stations."""
        return cls(launcher=Launcher.of_table(table), site=table.site, height=height, seed=seed)

    def locate(self, report: Report) -> Array | None:
        """Position of shape (3,), m, or None if no height is known or no ray crosses its plane."""
        height = self.height if report.height is None else report.height.z
        if height is None:
            return None
        mixtures = self.mixtures(report, height)
        if not mixtures:
            return None
        x, y = arg_max(mixtures, multiply(mixtures, self.settings.most_products).mean)
        return np.array([x, y, height])

    def mixtures(self, report: Report, height: float) -> list[Mixture]:
        """Mixture over (x, y), m, for each station's angle at a height, m.

        Stations with fewer than two rays that cross the plane have none.
        """
        rng = np.random.default_rng(self.seed)
        places = station_positions(self.site)
        found = []
        for name, measured in sort_for_rivals(report, self.site).directions.items():
            directions = draw_directions(measured, self.settings.num_rays, rng)
            points = plane_crossings(self.launcher, places[name], directions, height)
            seed = int(rng.integers(2**31))
            if len(points) > self.settings.num_points:
                points = points[rng.choice(len(points), self.settings.num_points, replace=False)]
            if len(points) > 1:
                found.append(fit_mixture(points, self.settings.num_components, seed))
        return found


def plane_crossings(launcher: Launcher, station: Array, directions: Array, height: float) -> Array:
    """Intersections of reflected rays with a horizontal plane.

    Parameters
    ----------
    station : ndarray of shape (3,), m
    directions : ndarray of shape (n_rays, 3)
        Unit vectors.
    height : float, m
        z of the plane.

    Returns
    -------
    ndarray of shape (n_points, 2), m
        x and y of each crossing; a ray has one for each of its straight segments that crosses the plane.
    """
    segments = launcher.trace(station, directions)
    ray, sequence = segments.ray, segments.sequence
    image = segments.sequences.images[sequence]
    heading = np.einsum("nij,nj->ni", segments.sequences.mirrors[sequence], directions[ray])
    with np.errstate(divide="ignore", invalid="ignore"):
        length = (height - image[:, 2]) / heading[:, 2]
    # A segment within the plane has no crossing: its length is infinite or not a number.
    crosses = (length >= segments.start) & (length < segments.end)
    return np.asarray((image + np.where(crosses, length, 0.0)[:, None] * heading)[crosses, :2])
