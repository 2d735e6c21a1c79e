"""Numbers that decide which rays are launched, and what becomes of them."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RaySettings:
    """Settings of the rays; part of the identity of every station's part of a table.

    Attributes
    ----------
    rays_per_window : float
        Rays lie this many times as close as the finest window's standard deviation.
    cells_per_window : float
        Cells are this many times as close as their window's standard deviation.
    mirror_offset : float
        A reflected ray starts this times (1 + largest coordinate in m) off its mirror.
    first_node : float, m
        Path length of the first slice node; shorter lengths belong to the first slice.
    slice_ratio : float
        Ratio of a slice node to the one before.
    prior_refinement : int
        Width of a voxel of the path prior, in voxels of the free space.
    prior_rays : float
        At the far end of the scene, the rays that fill the path prior lie this many of its voxels apart, or closer.
    prior_spacing : float, rad
        Rays that are launched for the path prior only are not closer than this.
    """

    rays_per_window: float = 3.0
    cells_per_window: float = 0.8
    mirror_offset: float = 1e-5
    first_node: float = 0.25
    slice_ratio: float = 1.2
    prior_refinement: int = 2
    prior_rays: float = 0.7
    prior_spacing: float = 0.0073
