"""Position errors: uniform drops, simulated reports, errors and the position error bound."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.drops.bound import position_error_bound
from rayfix_evaluation.drops.simulate import Noise, Rule, Timing, select_path, simulate_report, uniform_drops
from rayfix_evaluation.truth.forward import ForwardSolver, Paths
from rayfix_evaluation.truth.scene_walls import walls_of_table
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.locator import Locator
from rayfix_service.wire import parse_report
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.site import Station
from rayfix_tables.table import Table


@dataclass(frozen=True, kw_only=True)
class Drop:
    """A true position [m], shape (3,), and the paths from every station to which it is audible."""

    position: NDArray[np.float64]
    paths: Mapping[str, Paths]


@dataclass(frozen=True, kw_only=True)
class LocatedDrop:
    """A drop, the fix of its report, and the bound of the report.

    Attributes
    ----------
    drop : Drop
        With only the reported path of each station.
    bound : float, m
        Position error bound; infinite if the measurements do not determine a position.
    seconds : float
        Computing time of the fix.
    """

    drop: Drop
    fix: Fix
    bound: float
    seconds: float

    @property
    def error(self) -> float:
        """Distance of the fix from the truth, m; infinite without a position."""
        if self.fix.position is None:
            return float("inf")
        return float(np.linalg.norm(self.fix.position - self.drop.position))


@dataclass(frozen=True, kw_only=True)
class DropErrors:
    """Results of drops.

    Attributes
    ----------
    error : ndarray of shape (n_drops,), m
        Distance of the fix from the truth; inf without a fix.
    bound : ndarray of shape (n_drops,), m
        Position error bound of the same measurements; inf if they do not determine a position.
    seconds : ndarray of shape (n_drops,)
        Computing time of the fix; 0 if the drop is audible to no station.
    status : tuple of str
        Status of each fix; "unheard" if the drop is audible to no station.
    """

    error: NDArray[np.float64]
    bound: NDArray[np.float64]
    seconds: NDArray[np.float64]
    status: tuple[str, ...]


def clear_of_solids(free_space: FreeSpace, points: NDArray[np.float64], *, margin: float) -> NDArray[np.bool_]:
    """Whether points and their surroundings lie in free space.

    Parameters
    ----------
    points : ndarray of shape (n, 3), m
    margin : float, m
        Distance along each axis that must also be free.
    """
    around = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * margin
    return np.asarray(free_space.contains(points[:, None, :] + around).all(axis=1))


def solver_of(table: Table, vertices: NDArray[np.float64] | None = None) -> ForwardSolver:
    """Return the forward solver of a table's scene, with the reflections and losses of its site.

    Parameters
    ----------
    vertices : ndarray of shape (n_vertices, 3), m, optional
        Vertices that replace those of the table's scene.
    """
    propagation = table.site.document["propagation"]
    scene = table.scene
    return ForwardSolver.from_mesh(
        np.array(scene.vertices if vertices is None else vertices),
        np.array(scene.faces),
        max_reflections=propagation["max_reflections"],
        max_path_length=propagation["max_path_length_m"],
        reflection_loss_db=propagation["reflection_loss_db"],
        walls=walls_of_table(table),
    )


def drop_positions(
    table: Table, count: int, rng: np.random.Generator, *, margin: float = 0.06, max_height: float = np.inf
) -> NDArray[np.float64]:
    """Draw positions uniformly from the free space, shape (count, 3), m.

    Parameters
    ----------
    margin : float, m
        Smallest distance, along each axis, from solids and the building's shell.
    max_height : float, m
        Greatest z of a position.
    """
    free_space = table.scene.free_space
    low = free_space.origin
    high = low + np.array(free_space.free.shape) * free_space.voxel_size
    high[2] = min(high[2], max_height)
    return uniform_drops(lambda p: clear_of_solids(free_space, p, margin=margin), low, high, count, rng)


def drops_at(points: NDArray[np.float64], solver: ForwardSolver, stations: Sequence[Station]) -> list[Drop]:
    """Find the paths of stations to points of shape (n, 3), m."""
    solvers = {station.id: solver.station(np.array(station.position)) for station in stations}
    drops = []
    for point in points:
        paths = {name: station.paths(point) for name, station in solvers.items()}
        drops.append(Drop(position=point, paths={name: found for name, found in paths.items() if len(found)}))
    return drops


def drop_uniformly(
    table: Table, count: int, rng: np.random.Generator, *, margin: float = 0.06, max_height: float = np.inf
) -> list[Drop]:
    """Draw drops uniformly from the free space and find the paths to them.

    Parameters
    ----------
    margin, max_height : float, m
        As in :func:`drop_positions`.
    """
    points = drop_positions(table, count, rng, margin=margin, max_height=max_height)
    return drops_at(points, solver_of(table), table.site.stations)


def locate_drop(
    locator: Locator,
    drop: Drop,
    noise: Noise,
    *,
    timing: Timing,
    rng: np.random.Generator,
    rule: Rule = "strongest",
) -> LocatedDrop:
    """Simulate the report of one path to a drop from each station, locate it, and bound its error.

    Parameters
    ----------
    drop : Drop
        Audible to at least one station.
    rule : {"strongest", "first", "random"}
        Rule by which each station selects the reported path.
    """
    reported = {name: paths.only(select_path(paths, rule, rng)) for name, paths in drop.paths.items()}
    report = parse_report(simulate_report(reported, noise, rng=rng, timing=timing))
    begin = perf_counter()
    fix = locator.locate(report)
    seconds = perf_counter() - begin
    positions = {s.id: s.position for s in locator.table.site.stations}
    bound = position_error_bound(
        np.array([positions[name] for name in reported]),
        list(reported.values()),
        [0] * len(reported),
        drop.position,
        noise,
        timing=timing,
    )
    return LocatedDrop(drop=Drop(position=drop.position, paths=reported), fix=fix, bound=bound, seconds=seconds)


def locate_drops(
    locator: Locator,
    drops: Sequence[Drop],
    noise: Noise,
    *,
    timing: Timing,
    rng: np.random.Generator,
    rule: Rule = "strongest",
) -> DropErrors:
    """Simulate the report of each drop, locate it, and compare with the truth; see :func:`locate_drop`."""
    error, bound = np.full(len(drops), np.inf), np.full(len(drops), np.inf)
    seconds = np.zeros(len(drops))
    status = []
    for n, drop in enumerate(drops):
        if not drop.paths:
            status.append("unheard")
            continue
        found = locate_drop(locator, drop, noise, timing=timing, rng=rng, rule=rule)
        error[n], bound[n], seconds[n] = found.error, found.bound, found.seconds
        status.append(found.fix.status)
    return DropErrors(error=error, bound=bound, seconds=seconds, status=tuple(status))
