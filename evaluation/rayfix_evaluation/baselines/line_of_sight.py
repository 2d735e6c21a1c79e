"""Classical positioning: weighted least squares as if every path were the line of sight.

Maximum likelihood under Gaussian errors, as in W. H. Foy, "Position-location solutions by Taylor-series estimation",
IEEE Transactions on Aerospace and Electronic Systems AES-12 (1976), which covers angles, ranges and time differences
alike; solved by a trust region within the scene (scipy.optimize) from the best points of a coarse grid, because ranges
and time differences have several minima.

The robust variant replaces the squares by Cauchy's loss log(1 + r^2), an M-estimator (P. J. Huber and E. M. Ronchetti,
"Robust Statistics", 2nd ed., 2009): measurements of reflected paths, many deviations off, then count little.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rayfix_evaluation.baselines.reports import sort_for_rivals, station_positions
from rayfix_evaluation.paper.reports import PaperReport
from rayfix_evaluation.paper.selection import RelativeLength
from rayfix_service.fusion.measurements.directions import Direction
from rayfix_service.fusion.measurements.report import Height, Report
from rayfix_tables.geometry.angles import angles_of, wrap
from rayfix_tables.site import SiteInfo

Array = NDArray[np.float64]

Kind = Literal["angles", "ranges", "differences"]
"""Measurements that are fitted: angles of arrival, propagation times, or differences of arrival times."""

_GRID = (12, 12, 5)  # points of the coarse grid along each axis
_STARTS = 4  # points of the grid where a search starts
_APART = 0.2  # of the scene's diagonal, smallest distance between these


@dataclass(frozen=True, kw_only=True)
class LineOfSight:
    """Least squares on straight paths.

    Attributes
    ----------
    site : SiteInfo
        Stations.
    bounds : ndarray of shape (2, 3), m
        Low and high corner of the region of possible positions.
    kinds : tuple of {"angles", "ranges", "differences"}
        Measurements that are fitted, with the height if the report has one. Times of arrival are used as differences
        because their clock is unknown.
    robust : bool
        Cauchy's loss instead of squares.
    """

    site: SiteInfo
    bounds: Array
    kinds: tuple[Kind, ...]
    robust: bool = False

    @property
    def name(self) -> str:
        """Name of the method in tables and figures."""
        return f"{'robust ' if self.robust else ''}line of sight, {' and '.join(self.kinds)}"

    def locate(self, report: Report) -> Array | None:
        """Position of shape (3,), m, or None with fewer than three equations.

        An angle of arrival is two equations, a range, a time difference and a height are one each.
        """
        terms = _terms(sort_for_rivals(report, self.site), report.height, self.site, self.kinds)
        if sum(term.size for term in terms) < 3:
            return None

        def residuals(point: Array) -> Array:
            return np.concatenate([term.residuals(point[None])[0] for term in terms])

        found = [
            least_squares(
                residuals,
                start,
                bounds=self.bounds,
                loss="cauchy" if self.robust else "linear",
                x_scale="jac",
                xtol=1e-10,
                ftol=1e-12,
                gtol=1e-12,
            )
            for start in _starts(terms, self.bounds, robust=self.robust)
        ]
        return np.asarray(min(found, key=lambda result: float(result.cost)).x)


class _Term(Protocol):
    """Equations of one kind."""

    @property
    def size(self) -> int:
        """Number of equations."""

    def residuals(self, points: Array) -> Array:
        """Whitened residuals at points of shape (n, 3), m; shape (n, size)."""


@dataclass(frozen=True, kw_only=True)
class _Angles:
    """Directions from stations, of shape (k, 3), m; ``whiten`` of shape (k, 2, 2)."""

    stations: Array
    azimuth: Array
    zenith: Array
    whiten: Array

    @classmethod
    def of(cls, directions: Sequence[Direction], stations: Array) -> "_Angles":
        angles = np.array([[d.azimuth, d.zenith] for d in directions], dtype=np.float64)
        cov = np.array([d.cov for d in directions])
        whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))
        return cls(stations=stations, azimuth=angles[:, 0], zenith=angles[:, 1], whiten=whiten)

    @property
    def size(self) -> int:
        return 2 * len(self.stations)

    def residuals(self, points: Array) -> Array:
        azimuth, zenith = angles_of(points[:, None] - self.stations)
        apart = np.stack([wrap(azimuth - self.azimuth), zenith - self.zenith], axis=-1)
        return np.asarray(np.einsum("kij,nkj->nki", self.whiten, apart).reshape(len(points), -1))


@dataclass(frozen=True, kw_only=True)
class _Ranges:
    """Lengths from stations, of shape (k, 3), m."""

    stations: Array
    length: Array
    stdev: Array

    @property
    def size(self) -> int:
        return len(self.stations)

    def residuals(self, points: Array) -> Array:
        return np.asarray((np.linalg.norm(points[:, None] - self.stations, axis=-1) - self.length) / self.stdev)


@dataclass(frozen=True, kw_only=True)
class _Differences:
    """Length differences of stations, of shape (k, 3), m, to a reference; ``whiten`` of shape (k, k)."""

    stations: Array
    reference: Array
    difference: Array
    whiten: Array

    @classmethod
    def of(cls, differences: Sequence[RelativeLength], stations: Array, reference: Array) -> "_Differences":
        """Split the variances: all differences share the reference's, half of that of the most accurate difference."""
        variance = np.square([d.stdev for d in differences])
        shared = 0.5 * variance.min()
        cov = np.diag(variance - shared) + shared
        return cls(
            stations=stations,
            reference=reference,
            difference=np.array([d.length_difference for d in differences]),
            whiten=np.asarray(np.linalg.inv(np.linalg.cholesky(cov))),
        )

    @property
    def size(self) -> int:
        return len(self.stations)

    def residuals(self, points: Array) -> Array:
        length = np.linalg.norm(points[:, None] - self.stations, axis=-1)
        to_reference = np.linalg.norm(points - self.reference, axis=-1)
        return np.asarray((length - to_reference[:, None] - self.difference) @ self.whiten.T)


