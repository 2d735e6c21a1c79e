"""``rayfix plot``: pictures of a report for papers: rays, points on them, mixtures, posterior and fix in the scene."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from rayfix_evaluation.paper.points import Launcher, RayPoints, draw_directions, points_on_rays
from rayfix_evaluation.paper.selection import select_by_length
from rayfix_evaluation.pictures.density import credible_levels, marginal_density
from rayfix_evaluation.pictures.plot import SceneFigure, draw_candidates, draw_truth, make_figure
from rayfix_service.fusion.measurements.directions import Direction, to_scene, without_bias
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

Layer = Literal["rays", "points", "mixture", "posterior", "fix"]

LAYERS: tuple[Layer, ...] = get_args(Layer)

_RAYS = 40
_POINT_RAYS = 400
_STEP = 0.25  # m, between points
_SHARES = (0.5, 0.9)
_GRID = 320
_STATION_COLOURS = ("#3b7dd8", "#e08214", "#1a936f", "#8e5bb5", "#b5654a", "#4a9fb5", "#7a8b2f", "#c2477f")
_POSTERIOR = "#d1495b"


def plot_report(
    path: str | Path,
    locator: Locator,
    report: Report,
    document: Mapping[str, Any],
    *,
    layers: Collection[Layer] = ("rays", "mixture", "posterior", "fix"),
    truth: tuple[float, float, float] | None = None,
    seed: int = 1,
) -> None:
    """Draw a report in its scene and write the picture.

    Parameters
    ----------
    path : str or Path
        The suffix is the type: .png, .svg or .pdf.
    locator : Locator
    report : Report
    document : mapping
        The fix, as the HTTP interface answers it.
    layers : collection of {"rays", "points", "mixture", "posterior", "fix"}
        "rays": drawn from the noise about each measured direction and mirrored; "points": on such rays, selected by the
        station's propagation time as in the paper's Algorithm 1; "mixture": contours of the table's mixture for each
        station's measurements; "posterior": contours of the posterior of the position.
    truth : tuple of 3 floats, optional
        True position, m.
    seed : int
        Seed of rays and points.
    """
    table = locator.table
    figure = make_figure(table)
    rng = np.random.default_rng(seed)
    heard = _heard_stations(table, report)
    handles: list[Line2D | Patch] = []
    if {"rays", "points"} & set(layers):
        launcher = Launcher.of_table(table)
        for n, (station_id, direction, length) in enumerate(heard):
            if direction.zenith is None:
                continue  # a ray needs both angles
            station = np.array(table.parts[station_id].station.position)
            if "rays" in layers:
                _draw_rays(figure, launcher, station, draw_directions(direction, _RAYS, rng), _colour(n))
            if "points" in layers:
                directions = draw_directions(direction, _POINT_RAYS, rng)
                points = points_on_rays(launcher, station, directions, step=_STEP, rng=rng)
                if length is not None:
                    points = select_by_length(points, length.path_length, length.stdev, rng)
                _draw_points(figure, points, _colour(n))
    for n, (station_id, direction, length) in enumerate(heard):
        handles.append(Line2D([], [], color=_colour(n), label=station_id))
        if "mixture" in layers:
            weight, mean, cov = _station_mixture(table, station_id, direction, length)
            _draw_contours(figure, weight, mean, cov, _colour(n), filled=False)
    if "posterior" in layers:
        posterior = locator.posterior(report)
        _draw_contours(figure, np.exp(posterior.log_weight), posterior.mean, posterior.cov, _POSTERIOR, filled=True)
        handles.append(Patch(color=_POSTERIOR, alpha=0.6, label=f"posterior, {_percentages()}"))
    for axes, view in figure.views:
        if "fix" in layers:
            draw_candidates(axes, document, view)
        if truth is not None:
            draw_truth(axes, truth, view)
    figure.finish(path, document=document, truth=truth, handles=handles)


def _heard_stations(table: Table, report: Report) -> list[tuple[str, Direction, Range | None]]:
    """Stations that measured an angle, with their propagation time if they measured one."""
    stations = {station.id: station for station in table.site.stations}
    ranges = {m.station_id: m for m in report.measurements if isinstance(m, Range)}
    return [
        (m.station_id, to_scene(without_bias(m, stations[m.station_id]), stations[m.station_id], table.site.north),
         ranges.get(m.station_id))
        for m in report.measurements
        if isinstance(m, Angle)
    ]  # fmt: skip


def _station_mixture(
    table: Table, station_id: str, direction: Direction, length: Range | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mixture over the position given one station's angle and time: weights, means (n, 3), covariances (n, 3, 3)."""
    log_weight, mean, cov = StationMixtures(table.parts[station_id]).towards(direction)
    if length is not None:
        variance = cov[:, 3, 3] + length.stdev**2
        apart = length.path_length - table.parts[station_id].station.bias.range - mean[:, 3]
        gain = cov[:, :, 3] / variance[:, None]
        log_weight = log_weight - 0.5 * (apart**2 / variance + np.log(variance))
        mean = mean + gain * apart[:, None]
        cov = cov - gain[:, :, None] * cov[:, None, 3, :]
    if len(log_weight):
        log_weight = log_weight - np.logaddexp.reduce(log_weight)
    return np.exp(log_weight), mean[:, :3] + table.scene.origin, cov[:, :3, :3]


def _draw_rays(
    figure: SceneFigure,
    launcher: Launcher,
    station: NDArray[np.float64],
    directions: NDArray[np.float64],
    colour: str,
) -> None:
    segments = launcher.trace(station, directions)
    ray, sequence = segments.ray, segments.sequence
    images, mirrors = segments.sequences.images[sequence], segments.sequences.mirrors[sequence]
    heading = np.einsum("nij,nj->ni", mirrors, directions[ray])
    pieces = np.stack([images + reach[:, None] * heading for reach in (segments.start, segments.end)], axis=1)
    for axes, view in figure.views:
        axes.add_collection(
            LineCollection(list(pieces[:, :, list(view)]), colors=colour, linewidths=0.5, alpha=0.35, zorder=1.5)
        )


def _draw_points(figure: SceneFigure, points: RayPoints, colour: str) -> None:
    for axes, view in figure.views:
        x, y = points.position[:, list(view)].T
        axes.plot(x, y, linestyle="none", marker=".", markersize=1.6, color=colour, alpha=0.6, zorder=1.6)


def _draw_contours(
    figure: SceneFigure,
    weight: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    colour: str,
    *,
    filled: bool,
) -> None:
    if not len(weight):
        return
    for axes, view in figure.views:
        x, y = (np.linspace(*limits, _GRID) for limits in _limits(axes))
        density = marginal_density(weight, mean, cov, view, x, y)
        levels = credible_levels(density, _SHARES)
        if len(levels) < len(_SHARES):
            continue  # narrower than the grid
        if filled:
            axes.contourf(x, y, density, [*levels, np.inf], colors=[colour, colour], alpha=0.45, zorder=2.2)
        else:
            axes.contour(x, y, density, levels, colors=colour, linewidths=[0.7, 1.2], zorder=2.0)


def _limits(axes: Axes) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of both coordinates, ascending: x may run down."""
    return axes.get_xbound(), axes.get_ybound()


def _percentages() -> str:
    return " and ".join(f"{share:.0%}" for share in _SHARES)


def _colour(n: int) -> str:
    return _STATION_COLOURS[n % len(_STATION_COLOURS)]
