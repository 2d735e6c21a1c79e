"""Fitted cells: the result of a block, and its conversion to a shard and to a level."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.fit.em import fit_em
from rayfix_offline.fit.settings import CoarseFit, ExpectationMaximisation, TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.fit.wide_windows import sum_cells
from rayfix_offline.rays.trace import LevelRays
from rayfix_tables.compact.tubes import CompactTubes, compacted
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import COMPACT_UNBALANCED, Level

_COLUMNS = ("cells", "counts", "log_mass", "change", "dropped")
"""Fields of :class:`FittedCells` with a number for each cell."""


@dataclass(frozen=True, kw_only=True)
class FittedCells:
    """Fitted cells of a block.

    Attributes
    ----------
    cells : ndarray of int64, shape (n_cells,)
    counts : ndarray of int64, shape (n_cells,)
        Components of each cell.
    log_mass : ndarray of shape (n_cells,)
    change : ndarray of float32, shape (n_cells,)
        Bound on the change of the cell's measure since it was fitted, as a fraction of its mass; 0 if it was
        fitted to this scene.
    dropped : ndarray of int64, shape (n_cells,)
        Components of each cell that were dropped, see :class:`~rayfix_offline.fit.tubes.Fitted`; 0 for one of a table.
    mixture : CompactTubes
        Components of all cells, rounded to what the table holds: balance, wide cells and updates go on from them.
    """

    cells: NDArray[np.int64]
    counts: NDArray[np.int64]
    log_mass: NDArray[np.float64]
    change: NDArray[np.float32]
    dropped: NDArray[np.int64]
    mixture: CompactTubes

    @classmethod
    def of_level(cls, level: Level, cells: NDArray[np.int64], change: NDArray[np.float64]) -> "FittedCells":
        """Take cells out of a level, whose components are compact."""
        assert isinstance(level.mixture, CompactTubes)
        counts = level.cell_offsets[cells + 1] - level.cell_offsets[cells]
        return cls(
            cells=cells,
            counts=counts,
            log_mass=level.cell_log_mass[cells],
            change=change.astype(np.float32),
            dropped=np.zeros(len(cells), np.int64),
            mixture=level.mixture.take(_ranges(level.cell_offsets[cells], counts)),
        )

    def joined(self, other: "FittedCells") -> "FittedCells":
        """Return the cells of both, in ascending order."""
        cells = np.concatenate([self.cells, other.cells])
        order = np.argsort(cells)
        counts = np.concatenate([self.counts, other.counts])
        starts = np.cumsum(counts) - counts
        mixture = CompactTubes.concatenate([self.mixture, other.mixture], self.mixture.window)
        return FittedCells(
            cells=cells[order],
            counts=counts[order],
            log_mass=np.concatenate([self.log_mass, other.log_mass])[order],
            change=np.concatenate([self.change, other.change])[order],
            dropped=np.concatenate([self.dropped, other.dropped])[order],
            mixture=mixture.take(_ranges(starts[order], counts[order])),
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a shard."""
        columns = {name: getattr(self, name) for name in _COLUMNS}
        return columns | self.mixture.to_arrays()

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> "FittedCells":
        """Return the cells whose :meth:`to_arrays` gave these arrays."""
        return cls(**{name: arrays[name] for name in _COLUMNS}, mixture=CompactTubes.from_arrays(arrays))


def _ranges(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Concatenate ranges, given by their starts and lengths."""
    ends = np.cumsum(counts)
    return np.repeat(starts - (ends - counts), counts) + np.arange(counts.sum())


def fit_cells(cells: NDArray[np.int64], level: LevelRays, fit: TubeFit | ExpectationMaximisation) -> FittedCells:
    """Fit cells of a level to its rays."""
    centres = level.grid.centres[cells]
    if isinstance(fit, ExpectationMaximisation):
        fitted = fit_em(centres, cells, level, fit)
    else:
        fitted = fit_tubes(centres, level, fit)
    return FittedCells(
        cells=cells,
        counts=fitted.counts,
        log_mass=fitted.log_mass,
        change=np.zeros(len(cells), np.float32),
        dropped=fitted.dropped,
        mixture=compacted(fitted.mixture, level.window),
    )


def widen_cells(
    cells: NDArray[np.int64],
    window: float,
    grid: AngularGrid,
    finer: Level,
    finer_change: NDArray[np.float32],
    fit: CoarseFit,
) -> FittedCells:
    """Make cells of a wide window [rad] from those of the next finer level; see :func:`sum_cells`."""
    summed = sum_cells(grid.centres[cells], window, finer, finer_change, fit)
    return FittedCells(
        cells=cells,
        counts=summed.counts,
        log_mass=summed.log_mass,
        change=summed.change.astype(np.float32),
        dropped=summed.dropped,
        mixture=compacted(summed.mixture, window),
    )


def assemble_level(window: float, grid: AngularGrid, parts: Sequence[FittedCells]) -> Level:
    """Put the blocks of a level together.

    Parameters
    ----------
    window : float, rad
    parts : sequence of FittedCells
        In the order of their cells; cells that are in no part remain empty.
    """
    counts = np.zeros(grid.num_cells, np.int64)
    log_mass = np.full(grid.num_cells, -np.inf)
    for part in parts:
        counts[part.cells], log_mass[part.cells] = part.counts, part.log_mass
    return Level(
        window=window,
        grid=grid,
        cell_offsets=np.concatenate([[0], np.cumsum(counts)]),
        cell_log_mass=log_mass,
        mixture=CompactTubes.concatenate([part.mixture for part in parts], window),
        log_balance=COMPACT_UNBALANCED,
    )


def assemble_changes(grid: AngularGrid, parts: Sequence[FittedCells]) -> NDArray[np.float32]:
    """Put the changes of all cells of a level together, shape (n_cells,); 0 for cells that are in no part."""
    change = np.zeros(grid.num_cells, np.float32)
    for part in parts:
        change[part.cells] = part.change
    return change
