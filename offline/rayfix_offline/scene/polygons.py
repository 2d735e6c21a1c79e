"""Polygons cut into triangles that cover them and keep all of their corners.

A fan from the first corner covers convex polygons, but would close the doorway of a wall. Ear clipping (mapbox's
earcut) covers concave polygons and holes. It leaves out corners between collinear edges, which a neighbouring polygon
may have: triangles are cut there to keep the surface closed.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.placed import Remark, counted

FLAT = 0.01
"""A warning is given for polygons with corners farther than this fraction of their size from their plane."""

_IN_LINE = 1e-7
"""A corner nearer than this fraction of the polygon's size to an edge lies on it."""

_SAME_AREA = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Triangles:
    """Triangles of polygons.

    Attributes
    ----------
    faces : ndarray of int64, shape (n_faces, 3)
        Indices of vertices, as in the polygons.
    polygons : ndarray of int64, shape (n_faces,)
        Polygon of each triangle; ascending.
    crossing : ndarray of int64
        Polygons that cross themselves or have no area. No triangulation covers them: they are cut as a fan.
    bent : ndarray of int64
        Polygons whose corners do not lie in a plane.
    """

    faces: NDArray[np.int64]
    polygons: NDArray[np.int64]
    crossing: NDArray[np.int64]
    bent: NDArray[np.int64]

    def remarks(
        self, vertices: NDArray[np.float64], corners: NDArray[np.int64], starts: NDArray[np.int64]
    ) -> tuple[Remark, ...]:
        """Return remarks on the polygons of these triangles; see :func:`cut_polygons`."""
        found = []
        for which, what in (
            (self.crossing, "that cross themselves or have no area are cut as a fan, perhaps wrongly"),
            (self.bent, "not flat: which edges cut them is a guess"),
        ):
            if len(which):
                x, y, z = vertices[corners[starts[which[0]]]]
                number = counted(len(which), "polygon")
                found.append(
                    Remark(
                        kind="polygons",
                        problem=f"{number} {what} (the first has a corner at {x:g}, {y:g}, {z:g} of the file)",
                        remedy="cut them into triangles before the export",
                    )
                )
        return tuple(found)


def cut_polygons(
    vertices: NDArray[np.float64],
    corners: NDArray[np.int64],
    sizes: NDArray[np.int64],
    *,
    holes: Mapping[int, Sequence[NDArray[np.int64]]] | None = None,
) -> Triangles:
    """Cut polygons into triangles of the same orientation.

    Parameters
    ----------
    vertices : ndarray of shape (n_vertices, 3)
    corners : ndarray of int64, shape (sum of sizes,)
        Vertices of all polygons, one after the other.
    sizes : ndarray of int64, shape (n_polygons,)
        Corners of each; at least 3.
    holes : mapping of int to sequence of ndarray, optional
        Vertices of the holes of some polygons.
    """
    holes = holes or {}
    starts = np.cumsum(sizes) - sizes
    pierced = np.zeros(len(sizes), bool)
    pierced[list(holes)] = True
    faces: list[NDArray[np.int64]] = []
    owners: list[NDArray[np.int64]] = []
    crossing: list[int] = []
    bent: list[NDArray[np.int64]] = []
    for size in np.unique(sizes):
        own = np.flatnonzero((sizes == size) & ~pierced)
        if not len(own):
            continue
        rings = corners[starts[own][:, None] + np.arange(size)]
        if size == 3:
            faces.append(rings)
            owners.append(own)
            continue
        points = vertices[rings]
        normals, flat = _planes(points)
        bent.append(own[~flat])
        fanned, cut = _fans(rings, points, normals)
        faces.append(cut.reshape(-1, 3))
        owners.append(np.repeat(own[fanned], size - 2))
        for k in np.flatnonzero(~fanned):
            triangles = _ears(vertices, [rings[k]], normals[k])
            if triangles is None:
                crossing.append(int(own[k]))
                triangles = _fan(rings[k])
            faces.append(triangles)
            owners.append(np.full(len(triangles), own[k]))
    for number, inner in holes.items():
        ring = corners[starts[number] : starts[number] + sizes[number]]
        normals, flat = _planes(vertices[ring][None])
        if not flat[0]:
            bent.append(np.array([number]))
        triangles = _ears(vertices, [ring, *inner], normals[0])
        if triangles is None:
            crossing.append(number)
            triangles = _fan(ring)
        faces.append(triangles)
        owners.append(np.full(len(triangles), number))
    if not faces:
        none = np.zeros(0, np.int64)
        return Triangles(faces=none.reshape(0, 3), polygons=none, crossing=none, bent=none)
    polygons = np.concatenate(owners)
    order = np.argsort(polygons, kind="stable")
    return Triangles(
        faces=np.concatenate(faces)[order],
        polygons=polygons[order],
        crossing=np.sort(np.array(crossing, np.int64)),
        bent=np.sort(np.concatenate([*bent, np.zeros(0, np.int64)])),
    )


