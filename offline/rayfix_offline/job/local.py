"""The engine that uses the cores of this machine."""

import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from rayfix_offline.fit.cells import fit_cells, widen_cells
from rayfix_offline.job.engine import FittedBlocks, Job
from rayfix_offline.job.plan import Block, StationPlan
from rayfix_offline.job.previous_table import FormerStation, KeptCells
from rayfix_offline.rays.trace import StationTrace
from rayfix_tables.level import Level


class LocalEngine:
    """Threads or processes of this machine; the :class:`~rayfix_offline.job.engine.FittingEngine` without a cluster."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._traced: tuple[str, StationTrace] | None = None

    def has_traced(self, plan: StationPlan) -> bool:
        """Whether the station is the one that was traced last."""
        return self._traced is not None and self._traced[0] == plan.part_id

    def keep(self, plan: StationPlan, former: FormerStation) -> KeptCells:
        """See :meth:`~rayfix_offline.job.engine.FittingEngine.keep`."""
        return former.kept_cells(self._trace(plan), self._job.tolerance, jobs=self._job.jobs)

    def launch(self, plan: StationPlan) -> dict[str, Any]:
        """See :meth:`~rayfix_offline.job.engine.FittingEngine.launch`."""
        return self._trace(plan).to_arrays()

    def fit_blocks(self, plan: StationPlan, blocks: list[Block]) -> FittedBlocks:
        """Fit blocks in parallel; they come back in their order."""
        level, fit = self._trace(plan).finest, self._job.method.fit(self._job.site)
        tasks = (delayed(fit_cells)(block.cells, level, fit) for block in blocks)
        # The compiled kernels release the interpreter's lock, so threads share the rays without a copy; scikit-learn
        # holds it, so its fits need processes.
        prefer = "processes" if self._job.site.table.fit == "em" else "threads"
        return _in_parallel(blocks, tasks, self._job.jobs, prefer)

    def widen_blocks(
        self, plan: StationPlan, blocks: list[Block], finer: Level, finer_change: NDArray[np.float32]
    ) -> FittedBlocks:
        """Make blocks of a wide level in parallel; they come back in their order."""
        job = self._job
        if blocks:
            finer = finer.expanded  # once for all blocks, and not in each
        tasks = (
            delayed(widen_cells)(
                block.cells, job.window(block.level), job.grid(block.level), finer, finer_change, job.method.wide
            )
            for block in blocks
        )
        return _in_parallel(blocks, tasks, job.jobs, "threads")

    def _trace(self, plan: StationPlan) -> StationTrace:
        """Rays of a station, traced once."""
        if self._traced is None or self._traced[0] != plan.part_id:
            self._traced = None  # its memory is free before the next station's rays are traced
            self._traced = (plan.part_id, self._job.trace(plan))
        return self._traced[1]


def _in_parallel(blocks: list[Block], tasks: Iterable[Any], jobs: int, prefer: str) -> FittedBlocks:
    results = Parallel(n_jobs=jobs, prefer=prefer, return_as="generator")(tasks)
    try:
        yield from zip(blocks, results, strict=True)
    finally:
        with warnings.catch_warnings():
            # An interrupted build abandons tasks on purpose, of which joblib warns.
            warnings.simplefilter("ignore", UserWarning)
            results.close()
