"""Data of the pictures of one report: rays, points on them, mixtures fitted to these, length differences."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.baselines.planar import plane_crossings
from rayfix_evaluation.paper.algorithms import PaperSettings, algorithm_1
from rayfix_evaluation.paper.mixtures import Mixture, arg_max, fit_mixture, multiply
from rayfix_evaluation.paper.points import Launcher, RayPoints, draw_directions, points_on_rays
from rayfix_evaluation.paper.reports import sort_for_paper
from rayfix_evaluation.paper.selection import select_by_length
from rayfix_evaluation.studies.bench import Bench
from rayfix_evaluation.studies.cases import Case, World, simulate_case
from rayfix_service.fusion.measurements.directions import Direction
from rayfix_service.locator import Locator
from rayfix_service.wire import parse_report

__all__ = ["draw_pictures"]

_DRAWS = 10  # purpose of a generator, as in rayfix_evaluation.studies.cases
_RAYS, _POINTS, _PLANE_POINTS = 14, 350, 250
_ROWS = 9
"""Points of each station in the table of differences."""

_LOOKED_AT = 60
"""Number of drops from which the one of the pictures is selected."""

Array = NDArray[np.float64]


def draw_pictures(bench: Bench, heard: Sequence[int], seed: int) -> dict[str, Any]:
    """Follow the paper's method through one report with angles of 1 deg and times of 0.5 m.

    Parameters
    ----------
    heard : sequence of int
        Numbers of the audible drops. Of the first 60, the pictures show the drop that is audible to most stations;
        among these, the one with the fewest direct paths, but at least one.

    Returns
    -------
    dict
        JSON-compatible data; positions and lengths in m.
    """
    number = _choose(bench, heard)
    case, drop, table = Case(), bench.drop(World(), number), bench.table
    simulated = simulate_case(case, drop, number, table.site.stations, seed)
    report = parse_report(simulated.report)
    sorted_report = sort_for_paper(report, table.site)
    launcher, settings = Launcher.of_table(table), PaperSettings()
    rng = np.random.default_rng([seed, _DRAWS, number])
    stations = []
    clouds: dict[str, RayPoints] = {}
    fitted: dict[str, list[Mixture]] = {"aoa": [], "pt": []}
    plane: list[Mixture] = []
    for station in table.site.stations:
        if station.id not in sorted_report.directions:
            continue
        origin, measured = np.array(station.position), sorted_report.directions[station.id]
        directions = draw_directions(measured, settings.num_rays, rng)
        points = points_on_rays(launcher, origin, directions, step=settings.step, rng=rng)
        length, stdev = sorted_report.ranges[station.id]
        selected = select_by_length(points, length, stdev, rng)
        clouds[station.id] = points
        mixtures = {
            "aoa": algorithm_1(points, None, settings, rng),
            "pt": algorithm_1(points, (length, stdev), settings, rng),
        }
        for kind, mixture in mixtures.items():
            if mixture is not None:
                fitted[kind].append(mixture)
        crossings = plane_crossings(launcher, origin, directions, float(drop.position[2]))
        flat = fit_mixture(crossings, settings.num_components, int(rng.integers(2**31))) if len(crossings) > 1 else None
        if flat is not None:
            plane.append(flat)
        path = drop.paths[station.id]
        stations.append(
            {
                "id": station.id,
                "path": _rounded(path.vertices[0]),
                "bounces": int(path.num_reflections[0]),
                "walls": int(path.num_walls[0]),
                "crossings": _rounded(path.crossings[0, : int(path.num_walls[0])]),
                "measured_length": round(length, 4),
                "rays": [_rounded(corners) for corners in _polylines(launcher, origin, measured, rng)],
                "points_aoa": _rounded(_some(points.position, _POINTS, rng)),
                "points_pt": _rounded(_some(selected.position, _POINTS, rng)),
                "plane_points": _rounded(_some(crossings, _PLANE_POINTS, rng)),
                "mixture_aoa": _mixture(mixtures["aoa"]),
                "mixture_pt": _mixture(mixtures["pt"]),
                "mixture_plane": _mixture(flat),
            }
        )
    fix = Locator(table).locate(report)
    return {
        "drop": number,
        "truth": _rounded(drop.position),
        "bound": round(simulated.bound, 4) if np.isfinite(simulated.bound) else None,
        "rayfix": None if fix.position is None else _rounded(fix.position),
        "estimates": {kind: _estimate(found, settings) for kind, found in {**fitted, "plane": plane}.items()},
        "stations": stations,
        "length_differences": _differences(clouds, sorted_report.ranges),
    }


def _choose(bench: Bench, heard: Sequence[int]) -> int:
    def merit(number: int) -> tuple[int, int]:
        paths = bench.drop(World(), number).paths.values()
        direct = sum(int(p.line_of_sight[0]) for p in paths)
        return len(paths), -direct if direct else -len(paths)

    return max(heard[:_LOOKED_AT], key=merit)


def _polylines(launcher: Launcher, origin: Array, measured: Direction, rng: np.random.Generator) -> list[Array]:
    """Straight pieces of some rays around a measured direction, each of shape (2, 3), m."""
    directions = draw_directions(measured, _RAYS, rng)
    segments = launcher.trace(origin, directions)
    images, mirrors = segments.sequences.images, segments.sequences.mirrors
    heading = np.einsum("nij,nj->ni", mirrors[segments.sequence], directions[segments.ray])
    ends = [images[segments.sequence] + at[:, None] * heading for at in (segments.start, segments.end)]
    return list(np.stack(ends, axis=1))


def _differences(clouds: dict[str, RayPoints], ranges: dict[str, tuple[float, float]] | Any) -> dict[str, Any] | None:
    """Path lengths of points of two stations, and which pairs agree with the measured difference."""
    if len(clouds) < 2:
        return None
    first, second = list(clouds)[:2]
    stdev = 0.5
    # Rows and columns at uniform steps of length around the true lengths, to include the band of agreement.
    rows, columns = (ranges[name][0] + np.linspace(-2.0, 2.0, _ROWS) for name in (first, second))
    lengths = []
    for name, wanted in ((first, rows), (second, columns)):
        own = np.sort(clouds[name].path_length)
        lengths.append(own[np.clip(np.searchsorted(own, wanted), 0, len(own) - 1)])
    difference = lengths[1][None, :] - lengths[0][:, None]
    measured = ranges[second][0] - ranges[first][0]
    return {
        "rows": first,
        "columns": second,
        "row_lengths_m": _rounded(lengths[0]),
        "column_lengths_m": _rounded(lengths[1]),
        "difference_m": _rounded(difference),
        "measured_m": round(float(measured), 4),
        "stdev_m": stdev,
        "agrees": (np.abs(difference - measured) < 2.0 * stdev).astype(int).tolist(),
    }


def _estimate(mixtures: list[Mixture], settings: PaperSettings) -> list[float] | None:
    if not mixtures:
        return None
    return list(_rounded(arg_max(mixtures, multiply(mixtures, settings.most_products).mean)))


def _mixture(mixture: Mixture | None) -> dict[str, Any] | None:
    if mixture is None:
        return None
    weight = np.exp(mixture.log_weight - np.logaddexp.reduce(mixture.log_weight))
    return {"weight": _rounded(weight), "mean": _rounded(mixture.mean), "cov": _rounded(mixture.cov, 6)}


def _some(points: Array, most: int, rng: np.random.Generator) -> Array:
    return points if len(points) <= most else points[rng.choice(len(points), most, replace=False)]


def _rounded(values: Array, digits: int = 4) -> Any:
    return np.round(values, digits).tolist()
