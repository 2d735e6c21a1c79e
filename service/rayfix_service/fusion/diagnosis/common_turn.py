"""Propose turns that all azimuths have in common, as if each path were straight: rays that meet in one point.

For each of many turns, the point nearest to all rays in standard deviations is a linear least-squares problem; the
turns whose sum of squares is as small as errors alone would make it are proposed. It takes some milliseconds and needs
no table. Where paths are reflected it proposes nothing: with them, too many turns would agree.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.directions import to_scene, without_bias
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_tables.geometry.angles import direction, wrap_one
from rayfix_tables.site import SiteInfo

Array = NDArray[np.float64]

_STEPS = 720
_FINE_STEPS = 21
_ROUNDS = 3
"""Times that the weights are taken from the point found with those before."""

_MOST_DEVIATIONS = 3.0
"""Standard deviations that the sum of squares may be above its mean."""

_BEHIND = 1e9
"""Square of a station that would have to look back."""

_LEAST_TURN = 2.0
"""Standard deviations of the azimuth; less is no turn."""

_SURPLUS = 2
"""Measured quantities that there must be beyond the four unknown ones, a position and a turn."""


class ProposedTurn(NamedTuple):
    """A turn, counter-clockwise from above, and its standard deviation, rad."""

    angle: float
    stdev: float


class _Rays(NamedTuple):
    """Rays to the UE: origins, m, angles, rad, their standard deviations, and lengths, m, inf where unknown."""

    origin: Array
    azimuth: Array
    zenith: Array
    azimuth_stdev: Array
    zenith_stdev: Array
    length: Array
    length_stdev: Array


def common_turns(report: Report, site: SiteInfo, *, most: int) -> list[ProposedTurn]:
    """Find turns of all azimuths for which straight paths agree, the best first.

    Parameters
    ----------
    report : Report
    site : SiteInfo
    most : int
        How many at most.

    Returns
    -------
    list of ProposedTurn
        Empty where the measurements are too few to tell a turn from a position.
    """
    rays = _rays(report, site)
    quantities = sum(1 for m in report.measurements if not isinstance(m, Angle))
    quantities += len(rays.azimuth) + int(np.isfinite(rays.zenith_stdev).sum()) + (report.height is not None)
    if most < 1 or len(rays.azimuth) < 2 or quantities < 4 + _SURPLUS:
        return []
    turns = np.linspace(-np.pi, np.pi, _STEPS, endpoint=False)
    squares = _sum_of_squares(rays, report, turns)
    lowest = np.flatnonzero((squares <= np.roll(squares, 1)) & (squares < np.roll(squares, -1)))
    freedom = quantities - 4
    most_squares = freedom + _MOST_DEVIATIONS * np.sqrt(2.0 * freedom)
    proposed: list[ProposedTurn] = []
    for n in lowest[np.argsort(squares[lowest], kind="stable")][:most]:
        near = turns[n] + np.linspace(-1.0, 1.0, _FINE_STEPS) * (2.0 * np.pi / _STEPS)
        refined = _sum_of_squares(rays, report, near)
        turn = wrap_one(float(near[np.argmin(refined)]))
        if refined.min() <= most_squares and abs(turn) > _LEAST_TURN * float(rays.azimuth_stdev.min()):
            proposed.append(ProposedTurn(turn, _stdev(near, refined)))
    return proposed


def _stdev(turns: Array, squares: Array) -> float:
    """Estimate the standard deviation of a turn from the curvature of its sum of squares."""
    curvature = float(np.polyfit(turns - turns.mean(), squares, 2)[0])
    return float(1.0 / np.sqrt(max(curvature, 1e-9)))


def _rays(report: Report, site: SiteInfo) -> _Rays:
    """Gather each station's first angle, and its first propagation time as the ray's length."""
    rows = []
    lengths: dict[str, Range] = {}
    for measurement in report.measurements:
        if isinstance(measurement, Range):
            lengths.setdefault(measurement.station_id, measurement)
    seen = set()
    for measurement in report.measurements:
        if not isinstance(measurement, Angle) or measurement.station_id in seen:
            continue
        seen.add(measurement.station_id)
        station = site.station_by_id[measurement.station_id]
        found = to_scene(without_bias(measurement, station), station, site.north)
        if found.azimuth is None or (found.zenith is None and found.local is not None):
            continue
        length = lengths.get(station.id)
        rows.append(
            (
                *station.position,
                found.azimuth,
                0.5 * np.pi if found.zenith is None else found.zenith,
                np.sqrt(found.cov[0, 0]),
                np.sqrt(found.cov[1, 1]),
                np.inf if length is None else length.path_length - station.bias.range,
                np.inf if length is None else length.stdev,
            )
        )
    table = np.array(rows).reshape(-1, 9)
    return _Rays(table[:, :3], *table[:, 3:].T)


def _sum_of_squares(rays: _Rays, report: Report, turns: Array) -> Array:
    """Sum of squared residuals in standard deviations at the best point of each turn; shape (n_turns,)."""
    azimuth = rays.azimuth + turns[:, None]
    ahead = direction(azimuth, rays.zenith)
    across = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
    above = np.cross(ahead, across)
    known = np.isfinite(rays.length)
    far = np.broadcast_to(np.where(known, rays.length, 10.0), azimuth.shape)
    has_zenith = np.isfinite(rays.zenith_stdev)
    sine = np.maximum(np.sin(rays.zenith), 0.1)
    along = np.where(known, rays.length, 0.0)[None, :, None] * ahead
    places = rays.origin + along
    residuals = np.empty(0)
    for _ in range(_ROUNDS):
        # Inverse standard deviations, 1/m, of the three directions of each ray.
        weights = np.stack(
            [
                1.0 / np.maximum(rays.azimuth_stdev * sine * far, 1e-6),
                np.where(has_zenith, 1.0 / np.maximum(np.where(has_zenith, rays.zenith_stdev, 1.0) * far, 1e-6), 0.0),
                np.broadcast_to(np.where(known, 1.0 / np.where(known, rays.length_stdev, 1.0), 0.0), far.shape),
            ],
            axis=-1,
        )
        rows = np.stack([across, above, ahead], axis=-2) * weights[..., None]
        values = np.einsum("tkij,tkj->tki", rows, places)
        normal = np.einsum("tkij,tkil->tjl", rows, rows) + 1e-9 * np.eye(3)
        right = np.einsum("tkij,tki->tj", rows, values)
        if report.height is not None:
            normal[:, 2, 2] += report.height.stdev**-2
            right[:, 2] += report.height.z * report.height.stdev**-2
        point = np.linalg.solve(normal, right[..., None])[..., 0]
        residuals = np.einsum("tkij,tj->tki", rows, point) - values
        to_point = point[:, None, :] - rays.origin
        far = np.maximum(np.linalg.norm(to_point, axis=-1), 0.1)
    # Lines have two ends: behind a station is nothing.
    behind = np.einsum("tkj,tkj->tk", to_point, ahead) < 0.0
    return np.asarray(np.where(behind, _BEHIND, np.square(residuals).sum(axis=-1)).sum(axis=-1))
