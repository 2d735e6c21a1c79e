"""Build one station's part of a table, from shards, from a former table, and by fitting what is left."""

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from rayfix_offline.fit.cells import FittedCells, assemble_changes, assemble_level, fit_cells, widen_cells
from rayfix_offline.job.method import Method
from rayfix_offline.job.plan import Block, StationPlan, updated_part_id
from rayfix_offline.job.previous_table import FormerStation, FormerTable, KeptCells
from rayfix_offline.job.shards import ShardStore
from rayfix_offline.rays.trace import StationTrace, level_grid, trace_station
from rayfix_offline.site import SiteFile
from rayfix_offline.twin.twin import Twin
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import Level
from rayfix_tables.table import StationPart
from rayfix_tables.update import Update
from rayfix_tables.write import StationContent

if TYPE_CHECKING:
    from rayfix_offline.job.cluster import Cluster

StationProgress = Callable[[str, int], None]
"""Called with the stage and the cells of the station that are done."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What the stations of a build share.

    Attributes
    ----------
    method : Method
        By which the twin was prepared, and cells are fitted.
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
    method: Method
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
        Cells of the finest level taken from the former table.
    num_dropped : int
        Components that were dropped, because they had no positive definite covariance; 0 for a part that was kept.
    """

    content: StationContent
    origin: str
    num_kept_cells: int
    num_dropped: int


def keep_station(plan: StationPlan, job: Job) -> BuiltStation | None:
    """Take a station's whole part from the former table, if it is still right."""
    part = job.former.whole_part(plan, job.tolerance) if job.former else None
    if part is None:
        return None
    return BuiltStation(content=_content_of(part), origin="kept", num_kept_cells=plan.num_finest_cells, num_dropped=0)


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
    done = sum(len(fitted.cells) for fitted in parts.values())
    missing = [block for block in plan.finest_blocks if block.key not in parts]
    if missing or launch is None:
        report(f"{plan.station.id}: tracing rays", done)
        kept: dict[tuple[int, int], FittedCells] = {}
        if remote is not None and former is None:
            launch, fitting = remote.launch(plan), remote.fit_blocks(plan, missing)
        else:
            trace = trace_station(
                plan.section,
                job.site,
                job.twin,
                settings=job.method.rays,
                reflection=job.method.reflection,
                jobs=job.jobs,
            )
            if former is not None:
                report(f"{plan.station.id}: comparing", done)
                kept, missing = _split(missing, former.kept_cells(trace, job.tolerance, jobs=job.jobs))
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
            report(_stage(plan, job, block), done)
    levels = [_assemble_level(0, job, parts)]
    for n in range(1, len(job.site.table.windows_deg)):
        missing = [block for block in plan.blocks if block.level == n and block.key not in parts]
        widening = (
            remote.widen_blocks(plan, missing, *levels[-1]) if remote else _widen_blocks(missing, *levels[-1], job)
        )
        for block, widened in widening:
            parts[block.key] = widened
            job.store.save(f"{name}-{block.shard}", widened.to_arrays())
            done += len(block.cells)
            report(_stage(plan, job, block), done)
        levels.append(_assemble_level(n, job, parts))
    return BuiltStation(
        content=_assemble(plan, job, former, levels, launch),
        origin="updated" if num_kept else "resumed" if resumed else "built",
        num_kept_cells=num_kept,
        num_dropped=sum(int(fitted.dropped.sum()) for fitted in parts.values()),
    )


def _stage(plan: StationPlan, job: Job, block: Block) -> str:
    return f"{plan.station.id}: {job.site.table.windows_deg[block.level]:g} deg cells"


def _load(
    name: str, plan: StationPlan, store: ShardStore
) -> tuple[dict[str, Any] | None, dict[tuple[int, int], FittedCells]]:
    """Load what the launch found out and the finished blocks."""
    parts = {}
    for block in plan.blocks:
        arrays = store.load(f"{name}-{block.shard}")
        # Blocks of another size are other cells under the same name.
        if arrays is not None and np.array_equal(arrays["cells"], block.cells):
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
    fit = job.method.fit(job.site)
    tasks = (delayed(fit_cells)(block.cells, trace.finest, fit) for block in blocks)
    # The compiled kernels release the interpreter's lock, so threads share the rays without a copy; scikit-learn
    # holds it, so its fits need processes.
    return _in_parallel(blocks, tasks, job.jobs, "processes" if job.site.table.fit == "em" else "threads")


def _widen_blocks(
    blocks: list[Block], finer: Level, finer_change: NDArray[np.float32], job: Job
) -> Iterator[tuple[Block, FittedCells]]:
    """Make blocks of a wide level in parallel; they come back in their order."""
    tasks = (
        delayed(widen_cells)(block.cells, window, _grid(window, job), finer, finer_change, job.method.wide)
        for block in blocks
        for window in [_window(block.level, job)]
    )
    return _in_parallel(blocks, tasks, job.jobs, "threads")


def _in_parallel(
    blocks: list[Block], tasks: Iterable[Any], jobs: int, prefer: str
) -> Iterator[tuple[Block, FittedCells]]:
    results = Parallel(n_jobs=jobs, prefer=prefer, return_as="generator")(tasks)
    try:
        yield from zip(blocks, results, strict=True)
    finally:
        with warnings.catch_warnings():
            # An interrupted build gives tasks up on purpose; joblib need not warn of it.
            warnings.simplefilter("ignore", UserWarning)
            results.close()


def _window(level: int, job: Job) -> float:
    return float(np.deg2rad(job.site.table.windows_deg[level]))


def _grid(window: float, job: Job) -> AngularGrid:
    return level_grid(window, cells_per_window=job.method.rays.cells_per_window)


def _assemble_level(
    level: int, job: Job, parts: dict[tuple[int, int], FittedCells]
) -> tuple[Level, NDArray[np.float32]]:
    """Put the blocks of a level together, and the changes of its cells."""
    window = _window(level, job)
    grid = _grid(window, job)
    blocks = [parts[key] for key in sorted(parts) if key[0] == level]
    return assemble_level(window, grid, blocks), assemble_changes(grid, blocks)


def _assemble(
    plan: StationPlan,
    job: Job,
    former: FormerStation | None,
    levels: list[tuple[Level, NDArray[np.float32]]],
    launch: dict[str, Any],
) -> StationContent:
    """Put the levels of a station together."""
    part_id, update = plan.part_id, None
    change = tuple(change for _, change in levels)
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
        levels=tuple(level for level, _ in levels),
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
