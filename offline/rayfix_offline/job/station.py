"""Build one station's part of a table from shards, from a former table, and by fitting the remaining cells."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.fit.cells import FittedCells, assemble_changes, assemble_level
from rayfix_offline.job.engine import FittingEngine, Job
from rayfix_offline.job.plan import Block, StationPlan, updated_part_id
from rayfix_offline.job.previous_table import FormerStation, KeptCells
from rayfix_offline.job.shards import ShardStore
from rayfix_tables.level import Level
from rayfix_tables.part import StationPart, Update
from rayfix_tables.paths import PathMap

StationProgress = Callable[[str, int], None]
"""Called with the stage and the number of the station's cells that are done."""


@dataclass(frozen=True, kw_only=True)
class BuiltStation:
    """A station's part and its origin.

    Attributes
    ----------
    origin : {"built", "resumed", "updated", "kept"}
        Fitted now; some blocks from shards; some cells from a former table; the whole part from there.
    num_kept_cells : int
        Number of cells of the finest level taken from the former table.
    num_dropped : int
        Number of components dropped for want of a positive definite covariance; 0 for a part that was kept.
    """

    part: StationPart
    origin: str
    num_kept_cells: int
    num_dropped: int


def keep_station(plan: StationPlan, job: Job) -> BuiltStation | None:
    """Take a station's whole part from the former table, if it is still valid."""
    part = job.former.whole_part(plan, job.tolerance) if job.former else None
    if part is None:
        return None
    return BuiltStation(
        part=replace(part, station=plan.station), origin="kept", num_kept_cells=plan.num_finest_cells, num_dropped=0
    )


def build_station(plan: StationPlan, job: Job, engine: FittingEngine, report: StationProgress) -> BuiltStation:
    """Build a station's part; finished blocks are saved as shards.

    Parameters
    ----------
    engine : FittingEngine
        Traces the rays and fits the cells.
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
        if former is not None:
            report(f"{plan.station.id}: comparing", done)
            kept, missing = _split(missing, engine.keep(plan, former))
        launch = engine.launch(plan)
        job.store.save(f"{name}-launch", launch)
        parts |= kept
        num_kept = sum(len(cells.cells) for cells in kept.values())
        done += num_kept
        for block, fitted in engine.fit_blocks(plan, missing):
            parts[block.key] = fitted.joined(kept[block.key]) if block.key in kept else fitted
            job.store.save(f"{name}-{block.shard}", parts[block.key].to_arrays())
            done += len(block.cells)
            report(_stage(plan, job, block), done)
    levels = [_assemble_level(0, job, parts)]
    for n in range(1, len(job.site.table.windows_deg)):
        missing = [block for block in plan.blocks if block.level == n and block.key not in parts]
        for block, widened in engine.widen_blocks(plan, missing, *levels[-1]):
            parts[block.key] = widened
            job.store.save(f"{name}-{block.shard}", widened.to_arrays())
            done += len(block.cells)
            report(_stage(plan, job, block), done)
        levels.append(_assemble_level(n, job, parts))
    return BuiltStation(
        part=_assemble(plan, job, former, levels, launch),
        origin="updated" if num_kept else "resumed" if resumed else "built",
        num_kept_cells=num_kept,
        num_dropped=sum(int(fitted.dropped.sum()) for fitted in parts.values()),
    )


def _stage(plan: StationPlan, job: Job, block: Block) -> str:
    return f"{plan.station.id}: {job.site.table.windows_deg[block.level]:g} deg cells"


def _load(
    name: str, plan: StationPlan, store: ShardStore
) -> tuple[dict[str, Any] | None, dict[tuple[int, int], FittedCells]]:
    """Load the statistics of the launch and the finished blocks."""
    parts = {}
    for block in plan.blocks:
        arrays = store.load(f"{name}-{block.shard}")
        # With another block size, a shard of the same name has other cells.
        if arrays is not None and np.array_equal(arrays["cells"], block.cells):
            parts[block.key] = FittedCells.from_arrays(arrays)
    return store.load(f"{name}-launch"), parts


def _split(blocks: list[Block], kept: KeptCells) -> tuple[dict[tuple[int, int], FittedCells], list[Block]]:
    """Split blocks into kept cells, by block, and blocks of cells to fit."""
    parts, missing = {}, []
    for block in blocks:
        cells, rest = kept.split(block)
        if len(cells.cells):
            parts[block.key] = cells
        if len(rest.cells):
            missing.append(rest)
    return parts, missing


def _assemble_level(
    level: int, job: Job, parts: dict[tuple[int, int], FittedCells]
) -> tuple[Level, NDArray[np.float32]]:
    """Assemble the blocks of a level, and the changes of its cells."""
    grid = job.grid(level)
    blocks = [parts[key] for key in sorted(parts) if key[0] == level]
    return assemble_level(job.window(level), grid, blocks), assemble_changes(grid, blocks)


def _assemble(
    plan: StationPlan,
    job: Job,
    former: FormerStation | None,
    levels: list[tuple[Level, NDArray[np.float32]]],
    launch: dict[str, Any],
) -> StationPart:
    """Assemble the levels of a station."""
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
    return StationPart(
        station=plan.station,
        part_id=part_id,
        update=update,
        levels=tuple(level for level, _ in levels),
        lost_ray_share=float(launch["lost_ray_share"]),
        coverage=tuple(float(fraction) for fraction in launch["coverage"]),
        wall_coverage=tuple(float(fraction) for fraction in launch["wall_coverage"]),
        cut_power_share=float(launch["cut_power_share"]),
        paths=PathMap.from_arrays(launch).compacted,
    )
