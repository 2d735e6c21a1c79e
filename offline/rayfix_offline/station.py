"""Build one station's part of a table, from shards, from a former table, and by fitting what is left."""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from joblib import Parallel, delayed

from rayfix_offline.cells import FittedCells, assemble_changes, assemble_level, fit_cells
from rayfix_offline.former import FormerStation, FormerTable, KeptCells
from rayfix_offline.plan import Block, StationPlan, updated_part_id
from rayfix_offline.shards import ShardStore
from rayfix_offline.site import SiteFile
from rayfix_offline.trace import StationTrace, level_grid, trace_station
from rayfix_offline.twin import Twin
from rayfix_tables.table import StationPart
from rayfix_tables.update import Update
from rayfix_tables.write import StationContent

if TYPE_CHECKING:
    from rayfix_offline.cluster import Cluster

StationProgress = Callable[[str, int], None]
"""Called with the stage and the cells of the station that are done."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What the stations of a build share.

    Attributes
    ----------
    jobs : int
        Cells that are fitted at a time; -1 for one per core.
    former : FormerTable, optional
        Table whose cells are kept where their rays have not changed.
    tolerance : float
        Share of a cell's mass that may change before the cell is fitted again; with 0, a cell is only kept when it is
        the same to the last bit.
    """

    site: SiteFile
    twin: Twin
    store: ShardStore
    jobs: int
    former: FormerTable | None
    tolerance: float


@dataclass(frozen=True, kw_only=True)
class BuiltStation:
    """A station's part, and where it came from.

    Attributes
    ----------
    origin : {"built", "resumed", "updated", "kept"}
        Fitted now; some blocks from shards; some cells from a former table; all of it from there.
    num_kept_cells : int
        Cells taken from the former table.
    """

    content: StationContent
    origin: str
    num_kept_cells: int


def keep_station(plan: StationPlan, job: Job) -> BuiltStation | None:
    """Take a station's whole part from the former table, if it is still right."""
    part = job.former.whole_part(plan, job.tolerance) if job.former else None
    if part is None:
        return None
    return BuiltStation(content=_content_of(part), origin="kept", num_kept_cells=plan.num_cells)


def build_station(plan: StationPlan, job: Job, remote: "Cluster | None", report: StationProgress) -> BuiltStation:
    """Build a station's part; finished blocks are saved as shards.

    Parameters
    ----------
    remote : Cluster, optional
        Whose workers fit the cells.
    """
    former = job.former.station(plan, job.site) if job.former else None
    name = plan.part_id
    if former is not None and job.tolerance > 0.0:
        name = updated_part_id(plan.part_id, former.part.part_id, job.tolerance)
    launch, parts = _load(name, plan, job.store)
    resumed, num_kept = bool(parts), 0
    missing = [block for block in plan.blocks if block.key not in parts]
    if missing or launch is None:
        done = plan.num_cells - sum(len(block.cells) for block in missing)
        report(f"{plan.station.id}: tracing rays", done)
        kept: dict[tuple[int, int], FittedCells] = {}
        if remote is not None and former is None:
            launch, fitting = remote.launch(plan), remote.fit_blocks(plan, missing)
        else:
            trace = trace_station(plan.section, job.site, job.twin, jobs=job.jobs)
            if former is not None:
                report(f"{plan.station.id}: comparing", done)
                kept, missing = _split(missing, former.kept_cells(trace, job.tolerance))
            launch = trace.to_arrays()
            fitting = remote.fit_blocks(plan, missing) if remote else _fit_blocks(missing, trace, job)
        job.store.save(f"{name}-launch", launch)
        parts |= kept
        num_kept = sum(len(cells.cells) for cells in kept.values())
        done += num_kept
        for block, fitted in fitting:
            parts[block.key] = fitted.joined(kept[block.key]) if block.key in kept else fitted
            job.store.save(f"{name}-{block.shard}", parts[block.key].to_arrays())
            done += len(block.cells)
            report(f"{plan.station.id}: {job.site.table.windows_deg[block.level]:g} deg cells", done)
    return BuiltStation(
        content=_assemble(plan, job, former, parts, launch),
        origin="updated" if num_kept else "resumed" if resumed else "built",
        num_kept_cells=num_kept,
    )


def _load(
    name: str, plan: StationPlan, store: ShardStore
) -> tuple[dict[str, Any] | None, dict[tuple[int, int], FittedCells]]:
    """Load what the launch found out and the finished blocks."""
    parts = {}
    for block in plan.blocks:
        arrays = store.load(f"{name}-{block.shard}")
        if arrays is not None:
            parts[block.key] = FittedCells.from_arrays(arrays)
    return store.load(f"{name}-launch"), parts


def _split(blocks: list[Block], kept: KeptCells) -> tuple[dict[tuple[int, int], FittedCells], list[Block]]:
    """Divide blocks into the cells that are kept, by block, and blocks of the others."""
    parts, missing = {}, []
    for block in blocks:
        cells, rest = kept.split(block)
        if len(cells.cells):
            parts[block.key] = cells
        if len(rest.cells):
            missing.append(rest)
    return parts, missing


def _fit_blocks(blocks: list[Block], trace: StationTrace, job: Job) -> Iterator[tuple[Block, FittedCells]]:
    """Fit blocks in parallel; they come back in their order."""
    tasks = (delayed(fit_cells)(block.cells, trace.levels[block.level], job.site) for block in blocks)
    # The compiled kernels release the interpreter's lock, so threads share the rays without a copy; scikit-learn
    # holds it, so its fits need processes.
    prefer = "processes" if job.site.table.fit == "em" else "threads"
    results = Parallel(n_jobs=job.jobs, prefer=prefer, return_as="generator")(tasks)
    try:
        yield from zip(blocks, results, strict=True)
    finally:
        with warnings.catch_warnings():
            # An interrupted build gives tasks up on purpose; joblib need not warn of it.
            warnings.simplefilter("ignore", UserWarning)
            results.close()


def _assemble(
    plan: StationPlan,
    job: Job,
    former: FormerStation | None,
    parts: dict[tuple[int, int], FittedCells],
    launch: dict[str, Any],
) -> StationContent:
    """Put the blocks of a station together."""
    windows = np.deg2rad(job.site.table.windows_deg)
    grids = [level_grid(float(window)) for window in windows]
    by_level = [[parts[key] for key in sorted(parts) if key[0] == n] for n in range(len(windows))]
    part_id, update = plan.part_id, None
    change = tuple(assemble_changes(grid, blocks) for grid, blocks in zip(grids, by_level, strict=True))
    if former is not None and any(level.any() for level in change):
        part_id = updated_part_id(plan.part_id, former.part.part_id, job.tolerance)
        update = Update(
            exact_part_id=plan.part_id,
            former_part_id=former.part.part_id,
            tolerance=job.tolerance,
            cell_change=change,
        )
    return StationContent(
        part_id=part_id,
        update=update,
        levels=tuple(
            assemble_level(float(window), grid, blocks)
            for window, grid, blocks in zip(windows, grids, by_level, strict=True)
        ),
        lost_ray_share=float(launch["lost_ray_share"]),
        coverage=tuple(float(share) for share in launch["coverage"]),
    )


def _content_of(part: StationPart) -> StationContent:
    return StationContent(
        part_id=part.part_id,
        update=part.update,
        levels=part.levels,
        lost_ray_share=part.lost_ray_share,
        coverage=part.coverage,
    )