def _planes(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Area vectors of polygons, and which of them are flat; points have the shape (n, size, 3)."""
    middle = points.mean(axis=1, keepdims=True)
    with np.errstate(all="ignore"):
        off = points - middle
        normals = 0.5 * np.cross(off, np.roll(off, -1, axis=1)).sum(axis=1)
        area = np.linalg.norm(normals, axis=1)
        height = np.abs(np.einsum("nki,ni->nk", off, normals)).max(axis=1)
        size = np.abs(off).max(axis=(1, 2))
        # A polygon without an area has no plane; there is another warning for it.
        return normals, ~(height > FLAT * size * area)


def _fans(
    rings: NDArray[np.int64], points: NDArray[np.float64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which polygons a fan covers, and their fans, shape (n_covered, size - 2, 3).

    A covering fan's triangles all have the orientation of the polygon, and it does not turn a full circle. A
    quadrilateral has two fans.
    """
    size = rings.shape[1]
    fanned = _is_fan(points, normals)
    first = rings.copy()
    if size == 4:
        turned = ~fanned & _is_fan(np.roll(points, -1, axis=1), normals)
        first[turned] = np.roll(rings[turned], -1, axis=1)
        fanned |= turned
    first = first[fanned]
    inner = np.stack([first[:, 1:-1], first[:, 2:]], axis=2)
    return fanned, np.concatenate([np.broadcast_to(first[:, :1, None], (*inner.shape[:2], 1)), inner], axis=2)


def _is_fan(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.bool_]:
    with np.errstate(all="ignore"):
        rays = points[:, 1:] - points[:, :1]
        length = np.linalg.norm(normals, axis=1)
        up = normals / length[:, None]
        crosses = np.einsum("nki,ni->nk", np.cross(rays[:, :-1], rays[:, 1:]), up)
        dots = np.einsum("nki,nki->nk", rays[:, :-1], rays[:, 1:])
        turn = np.arctan2(crosses, dots).sum(axis=1)
        scale = np.einsum("nki,nki->nk", rays, rays).max(axis=1)
        thin = 1e-12 * scale
        return np.asarray((crosses > thin[:, None]).all(axis=1) & (turn < 2.0 * np.pi - 1e-6))


def _fan(ring: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([np.full(len(ring) - 2, ring[0]), ring[1:-1], ring[2:]], axis=1)


def _ears(
    vertices: NDArray[np.float64], rings: Sequence[NDArray[np.int64]], normal: NDArray[np.float64]
) -> NDArray[np.int64] | None:
    """Cut one polygon; the first ring is its outline. None if no triangulation covers it."""
    rings = [_without_repeats(vertices, ring) for ring in rings]
    rings = [ring for number, ring in enumerate(rings) if number == 0 or len(ring) >= 3]
    if len(rings[0]) < 3:
        return None
    corners = np.concatenate(rings)
    off = vertices[corners] - vertices[corners].mean(axis=0)
    extent, length = float(np.abs(off).max()), float(np.linalg.norm(normal))
    if not (np.isfinite(extent) and length > 1e-12 * extent**2):
        return None
    up = normal / length
    across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    across /= np.linalg.norm(across)
    flat = np.stack([off @ across, off @ np.cross(up, across)], axis=1) / extent
    ends = np.cumsum([len(ring) for ring in rings])
    cut = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), ends.astype(np.uint32))
    triangles = [(int(a), int(b), int(c)) for a, b, c in np.asarray(cut).reshape(-1, 3)]
    # Collinear corners make triangles without an area. They are left out; cuts at those corners replace them.
    triangles = [t for t in triangles if abs(_doubled(flat, t)) > _IN_LINE * _longest(flat, t)]
    triangles = [t if _doubled(flat, t) > 0.0 else (t[0], t[2], t[1]) for t in triangles]
    triangles = _cut_at_corners(flat, triangles)
    if not _covers(flat, ends, triangles):
        return None
    return corners[np.array(triangles, np.int64)]


