"""Numbers that decide what the digital twin is made of: free space, mirrors and surfaces."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class TwinSettings:
    """Settings of the twin; part of the identity of every station's part of a table.

    Attributes
    ----------
    weld : float, m
        Vertices whose coordinates round to the same multiple of this are one point.
    plane_tolerance : float, m
        Triangles whose planes differ by less than this over the whole scene are coplanar.
    plane_rounding : float
        Planes are rounded to this fraction of the tolerance before they are compared.
    surface_angle : float, rad
        Normals of a curved surface lie within this angle of the normal of the facet that it grew from. A reflected ray
        turns by twice as much as the normal, so that at a distance D the rays of a surface lie on an arc of at most
        40 deg. One Gaussian replaces the arc, which bulges by 0.06 D. A full turn has 18 to 36 surfaces, whatever the
        number of facets.
    facet_size : float, m
        Flat patches larger than a square of this side, or than a strip half as wide, belong to no curved surface: the
        wall beside a rounded corner must not be blurred by the corner.
    touch : float, m
        A point closer to a surface than this lies on it.
    building_fraction : float
        A building takes up more than this fraction of the scene's bounding box.
    inner_fraction : float
        The inner faces of walls enclose more than this fraction of the volume that their outer faces enclose.
    max_parts : int
        Largest number of parts that are sampled to find what lies inside a building.
    voxel_size : float, m
        Edge of a voxel of the free space.
    max_voxels : int
        Voxels are enlarged if the free space would have more than this number.
    """

    weld: float = 1e-6
    plane_tolerance: float = 1e-3
    plane_rounding: float = 0.1
    surface_angle: float = math.radians(10.0)
    facet_size: float = 0.5
    touch: float = 1e-3
    building_fraction: float = 0.05
    inner_fraction: float = 0.5
    max_parts: int = 200
    voxel_size: float = 0.1
    max_voxels: int = 20_000_000
