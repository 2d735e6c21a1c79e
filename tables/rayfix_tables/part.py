"""A station's part of a table, as it is written and read."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.level import Level
from rayfix_tables.site import Station


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


@dataclass(frozen=True, kw_only=True)
class StationPart:
    """A station's part of a table.

    Attributes
    ----------
    levels : tuple of Level
        Finest first.
    lost_ray_share : float
        Share of the launched rays that left the scene without having come to their last reflection.
    coverage : tuple of float
        Share of the free space that is reached with at most 0, 1, 2, ... reflections.
    part_id : str
        Names all that decided the part's content, so that a later build can tell whether it is still right.
    update : Update, optional
        Of a part with cells that a whole build would have made slightly differently.
    """

    station: Station
    levels: tuple[Level, ...]
    lost_ray_share: float
    coverage: tuple[float, ...]
    part_id: str = ""
    update: Update | None = None
