"""The common data of a build's stations, and the protocol of the engines that trace and fit them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.fit.cells import FittedCells
from rayfix_offline.job.method import Method
from rayfix_offline.job.plan import Block, StationPlan
from rayfix_offline.job.previous_table import FormerStation, FormerTable, KeptCells
from rayfix_offline.job.shards import ShardStore
from rayfix_offline.rays.trace import StationTrace, level_grid, trace_station
from rayfix_offline.site import SiteFile
from rayfix_offline.twin.twin import Twin
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import Level

FittedBlocks = Iterator[tuple[Block, FittedCells]]
"""Fitted blocks, in the order in which they are finished."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """The common data of a build's stations.

    Attributes
    ----------
    method : Method
        Method by which the twin was prepared and cells are fitted.
    jobs : int
        Number of cells that are fitted at a time; -1 for one per core.
    former : FormerTable, optional
        Table whose cells are kept where their rays have not changed.
    tolerance : float
        Fraction of a cell's mass that may change before the cell is fitted again; with 0, a cell is kept only if it is
        equal to the last bit.
    """

    site: SiteFile
    twin: Twin
    method: Method
    store: ShardStore
    jobs: int
    former: FormerTable | None
    tolerance: float

    def window(self, level: int) -> float:
        """Return the standard deviation of the window of a level, rad."""
        return float(np.deg2rad(self.site.table.windows_deg[level]))

    def grid(self, level: int) -> AngularGrid:
        """Return the grid of the cells of a level."""
        return level_grid(self.window(level), cells_per_window=self.method.rays.cells_per_window)

    def trace(self, plan: StationPlan) -> StationTrace:
        """Trace a station's rays in this process."""
        rays, reflection = self.method.rays, self.method.reflection
        return trace_station(plan.section, self.site, self.twin, settings=rays, reflection=reflection, jobs=self.jobs)


class FittingEngine(Protocol):
    """Traces the rays of one station after the other, and fits its cells."""

    def keep(self, plan: StationPlan, former: FormerStation) -> KeptCells:
        """Trace a station's rays and find the cells of a former table that can be kept."""
        ...

    def launch(self, plan: StationPlan) -> dict[str, Any]:
        """Trace a station's rays, and return what :meth:`StationTrace.to_arrays` gives."""
        ...

    def fit_blocks(self, plan: StationPlan, blocks: list[Block]) -> FittedBlocks:
        """Fit blocks of the finest level of a station."""
        ...

    def widen_blocks(
        self, plan: StationPlan, blocks: list[Block], finer: Level, finer_change: NDArray[np.float32]
    ) -> FittedBlocks:
        """Make blocks of a wide level of a station from the next finer level."""
        ...