def _without_repeats(vertices: NDArray[np.float64], ring: NDArray[np.int64]) -> NDArray[np.int64]:
    """Leave out corners with the same position as the one before."""
    points = vertices[ring]
    kept = ring[(points != np.roll(points, 1, axis=0)).any(axis=1)]
    return np.asarray(kept)


def _doubled(flat: NDArray[np.float64], triangle: tuple[int, int, int]) -> float:
    (ax, ay), (bx, by), (cx, cy) = flat[list(triangle)]
    return float((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))


def _longest(flat: NDArray[np.float64], triangle: tuple[int, int, int]) -> float:
    corners = flat[list(triangle)]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max())


def _cut_at_corners(flat: NDArray[np.float64], triangles: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Cut triangles where a corner lies on one of their edges."""
    done: list[tuple[int, int, int]] = []
    left = list(triangles)
    for _ in range(4 * len(flat) + len(left)):
        if not left:
            break
        triangle = left.pop()
        for turn in range(3):
            a, b, c = triangle[turn:] + triangle[:turn]
            edge = flat[b] - flat[a]
            square = float(edge @ edge)
            along = (flat - flat[a]) @ edge / (square or 1.0)
            aside = np.abs((flat - flat[a]) @ (-edge[1], edge[0])) / (np.sqrt(square) or 1.0)
            on = np.flatnonzero((aside < _IN_LINE) & (along > 1e-9) & (along < 1.0 - 1e-9))
            on = on[(on != a) & (on != b) & (on != c)]
            if len(on):
                middle = int(on[np.argmin(np.abs(along[on] - 0.5))])
                left += [(a, middle, c), (middle, b, c)]
                break
        else:
            done.append(triangle)
    return done + left


def _covers(flat: NDArray[np.float64], ends: NDArray[np.int64], triangles: list[tuple[int, int, int]]) -> bool:
    """Whether border and area of the triangles are those of the polygon."""
    sides = Counter((t[k], t[(k + 1) % 3]) for t in triangles for k in range(3))
    border = Counter({side: n - sides[side[::-1]] for side, n in sides.items() if n > sides[side[::-1]]})
    expected: Counter[tuple[int, int]] = Counter()
    whole, start = 0.0, 0
    for number, end in enumerate(ends):
        ring = list(range(start, int(end)))
        x, y = flat[ring].T
        area = float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
        # The outline runs counter-clockwise as seen from its normal, holes run clockwise.
        if (area < 0.0) == (number == 0):
            ring.reverse()
        expected.update(zip(ring, ring[1:] + ring[:1], strict=True))
        whole += abs(area) * (1.0 if number == 0 else -1.0)
        start = int(end)
    area = sum(_doubled(flat, t) for t in triangles)
    return border == expected and abs(area - whole) <= _SAME_AREA * abs(whole)
