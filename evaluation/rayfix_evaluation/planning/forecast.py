"""Forecast of the fixes over a floor: simulated reports from each square, located with the table itself."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.drops.accuracy import clear_of_solids
from rayfix_evaluation.drops.bound import information_bound
from rayfix_evaluation.drops.simulate import Noise, Timing, fold_direction
from rayfix_evaluation.planning.several_paths import StrongestPaths, strongest_paths
from rayfix_evaluation.planning.station_mixture import AudiblePaths, audible_paths
from rayfix_service.fusion.measurements.report import (
    Angle,
    MeasuredPath,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.fusion.quadrature.path_sets import MOST_MEASURED
from rayfix_service.locator import Locator
from rayfix_tables.errors import RayfixError
from rayfix_tables.site import Station
from rayfix_tables.table import Table

Array = NDArray[np.float64]

Progress = Callable[[int, int], None]
"""Called with the number of reports located so far, and the total number."""

MOST_PATHS = 10
"""Paths of a station that may be planned with."""

_MARGIN = 0.06  # m; positions nearer to solids are left out
_TRIES = 10  # candidate positions for each position that is drawn
_CLOCK = 100.0  # m; offset of a simulated clock


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """Settings of a forecast.

    Attributes
    ----------
    height : float, m
        z of the transmitters.
    noise : Noise
        Standard deviations of the measurements.
    timing : {"none", "pt", "toa", "tdoa"}
        Times that are measured in addition to the angles.
    spacing : float, m
        Side of the map's squares.
    threshold : float, m
        Largest useful error.
    draws : int
        Reports from each square, each from a different position in it and with different noise.
    seed : int
        Seed of positions and noise.
    paths : int, optional
        Strongest paths that each station reports; by default one, as the table's rule selects it.

    Raises
    ------
    RayfixError
        If a setting is out of range.
    """

    height: float
    noise: Noise
    timing: Timing = "none"
    spacing: float = 0.5
    threshold: float = 1.0
    draws: int = 4
    seed: int = 1
    paths: int | None = None

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        for name in ("spacing", "threshold"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise RayfixError(f"the {name} is {value} m; it must be positive")
        if not np.isfinite(self.height):
            raise RayfixError(f"the height is {self.height} m; give the transmitters' z in the scene")
        if self.draws < 1:
            raise RayfixError(f"the number of draws is {self.draws}; give 1 or more")
        if self.paths is not None and not 1 <= self.paths <= MOST_PATHS:
            raise RayfixError(f"the number of paths is {self.paths}; give 1 to {MOST_PATHS}")
        if self.paths is not None and self.timing == "tdoa":
            raise RayfixError("several paths have no time differences; give their times as 'toa', on the unknown clock")
        if self.seed < 0:
            raise RayfixError(f"the seed is {self.seed}; give 0 or more")
        if self.timing != "none" and self.noise.range_stdev is None:
            raise RayfixError(
                f"the timing is '{self.timing}', but the standard deviation of a range is not given; give it in m"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class PlanMap:
    """Forecast for n squares of a floor.

    Attributes
    ----------
    settings : PlanSettings
    table_id : str
    position : ndarray of shape (n, 3), m
        Centres of the squares.
    audible : ndarray of shape (n, n_stations)
        Fraction of a square's sampled positions that is audible to each station of the site.
    bound : ndarray of shape (n,), m
        Root mean square of the position error bounds of the reported paths; infinite if one of them leaves a direction
        undetermined.
    error : ndarray of shape (n,), m
        Expected root mean square error, including other candidates; infinite if a report gives no fix.
    within : ndarray of shape (n,)
        Probability that the error is below the threshold.
    """

    settings: PlanSettings
    table_id: str
    position: Array
    audible: Array
    bound: Array
    error: Array
    within: Array

    def __len__(self) -> int:
        """Return the number of squares."""
        return len(self.position)

    @cached_property
    def num_audible(self) -> Array:
        """Mean number of stations to which a position in each square is audible, shape (n,)."""
        return np.asarray(self.audible.sum(axis=1))

    @property
    def coverage(self) -> float:
        """Fraction of all fixes whose error is below the threshold."""
        return float(self.within.mean())


def forecast(table: Table, settings: PlanSettings, progress: Progress | None = None) -> PlanMap:
    """Forecast the fixes of a table over a floor.

    Raises
    ------
    RayfixError
        If no position is free at this height.
    """
    rng = np.random.default_rng(settings.seed)
    squares, places = draw_places(table, settings.height, settings.spacing, settings.draws, rng)
    stations = table.site.stations
    if settings.paths is not None and settings.paths * len(stations) > MOST_MEASURED:
        raise RayfixError(
            f"{len(stations)} stations with {settings.paths} paths each are more than {MOST_MEASURED} paths in a "
            f"report; give --paths {MOST_MEASURED // len(stations)} or less"
        )
    noise = rng.standard_normal((len(places), len(stations), 3))
    inside = places - table.scene.origin
    paths = [audible_paths(table.levels(station.id)[0], inside) for station in stations]
    several = None if settings.paths is None else _several(table, inside, settings.paths)
    locator = Locator(table)
    bound, square, within = np.empty(len(places)), np.empty(len(places)), np.empty(len(places))
    for n in range(len(places)):
        if several is None:
            bound[n] = _bound(paths, n, settings)
            measurements = _measure(stations, paths, n, settings, noise[n])
        else:
            of_place = [found[n] for found in several]
            bound[n] = _bound_of_several(of_place, settings)
            measurements = _measure_several(stations, of_place, settings, rng)
        square[n], within[n] = _outlook(locator, measurements, settings.threshold)
        if progress is not None:
            progress(n + 1, len(places))
    middles, first = np.unique(squares, axis=0, return_index=True)
    shape = (len(middles), settings.draws)
    audible = np.stack([path.audible for path in paths], axis=1)
    assert np.array_equal(first, np.arange(len(middles)) * settings.draws)  # squares are complete and in order
    return PlanMap(
        settings=settings,
        table_id=table.table_id,
        position=middles,
        audible=audible.reshape(*shape, -1).mean(axis=1),
        bound=np.sqrt(np.square(bound).reshape(shape).mean(axis=1)),
        error=np.sqrt(square.reshape(shape).mean(axis=1)),
        within=within.reshape(shape).mean(axis=1),
    )


def draw_places(
    table: Table, height: float, spacing: float, count: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw positions from squares that tile a floor.

    Parameters
    ----------
    height, spacing : float, m
    count : int
        Number of positions of each square.

    Returns
    -------
    squares : ndarray of shape (n * count, 3), m
        Centre of the square of each position, ascending.
    places : ndarray of shape (n * count, 3), m
        Positions in the free space. Squares with little free space are left out.

    Raises
    ------
    RayfixError
        If there is none.
    """
    free_space = table.scene.free_space
    low = free_space.origin[:2]
    high = low + np.array(free_space.free.shape[:2]) * free_space.voxel_size
    axes = [np.arange(a + 0.5 * spacing, b, spacing) for a, b in zip(low, high, strict=True)]
    x, y = np.meshgrid(*axes, indexing="ij")
    middles = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=-1)
    tried = np.repeat(middles[:, None], _TRIES * count, axis=1)
    tried[..., :2] += spacing * (rng.random((*tried.shape[:2], 2)) - 0.5)
    free = clear_of_solids(free_space, tried.reshape(-1, 3), margin=_MARGIN).reshape(tried.shape[:2])
    usable = free.sum(axis=1) >= count
    if not len(middles):
        width, depth = high - low
        raise RayfixError(
            f"squares of {spacing:g} m do not fit into the building of {width:.2f} x {depth:.2f} m; give a smaller "
            "spacing"
        )
    if not usable.any():
        bottom = float(free_space.origin[2])
        top = bottom + free_space.free.shape[2] * free_space.voxel_size
        raise RayfixError(
            f"nothing is free at a height of {height} m; the building reaches from {bottom:.2f} to {top:.2f} m"
        )
    # A stable sort brings the first free ones to the front.
    chosen = np.argsort(~free[usable], axis=1, kind="stable")[:, :count]
    places = np.take_along_axis(tried[usable], chosen[..., None], axis=1)
    return np.repeat(middles[usable], count, axis=0), places.reshape(-1, 3)


