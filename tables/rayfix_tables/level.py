"""A level: all cells of one station at one window."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.compact.tubes import CompactTubes
from rayfix_tables.grid import AngularGrid
from rayfix_tables.mixture import TubeMixture

WINDOW_RATIO = 1.25
"""A window's standard deviation is at least this times that of the measurements that it is used for."""

WIDE_RATIO = 1.28
"""Angles of more than this many deviations of the finest window are wide: they are integrated on the path map."""

UNBALANCED: NDArray[np.float32] = np.zeros(0, np.float32)
"""``log_balance`` of a level without one; read-only, like the mapped arrays that kernels are compiled for."""
UNBALANCED.flags.writeable = False

COMPACT_UNBALANCED: NDArray[np.float16] = np.zeros(0, np.float16)
"""The same of a level of compact components."""
COMPACT_UNBALANCED.flags.writeable = False


@dataclass(frozen=True, kw_only=True)
class Level:
    """All cells of one station at one window; from a table, the arrays are views of the mapped file.

    Attributes
    ----------
    window : float, rad
        Standard deviation of the cells' Gaussian window, along either tangent axis.
    cell_offsets : ndarray of int64, shape (n_cells + 1,)
        Components of cell ``c`` are those from ``cell_offsets[c]`` to ``cell_offsets[c + 1]``.
    cell_log_mass : ndarray of shape (n_cells,)
        Natural logarithm of the integral of the cell's measure; -inf for a cell without components.
    mixture : TubeMixture or CompactTubes
        Components of all cells, as the file has them: compact since version 5 of the format. Either is read in the same
        way; what a compact one is asked for is expanded, so that only few components should be asked for at a time.
    log_balance : ndarray of shape (n_components,) or (0,), float32, of compact components float16
        Added to the components' ``log_weight`` when positions are compared. The probabilities of the paths to each
        position then add up to 1, as closely as Gaussians permit. Empty if the level is not balanced.
    """

    window: float
    grid: AngularGrid
    cell_offsets: NDArray[np.int64]
    cell_log_mass: NDArray[np.float64]
    mixture: TubeMixture | CompactTubes
    log_balance: NDArray[Any] = field(default_factory=lambda: UNBALANCED)

    @property
    def num_cells(self) -> int:
        """Number of cells of the grid."""
        return self.grid.num_cells

    @property
    def num_components(self) -> int:
        """Number of components over all cells."""
        return len(self.mixture)

    @property
    def is_compact(self) -> bool:
        """Whether the components are compact."""
        return isinstance(self.mixture, CompactTubes)

    @property
    def expanded(self) -> "Level":
        """The level with all components in double precision, if they are compact."""
        if not isinstance(self.mixture, CompactTubes):
            return self
        return replace(self, mixture=self.mixture.expanded, log_balance=self.log_balance.astype(np.float32))

    def ranges(self, most: int) -> Iterator[tuple[int, int]]:
        """Split the cells into ranges (first, stop) of at most ``most`` components, or of one cell."""
        first = 0
        while first < self.num_cells:
            begin = int(self.cell_offsets[first])
            last = int(np.searchsorted(self.cell_offsets, begin + most, side="right")) - 1
            last = max(last, first + 1)
            yield first, last
            first = last

    def cell(self, index: int) -> TubeMixture:
        """Components of one cell."""
        return self.mixture[int(self.cell_offsets[index]) : int(self.cell_offsets[index + 1])]

    @property
    def num_bytes(self) -> int:
        """Size of the level's arrays in the file."""
        arrays = [self.grid.ring_cells, self.cell_offsets, self.cell_log_mass, self.log_balance]
        return sum(array.nbytes for array in arrays) + self.mixture.num_bytes
