"""A report's measurements and the maps of the paths that they came by, as the kernels take them."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.posterior.fused import StationFactor
from rayfix_service.fusion.product.unmodelled import NO_PATH
from rayfix_service.fusion.quadrature.blocks import BlockTree, StationPaths
from rayfix_service.fusion.quadrature.factor import PathFactor
from rayfix_service.tracking.drift import DriftModel, Key, Process
from rayfix_tables.table import Table

_PLACE = 0.4
"""Width of the blocks, m, between whose centres the weights of paths are interpolated.

Voxels of the path map have few rays each, and a report ten times a second would count their noise ten times: in the
bundled hall 58 % of the targets were in the 68 % ellipsoids with voxels of 0.2 m, 68 % with these.
"""

_AROUND = 0.8
"""Width of the blocks, m, whose paths a particle may have been measured by.

It is about what a particle moves between reports; in larger ones most paths do not reach its new place.
"""

Array = NDArray[np.float64]


class StationMap(NamedTuple):
    """Map of a station's paths: three groups of arrays as :func:`.path_kernels.propose` has them."""

    place: tuple[Any, ...]
    paths: tuple[Any, ...]
    geometry: tuple[Any, ...]


class Measured(NamedTuple):
    """Measurements of one path.

    Attributes
    ----------
    key : (str, int)
        Station, and number among its paths in the report.
    map, around : StationMap
        Of the paths to a place, and of those to somewhere around it.
    values : tuple
        Fields of a :class:`.quadrature.factor.PathFactor`, and the variance of the length, m2.
    whole : ndarray of shape (3,)
        Variances of azimuth and zenith, rad2, and of the length, m2; 0 for what was not measured.
    process : Process
        Of the station's errors.
    """

    key: Key
    map: StationMap
    around: StationMap
    values: tuple[tuple[Any, ...], float]
    whole: Array
    process: Process


class Stations:
    """The stations of a table, with what tracks with drifting errors need of them.

    Parameters
    ----------
    table : Table
    model : DriftModel
    """

    def __init__(self, table: Table, model: DriftModel) -> None:
        self.by_id = table.site.station_by_id
        self.processes: Mapping[str, Process] = {each.id: model.of(each) for each in table.site.stations}
        self._space = table.scene.free_space_in_table_frame
        self._paths = {name: p for name, part in table.parts.items() if (p := part.paths) is not None and len(p)}
        self._tree: BlockTree | None = None
        self._maps: dict[str, tuple[StationMap, StationMap]] = {}

    def examples(self) -> list[list[Measured]]:
        """Return an angle of a station, from which kernels can be compiled; nothing where no station has a map."""
        found = PathFactor(
            turn=np.eye(3),
            zenith=1.8,
            cov=np.array([0.01, 0.0, 0.01]),
            spreads=np.array([[0.99, 1.0]]),
            kinds=np.array([[0.0, 1.0, 0.0, np.inf]]),
            direct=1.0,
            reflected=1.0,
            outlier=1e-3,
            unmodelled=NO_PATH,
        )
        return [each for name in list(self._paths)[:1] if (each := self.measured([StationFactor(name, found)]))]

    def measured(self, factors: Sequence[StationFactor]) -> list[Measured] | None:
        """Put a report's factors and the maps together; None where a station has no map, or nothing was measured."""
        found: list[Measured] = []
        for station, factor in factors:
            if factor is None or station not in self._paths:
                return None
            near, around = self._maps_of(station)
            number = sum(each.key[0] == station for each in found)
            finite = factor.kinds[np.isfinite(factor.kinds[:, 3]), 3]
            length = float(finite.min()) if len(finite) else 0.0
            whole = np.array([factor.cov[0], factor.cov[2], length])
            whole = np.where(np.isfinite(whole), whole, 0.0)
            found.append(
                Measured(
                    key=(station, number),
                    map=near,
                    around=around,
                    # Here a path that the table does not know is an outlier.
                    values=(tuple(factor[:-1]), length),
                    whole=whole,
                    process=self.processes[station],
                )
            )
        return found or None

    def _maps_of(self, station: str) -> tuple[StationMap, StationMap]:
        found = self._maps.get(station)
        if found is None:
            paths = self._paths[station]
            if self._tree is None:
                self._tree = BlockTree(self._space, max(1, round(paths.voxel_size / self._space.voxel_size)))
            blocks = StationPaths(paths, self._tree)
            near, around = (_map_of(self._tree, blocks, width) for width in (_PLACE, _AROUND))
            found = self._maps[station] = near, around
        return found


def _map_of(tree: BlockTree, station: StationPaths, width: float) -> StationMap:
    """Map of blocks at least as wide, or of the largest."""
    n = next((n for n, level in enumerate(tree.levels) if level.size >= width), len(tree.levels) - 1)
    blocks = tree.levels[n]
    return StationMap(
        place=(np.array(tree.free_space.origin, np.float64), float(blocks.size), np.array(blocks.shape, np.int64)),
        paths=tuple(station.levels[n]),
        geometry=(station.images, station.mirrors, station.num_reflections),
    )