def _bound(paths: Sequence[AudiblePaths], place: int, settings: PlanSettings) -> float:
    """Bound as in :mod:`rayfix_evaluation.drops.bound`, from gradients of the table."""
    noise = settings.noise
    information = np.zeros((3, 3))
    lengths = []
    for path in paths:
        if not path.audible[place]:
            continue
        length, horizontal, vertical = path.gradients[place]
        across = max(float(np.sin(path.zenith[place])), 1e-6) * noise.azimuth_stdev
        information += np.outer(horizontal, horizontal) / across**2
        information += np.outer(vertical, vertical) / noise.zenith_stdev**2
        lengths.append(length)
    return information_bound(information, lengths, noise, timing=settings.timing)


def _several(table: Table, places: Array, most: int) -> list[Sequence[StrongestPaths]]:
    """Strongest paths from each station to places in the table's frame."""
    found = []
    for station in table.site.stations:
        stored = table.parts[station.id].paths
        if stored is None:
            raise RayfixError("the table has no map of paths, as those of format 2 and older; build it again")
        found.append(strongest_paths(stored, places, most))
    return found


def _bound_of_several(paths: Sequence[StrongestPaths], settings: PlanSettings) -> float:
    """Bound of the paths that all stations report."""
    noise = settings.noise
    information = np.zeros((3, 3))
    for found in paths:
        for zenith, (_, horizontal, vertical) in zip(found.zenith, found.gradients, strict=True):
            across = max(float(np.sin(zenith)), 1e-6) * noise.azimuth_stdev
            information += np.outer(horizontal, horizontal) / across**2
            information += np.outer(vertical, vertical) / noise.zenith_stdev**2
    lengths = [gradient[0] for found in paths for gradient in found.gradients]
    return information_bound(information, lengths, noise, timing=settings.timing)


