"""Reuse of a former table: whole parts of stations, and cells whose rays have not changed.

A table contains its scene, its site and the identity of each part. A former station can therefore be traced again in
its former scene and be compared, cell by cell, with the trace in the new scene. Only parts that this version of the
software would build from the table's scene and site are used.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.fit.cells import FittedCells
from rayfix_offline.job.changes import cell_changes
from rayfix_offline.job.method import Method
from rayfix_offline.job.plan import Block, StationPlan, plan_build, updated_part_id
from rayfix_offline.rays.trace import StationTrace, trace_station
from rayfix_offline.scene.scene import Scene
from rayfix_offline.site import SiteFile, parse_site
from rayfix_offline.twin.twin import Twin, prepare_scene
from rayfix_tables.checked import open_checked
from rayfix_tables.errors import SiteError, TableError
from rayfix_tables.part import StationPart
from rayfix_tables.table import Table


@dataclass(frozen=True, kw_only=True)
class KeptCells:
    """Cells of a station's finest level that are kept.

    Attributes
    ----------
    part : StationPart
        Source of the cells.
    change : ndarray of shape (n_cells,)
        Bound on the change of each cell's measure since it was fitted; inf if it must be fitted again.
    """

    part: StationPart
    change: NDArray[np.float64]

    def split(self, block: Block) -> tuple[FittedCells, Block]:
        """Split a block into kept cells and cells to fit."""
        change = self.change[block.cells]
        kept = np.isfinite(change)
        cells = FittedCells.of_level(self.part.levels[0], block.cells[kept], change[kept])
        return cells, block.only(block.cells[~kept])


@dataclass(frozen=True, kw_only=True)
class FormerStation:
    """A station of a former table at the position of a station of the new one.

    Attributes
    ----------
    plan : StationPlan
        Plan of the former part.
    site, twin : SiteFile, Twin
        Site and twin of the former part.
    method : Method
        Method of both builds.
    """

    part: StationPart
    plan: StationPlan
    site: SiteFile
    twin: Twin
    method: Method

    def kept_cells(self, trace: StationTrace, tolerance: float, *, jobs: int = 1) -> KeptCells:
        """Find the cells whose change is within a tolerance.

        Parameters
        ----------
        trace : StationTrace
            Trace in the new scene.
        tolerance : float
            Largest change; with 0, only cells that are equal to the last bit.
        jobs : int
            Threads; -1 for one per core.
        """
        method = self.method
        former = trace_station(
            self.plan.section, self.site, self.twin, settings=method.rays, reflection=method.reflection, jobs=jobs
        )
        cutoff = method.fit(self.site).cutoff
        compared = cell_changes(former.finest, trace.finest, cutoff=cutoff, settings=method.comparison)
        change = np.full(len(compared), np.inf)
        for block in self.plan.finest_blocks:
            change[block.cells] = compared[block.cells]
        if self.part.update is not None:
            # The cell was kept before: changes add up, each as a fraction of the mass after it.
            change += self.part.update.cell_change[0] * (1.0 + change)
        return KeptCells(part=self.part, change=np.where(change <= tolerance, change, np.inf))


@dataclass(frozen=True, kw_only=True)
class FormerTable:
    """A table of an earlier build, and the method of the new one."""

    table: Table
    method: Method

    def whole_part(self, plan: StationPlan, tolerance: float) -> StationPart | None:
        """Return the part of a plan, or one that was updated to it within the tolerance."""
        for part in self.table.parts.values():
            update = part.update
            near = update is not None and update.exact_part_id == plan.part_id and update.largest_change <= tolerance
            if (part.part_id == plan.part_id or near) and part.is_compact and self._sound:
                return part
        return None

    def station(self, plan: StationPlan, site: SiteFile) -> FormerStation | None:
        """Return the former station at the position of a plan's, if its rays have the same launch directions.

        Positions are compared in the tables' frames.
        """
        part = self.table.parts.get(plan.station.id)
        if part is None or not part.is_compact or not self._sound or not self._inputs:
            return None
        former_site, twin, plans = self._inputs
        former = plans[plan.station.id]
        if former.station.position != plan.station.position:
            return None
        expected = part.part_id
        if part.update is not None:
            expected = part.update.exact_part_id
            if part.part_id != updated_part_id(expected, part.update.former_part_id, part.update.tolerance):
                return None
        if former_site.table != site.table or former.part_id != expected:
            return None
        return FormerStation(part=part, plan=former, site=former_site, twin=twin, method=self.method)

    @cached_property
    def _sound(self) -> bool:
        try:
            self.table.verify()
        except TableError:
            return False
        return True

    @cached_property
    def _inputs(self) -> tuple[SiteFile, Twin, dict[str, StationPlan]] | None:
        """Site, twin and plans of the table; None if this version of the software cannot read its site."""
        stored = self.table.scene.in_table_frame
        scene = Scene(
            vertices=np.array(stored.vertices),
            faces=np.array(stored.faces),
            face_materials=np.array(stored.face_materials),
            materials=stored.materials,
            face_objects=np.zeros(len(stored.faces), np.int32),
            objects=("scene",),
            face_thickness=stored.face_thickness,
        )
        try:
            site = parse_site(self.table.site.document).moved(-self.table.scene.origin)
        except SiteError:
            return None
        twin = prepare_scene(site, scene, self.method.twin)
        return site, twin, {plan.station.id: plan for plan in plan_build(site, twin, self.method)}


def read_former(
    path: Path, method: Method, *, required: bool, refused: Callable[[str], None] = lambda reason: None
) -> FormerTable | None:
    """Open a former table, checked in a separate process.

    Parameters
    ----------
    required : bool
        Whether a missing or invalid file is an error; otherwise there is no former table.
    refused : callable, optional
        Called with the reason when an existing file is not used.

    Raises
    ------
    TableError
        When a required table cannot be read.
    """
    try:
        return FormerTable(table=open_checked(path, whole=False), method=method)
    except TableError as error:
        if required:
            raise
        if path.exists() and path.stat().st_size:
            refused(f"the existing table is not reused: {error}")
        return None
