"""A station's part of a table, as it is written and read."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.level import Level
from rayfix_tables.paths import PathMap
from rayfix_tables.site import Station


@dataclass(frozen=True, kw_only=True)
class Update:
    """Origin of an updated part. A part without this is bit-identical to that of a new build.

    Attributes
    ----------
    exact_part_id : str
        ``part_id`` of the part of a new build.
    former_part_id : str
        ``part_id`` of the part from which cells were kept.
    tolerance : float
        Largest change for which a cell was kept.
    cell_change : tuple of ndarray of float32, shape (n_cells,)
        For each level: bound on the difference between the measure that a cell was fitted to and the present one, as a
        fraction of its mass; 0 if the cell is that of a new build.
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
        """Number of cells that differ from those of a new build."""
        return sum(int(np.count_nonzero(change)) for change in self.cell_change)


@dataclass(frozen=True, kw_only=True)
class StationPart:
    """A station's part of a table.

    Attributes
    ----------
    levels : tuple of Level
        Finest first.
    lost_ray_share : float
        Fraction of the launched rays that left the scene before their last reflection.
    coverage : tuple of float
        Fraction of the free space that is reached with at most 0, 1, 2, ... reflections, through walls or not.
    wall_coverage : tuple of float
        Fraction of the free space that straight paths through at most 0, 1, 2, ... walls reach; empty where no wall
        lets signals through.
    cut_power_share : float
        Fraction of the launched power whose rays ended because they were too weak or had passed too many walls.
    part_id : str
        Hash of everything that determines the part's content; a later build compares it to decide whether to reuse the
        part.
    update : Update, optional
        For a part with cells that a new build would fit slightly differently.
    paths : PathMap, optional
        Tables of format versions 1 and 2 have none.
    """

    station: Station
    levels: tuple[Level, ...]
    lost_ray_share: float
    coverage: tuple[float, ...]
    part_id: str = ""
    wall_coverage: tuple[float, ...] = ()
    cut_power_share: float = 0.0
    update: Update | None = None
    paths: PathMap | None = None

    @property
    def is_compact(self) -> bool:
        """Whether components and paths are compact, as since version 5 of the format."""
        return all(level.is_compact for level in self.levels) and (self.paths is None or self.paths.is_compact)

    @property
    def num_bytes(self) -> int:
        """Size of the part's arrays in the file."""
        return sum(level.num_bytes for level in self.levels) + (self.paths.num_bytes if self.paths else 0)