def _measure_several(
    stations: Sequence[Station], paths: Sequence[StrongestPaths], settings: PlanSettings, rng: np.random.Generator
) -> tuple[Measurement, ...]:
    """Measure several paths of each station with noise."""
    noise, timing = settings.noise, settings.timing
    measurements: list[Measurement] = []
    for station, found in zip(stations, paths, strict=True):
        for path, error in zip(range(len(found.length)), rng.standard_normal((len(found.length), 3)), strict=True):
            azimuth, zenith = fold_direction(
                found.azimuth[path] + station.bias.azimuth + error[0] * noise.azimuth_stdev,
                found.zenith[path] + station.bias.zenith + error[1] * noise.zenith_stdev,
            )
            length = None
            if noise.range_stdev is not None and timing != "none":
                offset = _CLOCK if timing == "toa" else 0.0
                length = float(found.length[path] + station.bias.range + offset + error[2] * noise.range_stdev)
            measurements.append(
                MeasuredPath(
                    station_id=station.id,
                    azimuth=azimuth,
                    azimuth_stdev=noise.azimuth_stdev,
                    zenith=zenith,
                    zenith_stdev=noise.zenith_stdev,
                    length=length,
                    stdev=None if length is None else noise.range_stdev,
                    clock="ue" if timing == "toa" else "known",
                )
            )
    return tuple(measurements)


def _outlook(locator: Locator, measurements: tuple[Measurement, ...], threshold: float) -> tuple[float, float]:
    """Mean square error [m2] and probability of an error below the threshold [m], by the posterior of a report."""
    regions = locator.locate(Report(measurements=measurements)).regions if measurements else None
    if regions is None:
        return float("inf"), 0.0
    square = np.square(regions.points.places() - regions.position).sum(axis=1)
    return float(square.mean()), regions.share * float(np.mean(square < threshold**2))


def _measure(
    stations: Sequence[Station], paths: Sequence[AudiblePaths], place: int, settings: PlanSettings, errors: Array
) -> tuple[Measurement, ...]:
    """Measurements from a position; ``errors`` in standard deviations, of shape (n_stations, 3)."""
    noise, timing = settings.noise, settings.timing
    range_stdev = noise.range_stdev or 0.0
    measurements: list[Measurement] = []
    arrivals: list[tuple[str, float]] = []
    for station, path, error in zip(stations, paths, errors, strict=True):
        if not path.audible[place]:
            continue
        azimuth, zenith = fold_direction(
            path.azimuth[place] + station.bias.azimuth + error[0] * noise.azimuth_stdev,
            path.zenith[place] + station.bias.zenith + error[1] * noise.zenith_stdev,
        )
        measurements.append(
            Angle(
                station_id=station.id,
                azimuth=azimuth,
                zenith=zenith,
                azimuth_stdev=noise.azimuth_stdev,
                zenith_stdev=noise.zenith_stdev,
            )
        )
        arrivals.append((station.id, float(path.path_length[place] + station.bias.range + error[2] * range_stdev)))
    if timing == "pt":
        measurements += [Range(station_id=name, path_length=length, stdev=range_stdev) for name, length in arrivals]
    if timing == "toa":
        measurements += [
            TimeOfArrival(station_id=name, path_length=length + _CLOCK, stdev=range_stdev) for name, length in arrivals
        ]
    if timing == "tdoa":
        reference, start = arrivals[0] if arrivals else ("", 0.0)
        measurements += [
            TimeDifference(
                station_id=name,
                reference_station_id=reference,
                length_difference=length - start,
                stdev=float(np.sqrt(2.0)) * range_stdev,
            )
            for name, length in arrivals[1:]
        ]
    return tuple(measurements)


def summary(plan: PlanMap) -> dict[str, Any]:
    """Summary of a map, JSON-compatible; None replaces infinity."""
    expected = np.quantile(plan.error, [0.5, 0.9], method="inverted_cdf")
    return {
        "table_id": plan.table_id,
        "squares": len(plan),
        "coverage": plan.coverage,
        "error_m": {"50": finite(expected[0]), "90": finite(expected[1])},
        "stations_heard": {
            "mean": float(plan.num_audible.mean()),
            "share_below_2": float(np.mean(plan.num_audible < 2.0)),
        },
    }


def finite(value: float) -> float | None:
    """Convert a number for JSON: None replaces infinity."""
    return float(value) if np.isfinite(value) else None
