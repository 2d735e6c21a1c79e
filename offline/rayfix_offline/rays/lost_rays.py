"""Lost rays: the fraction of a station's rays that leave the scene, and where most of them do."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.launch import launch
from rayfix_offline.rays.rays import sample_rays
from rayfix_offline.scene.walls import opaque_walls
from rayfix_offline.site import StationSection
from rayfix_offline.twin.twin import Twin

LOST_RAYS_WARNING = 0.01
"""A scene that loses more than this fraction of its rays has holes."""

RAY_SPACING = 0.03
"""Spacing of the rays of the check, rad: 14,000 rays for each station."""

MAX_SEGMENTS = 4
"""Largest number of segments of a ray that are checked, whatever the site's number of reflections."""

CUBE_SIZE = 0.5
"""Side of the cubes in which lost rays are counted to find where most leave, m."""

ENDLESS = 1e9
"""Longer than any path, m."""


@dataclass(frozen=True, kw_only=True)
class Escapes:
    """Rays of a station that leave the scene.

    Attributes
    ----------
    share : float
        Fraction of all rays that leave, directly or after reflections.
    side : str or None
        Side of the bounding box through which most of them leave: "+x", "-x", and so on; None if no ray leaves.
    side_share : float
        Fraction of the lost rays that leave through it.
    place : tuple of float or None
        Where most of them cross the scene's bounding box, m; None if no ray leaves.
    place_share : float
        Fraction of the lost rays that cross it there, within half a metre.
    """

    station_id: str
    share: float
    side: str | None
    side_share: float
    place: tuple[float, float, float] | None
    place_share: float

    def moved(self, by: NDArray[np.float64]) -> "Escapes":
        """Return the same rays elsewhere, moved by a vector of shape (3,), m."""
        if self.place is None:
            return self
        x, y, z = (np.asarray(self.place) + by).tolist()
        return replace(self, place=(x, y, z))


def find_escapes(station: StationSection, twin: Twin, *, max_reflections: int) -> Escapes:
    """Launch 14,000 rays from a station and find those that leave the scene.

    Parameters
    ----------
    max_reflections : int
        Rays are traced over this many reflections, and over ``MAX_SEGMENTS`` segments at most.
    """
    rays = sample_rays(RAY_SPACING, np.random.default_rng(0))
    depth = min(max_reflections + 1, MAX_SEGMENTS)
    segments = launch(
        np.array(station.position_m),
        rays.directions,
        engine=twin.engine,
        planes=twin.planes,
        walls=opaque_walls(len(twin.scene.faces), loss_db=0.0),
        bounds=twin.scene.bounds,
        max_reflections=depth,
        max_path_length=ENDLESS,
    )
    # One segment more than is checked: a ray without it has left the scene before.
    lost = np.flatnonzero(np.diff(segments.offsets) <= depth)
    share = len(lost) / len(rays)
    if not len(lost):
        return Escapes(station_id=station.id, share=share, side=None, side_share=0.0, place=None, place_share=0.0)
    last = segments.offsets[lost + 1] - 1
    sequence, length = segments.sequence[last], segments.end[last]
    heading = np.einsum("nij,nj->ni", segments.sequences.mirrors[sequence], rays.directions[lost])
    ends = segments.sequences.images[sequence] + length[:, None] * heading
    place, count = _densest(ends)
    low, high = twin.scene.bounds
    sides = np.argmin(np.concatenate([ends - low, high - ends], axis=1), axis=1)
    side = int(np.bincount(sides, minlength=6).argmax())
    return Escapes(
        station_id=station.id,
        share=share,
        side="-+"[side // 3] + "xyz"[side % 3],
        side_share=float(np.mean(sides == side)),
        place=(float(place[0]), float(place[1]), float(place[2])),
        place_share=count / len(lost),
    )


def _densest(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """Mean and number of the points in the cube that has most."""
    cube = np.unique(np.floor(points / CUBE_SIZE), axis=0, return_inverse=True)[1].reshape(-1)
    fullest = np.bincount(cube).argmax()
    return points[cube == fullest].mean(axis=0), int(np.count_nonzero(cube == fullest))
