"""The plan of a build: each station's cells in blocks, and an identity of all that decides their content."""

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.job.method import Method
from rayfix_offline.job.shards import content_key
from rayfix_offline.rays.trace import level_grid
from rayfix_offline.site import SiteFile, StationSection
from rayfix_offline.twin.twin import Twin
from rayfix_tables.disk.schema import ARRAYS_VERSION
from rayfix_tables.geometry.angles import direction
from rayfix_tables.geometry.mounting import board_to_scene
from rayfix_tables.site import Station

BUILD_VERSION = 9
"""Raised with every change of the code that changes a table; numbers that do are part of the method."""

BLOCK_CELLS = 256
"""Number of cells of one task and one shard."""

WIDE_BLOCK_CELLS = 64
"""The same for levels whose cells are sums of finer ones."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """Cells of one level that are fitted together.

    Attributes
    ----------
    level : int
    number : int
        Counted within the level.
    cells : ndarray of int64, shape (n,)
    """

    level: int
    number: int
    cells: NDArray[np.int64]

    @property
    def key(self) -> tuple[int, int]:
        """Level and number."""
        return self.level, self.number

    @property
    def shard(self) -> str:
        """Suffix of the name of the block's shard."""
        return f"{self.level}-{self.number}"

    def only(self, cells: NDArray[np.int64]) -> "Block":
        """Return the block with a subset of its cells."""
        return replace(self, cells=cells)


@dataclass(frozen=True, kw_only=True)
class StationPlan:
    """The plan of one station's part of the table.

    Attributes
    ----------
    part_id : str
        SHA-256 of all that decides the content of the part: scene, free space, propagation, table settings, position
        and field of view of the station, and the method with its version. Other stations have no influence.
    """

    section: StationSection
    station: Station
    part_id: str
    blocks: tuple[Block, ...]

    @property
    def finest_blocks(self) -> tuple[Block, ...]:
        """Blocks that are fitted to rays."""
        return tuple(block for block in self.blocks if block.level == 0)

    @property
    def num_finest_cells(self) -> int:
        """Number of cells to fit to rays."""
        return sum(len(block.cells) for block in self.finest_blocks)

    @property
    def num_cells(self) -> int:
        """Number of cells to make."""
        return sum(len(block.cells) for block in self.blocks)


def plan_build(site: SiteFile, twin: Twin, method: Method | None = None) -> tuple[StationPlan, ...]:
    """Plan the build of a site.

    Parameters
    ----------
    twin : Twin
        Prepared with the same method.
    method : Method, optional
    """
    method = method or Method()
    thickness = twin.scene.face_thickness
    common = content_key(
        BUILD_VERSION,
        ARRAYS_VERSION,
        method.identity(),
        twin.scene.sha256,
        hashlib.sha256(np.packbits(twin.free_space.free).tobytes()).hexdigest(),
        [*twin.free_space.origin.tolist(), twin.free_space.voxel_size, *twin.free_space.free.shape],
        hashlib.sha256(b"" if thickness is None else thickness.tobytes()).hexdigest(),
        {name: material.model_dump(mode="json") for name, material in site.materials.items()},
        site.propagation.model_dump(mode="json"),
        site.table.model_dump(mode="json"),
    )
    return tuple(
        StationPlan(
            section=section,
            station=station,
            part_id=content_key(common, section.built_from()),
            blocks=_blocks(station, site, method),
        )
        for section, station in zip(site.stations, site.info().stations, strict=True)
    )


def updated_part_id(exact_part_id: str, former_part_id: str, tolerance: float) -> str:
    """``part_id`` of a part with cells of a former part that have changed within the tolerance."""
    return content_key("updated", exact_part_id, former_part_id, tolerance)


def _blocks(station: Station, site: SiteFile, method: Method) -> tuple[Block, ...]:
    """Cells of each level whose centre lies within one window of the station's field of view, in blocks."""
    axis = board_to_scene(station)[:, 0]
    blocks: list[Block] = []
    for level, window in enumerate(np.deg2rad(site.table.windows_deg)):
        centres = level_grid(float(window), cells_per_window=method.rays.cells_per_window).centres
        angle = np.arccos(np.clip(direction(centres[:, 0], centres[:, 1]) @ axis, -1.0, 1.0))
        cells = np.flatnonzero(angle <= 0.5 * station.field_of_view + window)
        size = WIDE_BLOCK_CELLS if level else BLOCK_CELLS
        blocks.extend(
            Block(level=level, number=n, cells=cells[i : i + size]) for n, i in enumerate(range(0, len(cells), size))
        )
    return tuple(blocks)
