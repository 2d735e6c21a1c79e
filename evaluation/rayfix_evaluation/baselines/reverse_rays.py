"""Reverse ray tracing without noise: the point nearest to rays in the measured directions.

One ray per station is launched in the measured direction and reflected at the walls. The transmitter is assumed where
the rays meet, as in S. Kikuchi, A. Sano, H. Tsuji, "Blind mobile positioning in urban environment based on ray-tracing
analysis", EURASIP Journal on Applied Signal Processing 2006, 038989. The search includes the choice of each ray's
straight segment. Angles are taken as exact; times and heights are ignored.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.baselines.reports import sort_for_rivals, station_positions
from rayfix_evaluation.paper.points import Launcher
from rayfix_service.fusion.measurements.directions import Direction
from rayfix_service.fusion.measurements.report import Report
from rayfix_tables.geometry.angles import direction
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

Array = NDArray[np.float64]

_SEEDS = 8  # crossings of two rays where the search starts
_MOST_STEPS = 30
_PARALLEL = 1e-9  # smallest squared sine of the angle between lines that are not treated as parallel


@dataclass(frozen=True, kw_only=True)
class Polyline:
    """Straight segments of one ray.

    Attributes
    ----------
    start : ndarray of shape (n_pieces, 3), m
    heading : ndarray of shape (n_pieces, 3)
        Unit vectors.
    length : ndarray of shape (n_pieces,), m
    """

    start: Array
    heading: Array
    length: Array

    def nearest(self, points: Array) -> tuple[Array, Array, Array]:
        """Nearest segment to each point of shape (n, 3), m.

        Returns
        -------
        foot : ndarray of shape (n, 3), m
            Nearest point of the ray.
        heading : ndarray of shape (n, 3)
            Of the segment; zero if the foot is one of its ends.
        distance : ndarray of shape (n,), m
        """
        along = np.einsum("npi,pi->np", points[:, None] - self.start, self.heading)
        clamped = np.clip(along, 0.0, self.length)
        feet = self.start + clamped[..., None] * self.heading
        distance = np.linalg.norm(points[:, None] - feet, axis=-1)
        piece = np.argmin(distance, axis=1)
        row = np.arange(len(points))
        inside = along[row, piece] == clamped[row, piece]
        return feet[row, piece], np.where(inside[:, None], self.heading[piece], 0.0), distance[row, piece]


@dataclass(frozen=True, kw_only=True)
class ReverseRays:
    """The point with the least mean square distance from one reflected ray of each station.

    Attributes
    ----------
    launcher : Launcher
    site : SiteInfo
        Stations.
    """

    launcher: Launcher
    site: SiteInfo
    name: str = "reverse rays"

    @classmethod
    def of_table(cls, table: Table) -> "ReverseRays":
        """Locate in the scene and among the stations of a table."""
        return cls(launcher=Launcher.of_table(table), site=table.site)

    def locate(self, report: Report) -> Array | None:
        """Position of shape (3,), m, or None with angles of fewer than two stations."""
        directions = sort_for_rivals(report, self.site).directions
        if len(directions) < 2:
            return None
        places = station_positions(self.site)
        return meeting_point([self._ray(places[name], measured) for name, measured in directions.items()])

    def _ray(self, station: Array, measured: Direction) -> Polyline:
        azimuth, zenith = measured.azimuth, measured.zenith
        assert azimuth is not None  # reports without it were refused
        assert zenith is not None
        heading = direction(azimuth, zenith)
        segments = self.launcher.trace(station, heading[None])
        sequence = segments.sequence
        headings = segments.sequences.mirrors[sequence] @ heading
        start = segments.start
        return Polyline(
            start=segments.sequences.images[sequence] + start[:, None] * headings,
            heading=headings,
            length=np.maximum(segments.end - start, 0.0),
        )


def meeting_point(rays: list[Polyline]) -> Array:
    """Point with the least sum of squared distances from rays, shape (3,), m.

    Parameters
    ----------
    rays : list of Polyline
        At least two.

    Notes
    -----
    The sum has many minima, because each ray has several segments. The search starts at the crossings of two rays with
    the least sums. It solves for the point nearest to the lines of the nearest segments, and repeats this until the
    segments do not change.
    """
    seeds = np.concatenate(
        [_crossings(rays[i], rays[j]) for i in range(len(rays)) for j in range(i + 1, len(rays))], axis=0
    )
    cost = _cost(rays, seeds)
    best = np.argsort(cost, kind="stable")[:_SEEDS]
    points = seeds[best]
    costs = cost[best]
    moving = points
    for _ in range(_MOST_STEPS):
        moving = _nearest_to_lines(rays, moving)
        cost = _cost(rays, moving)
        better = cost < costs - 1e-15
        if not better.any():
            break
        points = np.where(better[:, None], moving, points)
        costs = np.where(better, cost, costs)
    return np.asarray(points[np.argmin(costs)])


def _cost(rays: list[Polyline], points: Array) -> Array:
    return np.asarray(np.sum([np.square(ray.nearest(points)[2]) for ray in rays], axis=0))


def _nearest_to_lines(rays: list[Polyline], points: Array) -> Array:
    """Points nearest to the lines, or at ends to the end points, of the segments nearest to points of shape (n, 3)."""
    matrix = np.zeros((len(points), 3, 3))
    target = np.zeros((len(points), 3))
    for ray in rays:
        foot, heading, _ = ray.nearest(points)
        across = np.eye(3) - heading[:, :, None] * heading[:, None, :]
        matrix += across
        target += np.einsum("nij,nj->ni", across, foot)
    determined = np.linalg.eigvalsh(matrix)[:, 0] > _PARALLEL
    moved = points.copy()
    moved[determined] = np.linalg.solve(matrix[determined], target[determined][..., None])[..., 0]
    return moved


def _crossings(one: Polyline, other: Polyline) -> Array:
    """Midpoints between the nearest points of each segment of one ray and each of another, shape (n, 3), m."""
    first, second = (n.ravel() for n in np.indices((len(one.length), len(other.length))))
    p, d, p_length = one.start[first], one.heading[first], one.length[first]
    q, e, q_length = other.start[second], other.heading[second], other.length[second]
    apart, cosine = p - q, np.sum(d * e, axis=1)
    along_d, along_e = np.sum(apart * d, axis=1), np.sum(apart * e, axis=1)
    sine_square = np.maximum(1.0 - cosine**2, _PARALLEL)
    s = np.clip((cosine * along_e - along_d) / sine_square, 0.0, p_length)
    t = np.clip(along_e + s * cosine, 0.0, q_length)
    s = np.clip(t * cosine - along_d, 0.0, p_length)
    return np.asarray(0.5 * (p + s[:, None] * d + q + t[:, None] * e))
