"""Numbers that decide which rays are launched and how they are cut."""

from dataclasses import dataclass
from typing import Literal

PathKind = Literal["power", "uniform", "paper"]
"""Which path a station reports: strong ones preferred, any alike, or as in the paper."""


@dataclass(frozen=True, kw_only=True)
class RaySettings:
    """Settings of the rays; part of the identity of every station's part of a table.

    Attributes
    ----------
    rays_per_window : float
        Standard deviation of the finest window divided by the spacing of rays.
    cells_per_window : float
        Standard deviation of a window divided by the spacing of its cells.
    mirror_offset : float
        A reflected ray starts at this times (1 + largest coordinate in m) from its mirror.
    max_walls : int
        Largest number of walls that a path passes.
    straight_floor_db, mirrored_floor_db : float
        Where walls let signals through, paths end that lose more than this at walls: those without a reflection, and
        others.
    max_inner_hits : int
        Largest number of faces of other objects that a path meets within a solid wall.
    first_node : float, m
        Path length of the first slice node; shorter lengths belong to the first slice.
    slice_ratio : float
        Ratio of a slice node to the one before.
    prior_refinement : int
        Width of a voxel of the path prior, in voxels of the free space.
    prior_rays : float
        Largest spacing of the rays that fill the path prior, at the far end of the scene, in voxels of its map.
    prior_spacing : float, rad
        Smallest spacing of rays that are launched for the path prior only.
    path_floor_db : float
        The path map leaves out paths that are weaker than all paths to a place together by more than this.
    """

    rays_per_window: float = 3.0
    cells_per_window: float = 0.8
    mirror_offset: float = 1e-5
    max_walls: int = 8
    straight_floor_db: float = 60.0
    mirrored_floor_db: float = 40.0
    max_inner_hits: int = 16
    first_node: float = 0.25
    slice_ratio: float = 1.2
    prior_refinement: int = 2
    prior_rays: float = 0.7
    prior_spacing: float = 0.0073
    path_floor_db: float = 40.0
