"""Fingerprinting: the positions of a simulated map with the features nearest to the report.

The weighted k nearest neighbours of P. Bahl, V. N. Padmanabhan, "RADAR: an in-building RF-based user location and
tracking system", INFOCOM 2000, with the angles and lengths of the strongest paths as the fingerprint. A forward solver
finds them for a grid of positions.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.neighbors import NearestNeighbors

from rayfix_evaluation.baselines.reports import sort_for_rivals
from rayfix_evaluation.drops.accuracy import clear_of_solids, solver_of
from rayfix_evaluation.paper.reports import PaperReport
from rayfix_service.fusion.measurements.report import Report
from rayfix_tables.geometry.angles import direction
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

Array = NDArray[np.float64]

_UNHEARD = 10.0
"""Distance, in standard deviations per measurement, of a position that is not audible to the reporting station."""


@dataclass(frozen=True, kw_only=True)
class RadioMap:
    """The strongest path from each position of a grid to each station.

    Attributes
    ----------
    spacing : float, m
        Spacing of neighbouring positions along each axis.
    position : ndarray of shape (n, 3), m
    direction : mapping of str to ndarray of shape (n, 3)
        Unit vector from each station towards the incoming ray; zero where there is no path.
    path_length : mapping of str to ndarray of shape (n,), m
        Zero where there is no path.
    heard : mapping of str to ndarray of bool, shape (n,)
    """

    spacing: float
    position: Array
    direction: dict[str, Array]
    path_length: dict[str, Array]
    heard: dict[str, NDArray[np.bool_]]

    def __len__(self) -> int:
        """Return the number of positions."""
        return len(self.position)


def simulate_map(table: Table, *, spacing: float = 0.5, margin: float = 0.06) -> RadioMap:
    """Find the strongest paths to a grid of positions in a table's free space.

    Parameters
    ----------
    spacing : float, m
        Spacing of the grid.
    margin : float, m
        Smallest distance of a position, along each axis, from solids and the building's shell.

    Raises
    ------
    ValueError
        If no position of the grid is free.
    """
    free_space = table.scene.free_space
    size = np.array(free_space.free.shape) * free_space.voxel_size
    # The grid is centred in the building.
    counts = np.maximum(1, np.floor(size / spacing).astype(np.int64))
    axes = [
        low + 0.5 * (extent - (n - 1) * spacing) + np.arange(n) * spacing
        for low, extent, n in zip(free_space.origin, size, counts, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[clear_of_solids(free_space, grid, margin=margin)]
    if not len(grid):
        raise ValueError(f"no position of a grid of {spacing} m is free; reduce the spacing")
    solver = solver_of(table)
    directions, lengths, heard = {}, {}, {}
    for station in table.site.stations:
        of_station = solver.station(station.position)
        found = np.zeros((len(grid), 3))
        length = np.zeros(len(grid))
        for n, place in enumerate(grid):
            paths = of_station.paths(place)  # strongest first
            if len(paths):
                found[n] = direction(paths.azimuth[0], paths.zenith[0])
                length[n] = paths.path_length[0]
        directions[station.id], lengths[station.id], heard[station.id] = found, length, length > 0.0
    return RadioMap(spacing=spacing, position=grid, direction=directions, path_length=lengths, heard=heard)


@dataclass(frozen=True, kw_only=True)
class Fingerprinting:
    """The mean of the nearest positions of a map, weighted by the inverse of their distance in feature space.

    The distance is that of the measured angles and lengths in standard deviations, which combine the measurement's with
    the effect of half the map's spacing. Features that are not in the report are ignored.

    Attributes
    ----------
    radio_map : RadioMap
    site : SiteInfo
        Stations.
    neighbours : int
        Number of positions that are averaged.
    """

    radio_map: RadioMap
    site: SiteInfo
    neighbours: int = 4
    name: str = "fingerprinting"

    @classmethod
    def of_table(cls, table: Table, *, spacing: float = 0.5) -> "Fingerprinting":
        """Simulate the map of a table's site, which takes some milliseconds for each position and station."""
        return cls(radio_map=simulate_map(table, spacing=spacing), site=table.site)

    def locate(self, report: Report) -> Array | None:
        """Position of shape (3,), m, or None if the report has neither angles nor times."""
        columns = self._columns(sort_for_rivals(report, self.site))
        if not columns:
            return None
        places = np.concatenate([place for place, _ in columns], axis=1)
        measured = np.concatenate([value for _, value in columns])
        neighbours = NearestNeighbors(n_neighbors=min(self.neighbours, len(places)), algorithm="brute")
        (distance,), (index,) = neighbours.fit(places).kneighbors(measured[None])
        # A position with the distance 0 is the answer.
        weight = 1.0 / np.maximum(distance, 1e-9)
        return np.asarray(weight @ self.radio_map.position[index] / weight.sum())

    def _columns(self, report: PaperReport) -> list[tuple[Array, Array]]:
        """Features of all positions, shape (n, m), and of the report, shape (m,), for each measurement."""
        known, half = self.radio_map, 0.5 * self.radio_map.spacing
        columns = []
        for name, measured in report.directions.items():
            deviation = float(np.sqrt(0.5 * np.trace(measured.cov)))
            heard = known.heard[name]
            reach = float(np.median(known.path_length[name][heard])) if heard.any() else np.inf
            scale = float(np.hypot(deviation, half / reach))
            target = direction(measured.azimuth, measured.zenith)  # type: ignore[arg-type]  # single ones were refused
            columns.append(_features(known.direction[name] / scale, target / scale, heard))
        for name, (length, stdev) in report.ranges.items():
            scale = float(np.hypot(stdev, half))
            columns.append(
                _features(known.path_length[name][:, None] / scale, np.array([length / scale]), known.heard[name])
            )
        if report.reference is not None:
            for name, relative in report.differences.items():
                scale = float(np.hypot(relative.stdev, half))
                difference = known.path_length[name] - known.path_length[report.reference]
                both = known.heard[name] & known.heard[report.reference]
                target = np.array([relative.length_difference / scale])
                columns.append(_features(difference[:, None] / scale, target, both))
        return columns


def _features(places: Array, measured: Array, heard: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Features with an additional one that penalises positions that are not audible."""
    features = np.where(heard[:, None], places, measured)
    return np.column_stack([features, np.where(heard, 0.0, _UNHEARD)]), np.append(measured, 0.0)
