"""Compiled loops on what a path passes through: sheets and closed parts of the mesh, with the thickness met.

A sheet is one wall. A closed part is one wall from where a segment enters it to where it leaves it, and its slab is as
thick as these two places are apart along the normal of the entered face. A segment that starts or ends inside (at a
station that is built into a wall, or at a bounce where another object stands on the mirror) passes the rest of it.
"""

from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rayfix_evaluation.truth.forward_kernels import END_MARGIN, grown, in_triangle

if TYPE_CHECKING:
    from rayfix_evaluation.truth.mirrors import MirrorScene

_OFF_FACE = 1e-6  # of the longest edge: distance from a face at which its sides are tested
_TILT = np.array([0.137, 0.291, 0.113])  # of a direction, so that a test ray meets no edges of aligned boxes


def inner_sides(
    corners: NDArray[np.float64], normals: NDArray[np.float64], solids: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Side of its triangles on which each closed part lies, by counting crossings of a ray.

    Parameters
    ----------
    corners : ndarray of shape (n_triangles, 3, 3), m
    normals : ndarray of shape (n_triangles, 3)
    solids : ndarray of int of shape (n_triangles,)
        Closed part of each triangle; -1 for none.

    Returns
    -------
    ndarray of int of shape (n_triangles,)
        1 if the part is where the normal points, -1 if on the other side, 0 for triangles of no part.
    """
    out = np.zeros(len(corners), np.int64)
    for solid in np.unique(solids[solids >= 0]):
        members = np.flatnonzero(solids == solid)
        a, b, c = (corners[members, k] for k in range(3))
        size = float(np.ptp(corners[members], axis=(0, 1)).max())
        for member in members:
            start = corners[member].mean(axis=0) + _OFF_FACE * size * normals[member]
            along = normals[member] + _TILT
            # Moeller and Trumbore's test of the ray with all triangles of the part.
            across = np.cross(along, c - a)
            area = np.einsum("ij,ij->i", b - a, across)
            with np.errstate(divide="ignore", invalid="ignore"):
                u = np.einsum("ij,ij->i", start - a, across) / area
                q = np.cross(start - a, b - a)
                v = q @ along / area
                reach = np.einsum("ij,ij->i", c - a, q) / area
            met = (area != 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (reach > 0.0)
            out[member] = 1 if np.count_nonzero(met) % 2 else -1
    return out


@njit(cache=True, nogil=True)
def walls_on_paths(
    scene: "MirrorScene", sequences: NDArray[np.int64], vertices: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the walls that paths pass through.

    Parameters
    ----------
    scene : MirrorScene
        Mirror planes and triangles.
    sequences : ndarray of int of shape (n_paths, max_reflections)
        Planes from the station to the point, then -1.
    vertices : ndarray of shape (n_paths, max_reflections + 2, 3), m
        Station, hits, point.

    Returns
    -------
    where : ndarray of int of shape (n_walls, 3)
        Path, segment and entered triangle of each passage, in the order from the station to the point.
    passages : ndarray of shape (n_walls, 5), m
        Place where the wall is entered, the cosine of the angle of incidence, and the thickness of a closed part, which
        is NaN for sheets.
    """
    capacity = 64
    where = np.empty((capacity, 3), np.int64)
    passages = np.empty((capacity, 5))
    count = 0
    shares = np.empty(64)
    triangles = np.empty(64, np.int64)
    for i in range(len(sequences)):
        n_hits = 0
        while n_hits < sequences.shape[1] and sequences[i, n_hits] >= 0:
            n_hits += 1
        for segment in range(n_hits + 1):
            skip_a = sequences[i, segment - 1] if segment > 0 else -1
            skip_b = sequences[i, segment] if segment < n_hits else -1
            start, end = vertices[i, segment], vertices[i, segment + 1]
            n_met, shares, triangles = _crossings(scene, start, end, skip_a, skip_b, shares, triangles)
            for j in range(n_met):
                triangle = triangles[j]
                solid = scene.triangle_solids[triangle]
                first, last = shares[j], -1.0
                if solid >= 0:
                    enters = _enters(scene, triangle, start, end)
                    if enters:
                        last = 1.0
                        for other in range(j + 1, n_met):
                            if scene.triangle_solids[triangles[other]] == solid:
                                last = shares[other]
                                break
                    else:
                        # Its entry has told of it, unless the segment starts inside.
                        entered = False
                        for other in range(j):
                            if scene.triangle_solids[triangles[other]] == solid:
                                entered = True
                                break
                        if entered:
                            continue
                        first, last = 0.0, shares[j]
                if count == capacity:
                    capacity *= 2
                    where, passages = grown(where, capacity), grown(passages, capacity)
                where[count, 0], where[count, 1], where[count, 2] = i, segment, triangle
                square = 0.0
                slope = 0.0
                for k in range(3):
                    along = end[k] - start[k]
                    square += along * along
                    slope += along * scene.triangle_normals[triangle, k]
                    passages[count, k] = start[k] + first * along
                passages[count, 3] = min(abs(slope) / np.sqrt(square), 1.0)
                passages[count, 4] = abs(slope) * (last - first) if solid >= 0 else np.nan
                count += 1
    return grown(where, count), grown(passages, count)


@njit(cache=True, nogil=True)
def depths_behind(scene: "MirrorScene", triangles: NDArray[np.int64], hits: NDArray[np.float64]) -> NDArray[np.float64]:
    """Thickness of closed parts behind hits, along the normal of the hit face.

    Parameters
    ----------
    scene : MirrorScene
        Mirror planes and triangles.
    triangles : ndarray of int of shape (n,)
        Hit triangles.
    hits : ndarray of shape (n, 3), m
        Places of the hits.

    Returns
    -------
    ndarray of shape (n,), m
        NaN for triangles of no closed part.
    """
    out = np.full(len(triangles), np.nan)
    shares = np.empty(64)
    met = np.empty(64, np.int64)
    end = np.empty(3)
    reach = 0.0
    for k in range(3):
        reach += (scene.box_high[0, k] - scene.box_low[0, k]) ** 2
    reach = np.sqrt(reach)
    for i in range(len(triangles)):
        solid = scene.triangle_solids[triangles[i]]
        if solid < 0:
            continue
        plane = scene.triangle_planes[triangles[i]]
        for k in range(3):
            end[k] = hits[i, k] + reach * scene.triangle_inside[triangles[i]] * scene.normals[plane, k]
        n_met, shares, met = _crossings(scene, hits[i], end, plane, -1, shares, met)
        for j in range(n_met):
            if scene.triangle_solids[met[j]] == solid:
                out[i] = shares[j] * reach
                break
    return out


@njit(cache=True, nogil=True)
def _enters(scene: "MirrorScene", triangle: int, start: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
    """Whether a segment goes into the closed part of a triangle that it crosses."""
    plane = scene.triangle_planes[triangle]
    slope = 0.0
    for k in range(3):
        slope += scene.normals[plane, k] * (end[k] - start[k])
    return bool(slope * scene.triangle_inside[triangle] > 0.0)


@njit(cache=True, nogil=True)
def _crossings(
    scene: "MirrorScene",
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    skip_a: int,
    skip_b: int,
    shares: NDArray[np.float64],
    triangles: NDArray[np.int64],
) -> tuple[int, NDArray[np.float64], NDArray[np.int64]]:
    """Open triangles on a segment, in order; each plane counts once for each closed part and once for sheets.

    Returns their number, and buffers with the shares of the segment before them and their indices.
    """
    count = 0
    x, y, z = start[0], start[1], start[2]
    dx, dy, dz = end[0] - x, end[1] - y, end[2] - z
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length <= 2.0 * END_MARGIN:
        return count, shares, triangles
    least = END_MARGIN / length
    box = 0
    while box < len(scene.box_skips):
        if not _meets_box(scene, box, start, end):
            box = scene.box_skips[box]
            continue
        for i in range(scene.box_starts[box], scene.box_ends[box]):
            triangle = scene.box_triangles[i]
            plane = scene.triangle_planes[triangle]
            if not scene.triangle_open[triangle] or plane in (skip_a, skip_b):
                continue
            nx = scene.triangle_normals[triangle, 0]
            ny = scene.triangle_normals[triangle, 1]
            nz = scene.triangle_normals[triangle, 2]
            slope = nx * dx + ny * dy + nz * dz
            if slope == 0.0:
                continue
            share = (scene.triangle_offsets[triangle] - (nx * x + ny * y + nz * z)) / slope
            if share <= least or share >= 1.0 - least:
                continue
            if not in_triangle(scene, triangle, x + share * dx, y + share * dy, z + share * dz):
                continue
            # A hit on an edge between triangles of one plane; the lower index counts, whatever the order of the boxes.
            known = False
            for j in range(count):
                if (
                    scene.triangle_planes[triangles[j]] == plane
                    and scene.triangle_solids[triangles[j]] == scene.triangle_solids[triangle]
                ):
                    triangles[j] = min(triangles[j], triangle)
                    known = True
                    break
            if known:
                continue
            if count == len(shares):
                more_shares, more_triangles = np.empty(2 * count), np.empty(2 * count, np.int64)
                for j in range(count):
                    more_shares[j], more_triangles[j] = shares[j], triangles[j]
                shares, triangles = more_shares, more_triangles
            place = count
            while place > 0 and (
                shares[place - 1] > share or (shares[place - 1] == share and triangles[place - 1] > triangle)
            ):
                shares[place], triangles[place] = shares[place - 1], triangles[place - 1]
                place -= 1
            shares[place], triangles[place] = share, triangle
            count += 1
        box += 1
    return count, shares, triangles


@njit(cache=True, nogil=True)
def _meets_box(scene: "MirrorScene", box: int, start: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
    """Whether a segment meets a box, by the overlap of its shares within the three pairs of planes."""
    low, high = 0.0, 1.0
    for k in range(3):
        along = end[k] - start[k]
        if along == 0.0:
            if start[k] < scene.box_low[box, k] or start[k] > scene.box_high[box, k]:
                return False
            continue
        a = (scene.box_low[box, k] - start[k]) / along
        b = (scene.box_high[box, k] - start[k]) / along
        low, high = max(low, min(a, b)), min(high, max(a, b))
        if low > high:
            return False
    return True
