"""Data of the table inspector: the mixture of one direction, and the mass by number of reflections."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.lookup.lookup import look_up
from rayfix_service.fusion.measurements.directions import Direction, in_field_of_view
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_tables.level import Level
from rayfix_tables.part import StationPart


@dataclass(frozen=True, kw_only=True)
class DirectionView:
    """Mixture that the fusion looks up for a measured direction.

    Attributes
    ----------
    in_field_of_view : bool
    level_index : int
        Level that is looked up; 0 is the finest.
    window : float, rad
        Window of that level.
    cells : ndarray of int64, shape (c,)
        Cells that are summed; usually one.
    centres : ndarray of shape (c, 2), rad
        Azimuth and zenith of their centres.
    cell_components : ndarray of int64, shape (c,)
        Components of each.
    log_evidence : float
        Natural logarithm of the density of this direction; -inf if no ray arrives from it.
    probability : ndarray of shape (n,)
        Fraction of the mixture of each component, largest first.
    position : ndarray of shape (n, 3), m
    position_cov : ndarray of shape (n, 3, 3), m2
    path_length : ndarray of shape (n,), m
    path_length_stdev : ndarray of shape (n,), m
    num_reflections, num_walls : ndarray of int64, shape (n,)
    by_reflections : ndarray of shape (k,)
        Probability that the path has 0, 1, ... reflections, over all components.
    by_walls : ndarray of shape (k,)
        Probability that it passes 0, 1, ... walls.
    """

    in_field_of_view: bool
    level_index: int
    window: float
    cells: NDArray[np.int64]
    centres: NDArray[np.float64]
    cell_components: NDArray[np.int64]
    log_evidence: float
    probability: NDArray[np.float64]
    position: NDArray[np.float64]
    position_cov: NDArray[np.float64]
    path_length: NDArray[np.float64]
    path_length_stdev: NDArray[np.float64]
    num_reflections: NDArray[np.int64]
    num_walls: NDArray[np.int64]
    by_reflections: NDArray[np.float64]
    by_walls: NDArray[np.float64]


def view_direction(
    part: StationPart, azimuth: float, zenith: float, stdev: float, *, limit: int, origin: NDArray[np.float64]
) -> DirectionView:
    """Look a direction up and condition its components on it.

    Parameters
    ----------
    part : StationPart
    azimuth, zenith : float, rad
        In the scene frame.
    stdev : float, rad
        Standard deviation of both angles.
    limit : int
        Number of components to return, the most probable first.
    origin : ndarray of shape (3,), m
        Origin of the table's frame in the scene frame. Positions are returned in the scene frame.
    """
    measured = Direction(azimuth=azimuth, zenith=zenith, cov=np.diag([stdev**2, stdev**2]))
    lookup = look_up(part.levels, measured)
    mixture = StationMixtures(part).towards(measured)
    level = lookup.level
    begins, ends = level.cell_offsets[lookup.cells], level.cell_offsets[lookup.cells + 1]
    rows = np.concatenate([np.arange(begin, end) for begin, end in zip(begins, ends, strict=True)])
    reflections, walls = (
        column[rows].astype(np.int64) for column in (level.mixture.num_reflections, level.mixture.num_walls)
    )
    log_evidence = float(np.logaddexp.reduce(mixture.log_evidence, initial=-np.inf))
    fraction = np.exp(mixture.log_evidence - log_evidence) if len(mixture) else np.empty(0)
    top = np.argsort(-fraction, kind="stable")[:limit]
    return DirectionView(
        in_field_of_view=in_field_of_view(part.station, measured),
        level_index=next(n for n, one in enumerate(part.levels) if one is level),
        window=level.window,
        cells=lookup.cells,
        centres=level.grid.centres[lookup.cells],
        cell_components=ends - begins,
        log_evidence=log_evidence,
        probability=fraction[top],
        position=mixture.mean[top, :3] + origin,
        position_cov=mixture.cov[top, :3, :3],
        path_length=mixture.mean[top, 3],
        path_length_stdev=np.sqrt(mixture.cov[top, 3, 3]),
        num_reflections=reflections[top],
        num_walls=walls[top],
        by_reflections=np.bincount(reflections, weights=fraction).astype(np.float64),
        by_walls=np.bincount(walls, weights=fraction).astype(np.float64),
    )


def mass_by_reflections(level: Level) -> NDArray[np.float64]:
    """Fraction of a level's mass by the number of reflections of its components, shape (k,), summing to 1.

    The mass of a cell is the integral of its measure: the volume of free space, weighted by the probability that a UE
    there is reported from that direction.
    """
    counts = np.diff(level.cell_offsets)
    log_mass = np.repeat(level.cell_log_mass, counts) + level.mixture.log_weight
    if not len(log_mass):
        return np.zeros(1)
    mass = np.bincount(level.mixture.num_reflections.astype(np.int64), weights=np.exp(log_mass - log_mass.max()))
    return np.asarray(mass / mass.sum())
