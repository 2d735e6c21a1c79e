"""What a former table still holds of the table to be: whole parts of stations, and cells whose rays have not changed.

A table carries its scene, its site and what decided each part, so a former station can be traced again in its former
scene and compared, cell by cell, with the trace in the new one. Only parts that this version of the software would make
from what the table carries are taken.
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
from rayfix_tables.table import StationPart, Table


@dataclass(frozen=True, kw_only=True)
class KeptCells:
    """Cells of a station's finest level that need not be fitted again.

    Attributes
    ----------
    part : StationPart
        That they come from.
    change : ndarray of shape (n_cells,)
        Bound on the change of each cell's measure since it was fitted; inf where it must be fitted again.
    """

    part: StationPart
    change: NDArray[np.float64]

    def split(self, block: Block) -> tuple[FittedCells, Block]:
        """Divide a block into the cells that are kept and those that must be fitted."""
        change = self.change[block.cells]
        kept = np.isfinite(change)
        cells = FittedCells.of_level(self.part.levels[0], block.cells[kept], change[kept])
        return cells, block.only(block.cells[~kept])


@dataclass(frozen=True, kw_only=True)
class FormerStation:
    """A station of a former table that stands where one of the new table stands.

    Attributes
    ----------
    plan : StationPlan
        By which the part was built.
    site, twin : SiteFile, Twin
        For which the part was built.
    method : Method
        By which it was built, and the new one will be.
    """

    part: StationPart
    plan: StationPlan
    site: SiteFile
    twin: Twin
    method: Method

    def kept_cells(self, trace: StationTrace, tolerance: float, *, jobs: int = 1) -> KeptCells:
        """Find the cells that have changed no more than a tolerance.

        Parameters
        ----------
        trace : StationTrace
            In the new scene.
        tolerance : float
            Largest change; with 0, only cells that are the same to the last bit.
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
            # The cell was kept before: the changes add up, each as a share of the mass after it.
            change += self.part.update.cell_change[0] * (1.0 + change)
        return KeptCells(part=self.part, change=np.where(change <= tolerance, change, np.inf))


@dataclass(frozen=True, kw_only=True)
class FormerTable:
    """A table that was built before, and the method that the new one is built by."""

    table: Table
    method: Method

    def whole_part(self, plan: StationPlan, tolerance: float) -> StationPart | None:
        """Return the part that a plan asks for, or one that was updated to it within the tolerance."""
        for part in self.table.parts.values():
            update = part.update
            near = update is not None and update.exact_part_id == plan.part_id and update.largest_change <= tolerance
            if (part.part_id == plan.part_id or near) and self._sound:
                return part
        return None

    def station(self, plan: StationPlan, site: SiteFile) -> FormerStation | None:
        """Return the station that stood where a plan's does, if its rays start in the same directions."""
        part = self.table.parts.get(plan.station.id)
        if part is None or part.station.position != plan.station.position or not self._sound or not self._inputs:
            return None
        former_site, twin, plans = self._inputs
        former = plans[plan.station.id]
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
        """Site, scene and plans that the table was built from, none if this software reads them in another way."""
        stored = self.table.scene
        scene = Scene(
            vertices=np.array(stored.vertices),
            faces=np.array(stored.faces),
            face_materials=np.array(stored.face_materials),
            materials=stored.materials,
            face_objects=np.zeros(len(stored.faces), np.int32),
            objects=("scene",),
        )
        try:
            site = parse_site(self.table.site.document)
        except SiteError:
            return None
        twin = prepare_scene(site, scene, self.method.twin)
        return site, twin, {plan.station.id: plan for plan in plan_build(site, twin, self.method)}


def read_former(
    path: Path, method: Method, *, required: bool, refused: Callable[[str], None] = lambda reason: None
) -> FormerTable | None:
    """Open a former table, checked in a process of its own.

    Parameters
    ----------
    required : bool
        Whether a file that is missing or no table is an error, or just no former table.
    refused : callable, optional
        Told why a file that is there is not taken.

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
            refused(f"nothing is taken over from the table that was there: {error}")
        return None
