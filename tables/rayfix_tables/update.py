"""How far a station's part is from a whole build, when cells were kept though their rays had changed a little."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Update:
    """Where an updated part comes from. A part without one is what a whole build makes, to the last bit.

    Attributes
    ----------
    exact_part_id : str
        ``part_id`` that a whole build would have given.
    former_part_id : str
        ``part_id`` of the part that cells were kept from.
    tolerance : float
        Largest change for which a cell was kept.
    cell_change : tuple of ndarray of float32, shape (n_cells,)
        By level: by how much of its mass the measure that the cell was fitted to differs at most from the one that it
        would be fitted to now; 0 where the cell is that of a whole build.
    """

    exact_part_id: str
    former_part_id: str
    tolerance: float
    cell_change: tuple[NDArray[np.float32], ...]

    @property
    def largest_change(self) -> float:
        """Largest change of any cell."""
        return max((float(change.max(initial=0.0)) for change in self.cell_change), default=0.0)

    @property
    def num_changed(self) -> int:
        """Number of cells that differ from those of a whole build."""
        return sum(int(np.count_nonzero(change)) for change in self.cell_change)
