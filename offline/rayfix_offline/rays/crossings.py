"""Ways of rays through walls: sheets of a known thickness, and closed solids, which are one slab from face to face."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.hits import Lines, Mirrors, find_hits, starts_beside
from rayfix_offline.scene.engine import RayEngine
from rayfix_offline.scene.walls import Walls


@dataclass(frozen=True, kw_only=True)
class Barriers:
    """The scene that rays pass through.

    Attributes
    ----------
    offset : float, m
        Rays start again at this distance from a plane.
    max_inner_hits : int
        Largest number of faces of other objects within a solid.
    """

    engine: RayEngine
    planes: Mirrors
    walls: Walls
    bounds: NDArray[np.float64]
    offset: float
    max_inner_hits: int


@dataclass(frozen=True, kw_only=True)
class Crossings:
    """Ways through the walls that rays hit, one for each hit.

    Attributes
    ----------
    thickness : ndarray of shape (n,), m
        Of the wall, along its normal; NaN where it is not known.
    log_gain : ndarray of shape (n,)
        Logarithm to base 10 of the fraction of the power that passes; -inf where nothing does.
    excess : ndarray of shape (n,), m
        What the wall adds to the measured length.
    face : ndarray of int32, shape (n,)
        Triangle at which the ray leaves the wall.
    length : ndarray of shape (n,), m
        Path length there.
    approach : ndarray of shape (n,)
        Component of the ray's direction along that triangle's normal.
    leaving : ndarray of bool, shape (n,)
        The ray was within a solid that overlaps another, and leaves it.
    """

    thickness: NDArray[np.float64]
    log_gain: NDArray[np.float64]
    excess: NDArray[np.float64]
    face: NDArray[np.int32]
    length: NDArray[np.float64]
    approach: NDArray[np.float64]
    leaving: NDArray[np.bool_]


def cross_walls(
    lines: Lines,
    start: NDArray[np.float64],
    faces: NDArray[np.int32],
    reach: NDArray[np.float64],
    approach: NDArray[np.float64],
    scene: Barriers,
) -> Crossings:
    """Find the ways through the walls that rays hit.

    Parameters
    ----------
    start : ndarray of shape (n,), m
        Path lengths at which the rays start.
    faces, reach, approach
        Triangles that are hit, and the results of :func:`find_hits`.
    """
    walls = scene.walls
    thickness = walls.thickness[faces]
    face, length, slope = faces.copy(), reach.copy(), approach.copy()
    passes = walls.passable[faces]
    outwards = np.where(passes & (walls.solid[faces] >= 0), approach * _facing(faces, scene), 0.0)
    leaving = outwards > 0.0
    thickness[leaving] = ((reach - start) * np.abs(approach))[leaving]
    (entering,) = np.nonzero(outwards < 0.0)
    if len(entering):
        inner = _leave_solids(lines.only(entering), faces[entering], reach[entering], approach[entering], scene)
        face[entering], length[entering], slope[entering] = inner
        way = length[entering] - reach[entering]
        passes[entering] = way > 0.0
        thickness[entering] = np.where(way > 0.0, way * np.abs(approach[entering]), np.nan)
    log_gain, excess = np.full(len(faces), -np.inf), np.zeros(len(faces))
    log_gain[passes], excess[passes] = walls.transmitted(faces[passes], np.abs(approach[passes]), thickness[passes])
    return Crossings(
        thickness=thickness,
        log_gain=log_gain,
        excess=excess,
        face=face,
        length=length,
        approach=slope,
        leaving=leaving,
    )


def _facing(faces: NDArray[np.int32], scene: Barriers) -> NDArray[np.float64]:
    """Component of the outward normals of triangles along the normals of their planes, shape (n,): 1 or -1."""
    normals = scene.planes.normals[scene.planes.face_planes[faces]]
    return np.asarray(np.einsum("ij,ij->i", scene.walls.outward[faces], normals))


def _leave_solids(
    lines: Lines,
    entered: NDArray[np.int32],
    reach: NDArray[np.float64],
    approach: NDArray[np.float64],
    scene: Barriers,
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
    """Follow rays from the triangles at which they enter solids to those at which they leave them.

    What else is within a solid does not matter, unless it lets nothing through.

    Returns
    -------
    face, length, approach
        As in :class:`Crossings`; the length is that of the entry where the ray does not come out.
    """
    solid = scene.walls.solid[entered]
    face, length, slope = entered.copy(), reach.copy(), approach.copy()
    at, height, incline = entered.copy(), reach.copy(), approach.copy()
    inside = np.arange(len(entered))
    for _ in range(scene.max_inner_hits):
        if not len(inside):
            break
        own = lines.only(inside)
        aside = np.sign(incline[inside]) * scene.offset
        hits = scene.engine.first_hit(*starts_beside(own, height[inside], at[inside], aside, scene.planes))
        found, far, steep = find_hits(own, height[inside], hits, scene.planes, scene.bounds)
        found[found] = scene.walls.passable[hits[found]]
        inside, hits, far, steep = inside[found], hits[found], far[found], steep[found]
        at[inside], height[inside], incline[inside] = hits, far, steep
        out = (scene.walls.solid[hits] == solid[inside]) & (steep * _facing(hits, scene) > 0.0)
        face[inside[out]], length[inside[out]], slope[inside[out]] = hits[out], far[out], steep[out]
        inside = inside[~out]
    return face, length, slope