@dataclass(frozen=True, kw_only=True)
class _Height:
    """A known height."""

    height: Height

    @property
    def size(self) -> int:
        return 1

    def residuals(self, points: Array) -> Array:
        return (points[:, 2:] - self.height.z) / self.height.stdev


def _terms(report: PaperReport, height: Height | None, site: SiteInfo, kinds: Sequence[Kind]) -> list[_Term]:
    """Equations of the kinds that are fitted; empty if only the height is known."""
    places = station_positions(site)
    terms: list[_Term] = []
    if "angles" in kinds and report.directions:
        stations = np.array([places[name] for name in report.directions])
        terms.append(_Angles.of(list(report.directions.values()), stations))
    if "ranges" in kinds and report.ranges:
        stations = np.array([places[name] for name in report.ranges])
        length, stdev = np.array(list(report.ranges.values())).T
        terms.append(_Ranges(stations=stations, length=length, stdev=stdev))
    if "differences" in kinds and report.reference is not None and report.differences:
        stations = np.array([places[name] for name in report.differences])
        terms.append(_Differences.of(list(report.differences.values()), stations, places[report.reference]))
    if height is not None:
        terms.append(_Height(height=height))
    return terms


def _starts(terms: Sequence[_Term], bounds: Array, *, robust: bool) -> list[Array]:
    """Points of a coarse grid with the least loss, at a distance from each other."""
    low, high = bounds
    axes = [low[i] + (np.arange(n) + 0.5) / n * (high[i] - low[i]) for i, n in enumerate(_GRID)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    squares = [np.square(term.residuals(grid)) for term in terms]
    cost = np.sum([(np.log1p(square) if robust else square).sum(axis=1) for square in squares], axis=0)
    apart = _APART * float(np.linalg.norm(high - low))
    starts: list[Array] = []
    for point in grid[np.argsort(cost, kind="stable")]:
        if all(np.linalg.norm(point - other) >= apart for other in starts):
            starts.append(point)
        if len(starts) == _STARTS:
            break
    return starts
