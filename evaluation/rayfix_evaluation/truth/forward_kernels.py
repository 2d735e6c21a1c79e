"""Compiled loops of the forward solver: tracing paths and testing what blocks them.

They work on the named tuples of :mod:`rayfix_evaluation.truth.images`. A side of a plane is the sign of the
distance along its normal. The tolerances:

- ``SIDE_MARGIN``: a vertex next to a bounce must be this far off the mirror, which excludes paths through the edge
  between two walls;
- ``END_MARGIN``: an obstacle this close to an end of a segment does not block it. Triangles of the mirrors at the
  segment's ends never block it, even at grazing incidence;
- ``EDGE_TOLERANCE``: triangles are enlarged by this, to find hits on edges. They are found only once, because sequences
  of planes are counted, not of triangles.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rayfix_evaluation.truth.mirrors import ImageTree, MirrorScene

SIDE_MARGIN = 1e-6
"""Smallest distance [m] of a path's vertex from the mirror before or after it."""
END_MARGIN = 1e-6
"""Length [m] at both ends of a segment where nothing blocks it."""
EDGE_TOLERANCE = 1e-7
"""Distance [m] outside a triangle's edge that still counts as a hit."""


@njit(cache=True, nogil=True)
def trace_paths(
    scene: "MirrorScene",
    tree: "ImageTree",
    point: NDArray[np.float64],
    max_reflections: int,
    max_path_length: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Find every path between a station and a point.

    Parameters
    ----------
    scene : MirrorScene
        The mirror planes and triangles.
    tree : ImageTree
        Image sources of the station.
    point : ndarray of shape (3,), m
        The other end.
    max_reflections : int
        Largest number of reflections.
    max_path_length : float
        Largest length of a path, m.

    Returns
    -------
    sequences : ndarray of int of shape (n_paths, max_reflections)
        Planes from the station to the point, then -1.
    vertices : ndarray of shape (n_paths, max_reflections + 2, 3), m
        Station, hits, point; the remaining rows repeat the point.
    unfolded : ndarray of shape (n_paths, 3), m
        The point mirrored back into the station's space: the straight line from the station to it has the
        path's length and first direction.
    """
    n_planes = len(scene.normals)
    capacity = 64
    out_sequences = np.empty((capacity, max_reflections), np.int64)
    out_vertices = np.empty((capacity, 3 * (max_reflections + 2)))
    count = 0
    sequence = np.full(max_reflections, -1, np.int64)
    vertices = np.empty((max_reflections + 2, 3))
    hit = np.empty(3)
    # The point's distance from every plane, and the point mirrored at it.
    depths = np.empty(n_planes)
    mirrored = np.empty((n_planes, 3))
    for plane in range(n_planes):
        depths[plane] = plane_distance(scene, plane, point)
        for k in range(3):
            mirrored[plane, k] = point[k] - 2.0 * depths[plane] * scene.normals[plane, k]
    square_limit = max_path_length**2

    for node in range(len(tree.images)):
        apex = tree.images[node]
        last = tree.planes[node]
        height = 0.0
        side = 0
        if last >= 0:
            height = plane_distance(scene, last, apex)
            side = 0 if height > 0.0 else 1
        # plane -1 is the path that ends here without another reflection: only the direct one, because longer sequences
        # are reached as (parent, plane).
        for plane in range(-1 if node == 0 else 0, n_planes if max_reflections > 0 else 0):
            n_hits = 0
            if plane >= 0:
                if last >= 0 and not scene.facing[last, side, plane]:
                    continue
                depth = depths[plane]
                distance = plane_distance(scene, plane, apex)
                if depth * distance <= 0.0 or abs(depth) < SIDE_MARGIN or abs(distance) < SIDE_MARGIN:
                    continue
                share = distance / (distance + depth)
                inside = True
                square = 0.0
                for k in range(3):
                    along = mirrored[plane, k] - apex[k]
                    square += along * along
                    hit[k] = apex[k] + share * along
                    if hit[k] < scene.plane_low[plane, k] or hit[k] > scene.plane_high[plane, k]:
                        inside = False
                        break
                if not inside or square > square_limit:
                    continue
                n_hits = _trace_back(scene, tree, node, plane, height, hit, sequence, vertices)
                if n_hits == 0:
                    continue
            else:
                square = 0.0
                for k in range(3):
                    square += (point[k] - apex[k]) ** 2
                    vertices[0, k] = apex[k]
                if square > square_limit or square < END_MARGIN**2:
                    continue
            for row in range(n_hits + 1, max_reflections + 2):
                for k in range(3):
                    vertices[row, k] = point[k]
            for row in range(n_hits, max_reflections):
                sequence[row] = -1
            if not _is_path(scene, sequence, vertices, n_hits):
                continue
            if count == capacity:
                capacity *= 2
                out_sequences, out_vertices = grown(out_sequences, capacity), grown(out_vertices, capacity)
            for row in range(max_reflections):
                out_sequences[count, row] = sequence[row]
            for row in range(max_reflections + 2):
                for k in range(3):
                    out_vertices[count, 3 * row + k] = vertices[row, k]
            count += 1
    unfolded = np.empty((count, 3))
    for i in range(count):
        for k in range(3):
            unfolded[i, k] = point[k]
        for row in range(max_reflections - 1, -1, -1):
            plane = out_sequences[i, row]
            if plane >= 0:
                distance = plane_distance(scene, plane, unfolded[i])
                for k in range(3):
                    unfolded[i, k] -= 2.0 * distance * scene.normals[plane, k]
    vertices_of_paths = grown(out_vertices, count).reshape((count, max_reflections + 2, 3))
    return grown(out_sequences, count), vertices_of_paths, unfolded


@njit(cache=True, nogil=True)
def hit_triangles(
    scene: "MirrorScene", sequences: NDArray[np.int64], vertices: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Find the triangles that paths are reflected at.

    Parameters
    ----------
    scene : MirrorScene
        The mirror planes and triangles.
    sequences : ndarray of int of shape (n_paths, max_reflections)
        Planes from the station to the point, then -1.
    vertices : ndarray of shape (n_paths, max_reflections + 2, 3), m
        Station, hits, point.

    Returns
    -------
    ndarray of int of shape (n_paths, max_reflections)
        The first triangle of the plane that holds the hit and reflects on this side, -1 where there is no bounce.
    """
    out = np.full(sequences.shape, -1)
    for i in range(sequences.shape[0]):
        for bounce in range(sequences.shape[1]):
            plane = sequences[i, bounce]
            if plane < 0:
                break
            x, y, z = vertices[i, bounce + 1]
            side = plane_distance(scene, plane, vertices[i, bounce])
            out[i, bounce] = _reflecting(scene, plane, side, x, y, z)
    return out


@njit(cache=True, nogil=True)
def visible(scene: "MirrorScene", start: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the straight segments from one point to others cross no triangle.

    Parameters
    ----------
    scene : MirrorScene
        The triangles.
    start : ndarray of shape (3,), m
        Common start of the segments.
    ends : ndarray of shape (n, 3), m
        Their ends.

    Returns
    -------
    ndarray of bool of shape (n,)
        True where nothing lies between.
    """
    out = np.empty(len(ends), np.bool_)
    for i in range(len(ends)):
        out[i] = not _blocked(scene, start, ends[i], -1, -1, True)
    return out


@njit(cache=True, nogil=True)
def visible_through(scene: "MirrorScene", start: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether nothing opaque crosses the straight segments from one point to others; see :func:`visible`."""
    out = np.empty(len(ends), np.bool_)
    for i in range(len(ends)):
        out[i] = not _blocked(scene, start, ends[i], -1, -1, False)
    return out


@njit(cache=True, nogil=True)
def _trace_back(
    scene: "MirrorScene",
    tree: "ImageTree",
    node: int,
    plane: int,
    height: float,
    hit: NDArray[np.float64],
    sequence: NDArray[np.int64],
    vertices: NDArray[np.float64],
) -> int:
    """Fill in the hits of a sequence from its last one back to the station.

    Returns the number of hits, 0 if one is outside its window or behind the mirror.
    """
    n_hits = 1
    ancestor = node
    while ancestor > 0:
        n_hits += 1
        ancestor = tree.parents[ancestor]
    row = n_hits
    sequence[row - 1] = plane
    for k in range(3):
        vertices[row, k] = hit[k]
    ancestor = node
    while ancestor > 0:
        mirror = tree.planes[ancestor]
        apex = tree.images[ancestor]
        if ancestor != node:
            height = plane_distance(scene, mirror, apex)
        depth = plane_distance(scene, mirror, vertices[row])
        if depth * height >= 0.0:
            return 0
        share = height / (height - depth)
        for k in range(3):
            x = apex[k] + share * (vertices[row, k] - apex[k])
            if x < tree.window_low[ancestor, k] or x > tree.window_high[ancestor, k]:
                return 0
            vertices[row - 1, k] = x
        row -= 1
        sequence[row - 1] = mirror
        ancestor = tree.parents[ancestor]
    for k in range(3):
        vertices[0, k] = tree.images[0, k]
    return n_hits


@njit(cache=True, nogil=True)
def _is_path(scene: "MirrorScene", sequence: NDArray[np.int64], vertices: NDArray[np.float64], n_hits: int) -> bool:
    """Whether every hit is on its mirror with both neighbours on one side, and no segment is blocked."""
    for i in range(n_hits):
        before = plane_distance(scene, sequence[i], vertices[i])
        after = plane_distance(scene, sequence[i], vertices[i + 2])
        if before * after <= 0.0 or abs(before) < SIDE_MARGIN or abs(after) < SIDE_MARGIN:
            return False
    for i in range(n_hits - 1, -1, -1):
        side = plane_distance(scene, sequence[i], vertices[i])
        if _reflecting(scene, sequence[i], side, vertices[i + 1, 0], vertices[i + 1, 1], vertices[i + 1, 2]) < 0:
            return False
    for i in range(n_hits, -1, -1):
        mirror_before = sequence[i - 1] if i > 0 else -1
        mirror_after = sequence[i] if i < n_hits else -1
        if _blocked(scene, vertices[i], vertices[i + 1], mirror_before, mirror_after, False):
            return False
    return True


@njit(cache=True, nogil=True)
def _reflecting(scene: "MirrorScene", plane: int, side: float, x: float, y: float, z: float) -> int:
    """Triangle of a plane that reflects at a point of it, for rays from a side; -1 if there is none.

    A closed part that lets signals through reflects only outside: its slab holds what runs to and fro inside.
    """
    for triangle in range(scene.plane_starts[plane], scene.plane_starts[plane + 1]):
        if scene.triangle_inside[triangle] * side <= 0.0 and in_triangle(scene, triangle, x, y, z):
            return triangle
    return -1


@njit(cache=True, nogil=True)
def _blocked(
    scene: "MirrorScene",
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    skip_a: int,
    skip_b: int,
    by_open: bool,
) -> bool:
    """Whether a triangle crosses a segment strictly between its ends; two planes are left out.

    Triangles that let signals through block only if ``by_open`` is set.
    """
    x, y, z = start[0], start[1], start[2]
    dx, dy, dz = end[0] - x, end[1] - y, end[2] - z
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length <= 2.0 * END_MARGIN:
        return False
    least = END_MARGIN / length
    # Half the segment, for the separating axes of segment and box (Ericson, Real-Time Collision Detection,
    # section 5.3.3).
    hx, hy, hz = 0.5 * dx, 0.5 * dy, 0.5 * dz
    mx, my, mz = x + hx, y + hy, z + hz
    lx, ly, lz = abs(hx), abs(hy), abs(hz)
    box = 0
    n_boxes = len(scene.box_skips)
    while box < n_boxes:
        ex = 0.5 * (scene.box_high[box, 0] - scene.box_low[box, 0])
        ey = 0.5 * (scene.box_high[box, 1] - scene.box_low[box, 1])
        ez = 0.5 * (scene.box_high[box, 2] - scene.box_low[box, 2])
        cx = mx - scene.box_low[box, 0] - ex
        cy = my - scene.box_low[box, 1] - ey
        cz = mz - scene.box_low[box, 2] - ez
        if (
            abs(cx) > ex + lx
            or abs(cy) > ey + ly
            or abs(cz) > ez + lz
            or abs(cy * hz - cz * hy) > ey * lz + ez * ly
            or abs(cz * hx - cx * hz) > ex * lz + ez * lx
            or abs(cx * hy - cy * hx) > ex * ly + ey * lx
        ):
            box = scene.box_skips[box]
            continue
        for i in range(scene.box_starts[box], scene.box_ends[box]):
            triangle = scene.box_triangles[i]
            plane = scene.triangle_planes[triangle]
            if plane in (skip_a, skip_b) or (scene.triangle_open[triangle] and not by_open):
                continue
            nx = scene.triangle_normals[triangle, 0]
            ny = scene.triangle_normals[triangle, 1]
            nz = scene.triangle_normals[triangle, 2]
            slope = nx * dx + ny * dy + nz * dz
            if slope == 0.0:
                continue  # parallel to the triangle
            share = (scene.triangle_offsets[triangle] - (nx * x + ny * y + nz * z)) / slope
            if share <= least or share >= 1.0 - least:
                continue
            if in_triangle(scene, triangle, x + share * dx, y + share * dy, z + share * dz):
                return True
        box += 1
    return False


@njit(cache=True, nogil=True)
def in_triangle(scene: "MirrorScene", triangle: int, x: float, y: float, z: float) -> bool:
    """Whether a point of a triangle's plane lies in the triangle or on its edges."""
    for e in range(3):
        distance = (
            scene.edge_normals[triangle, e, 0] * x
            + scene.edge_normals[triangle, e, 1] * y
            + scene.edge_normals[triangle, e, 2] * z
            - scene.edge_offsets[triangle, e]
        )
        if distance < -EDGE_TOLERANCE:
            return False
    return True


@njit(cache=True, nogil=True)
def plane_distance(scene: "MirrorScene", plane: int, x: NDArray[np.float64]) -> Any:
    """Distance [m] of a point from a mirror plane along its normal."""
    return (
        scene.normals[plane, 0] * x[0]
        + scene.normals[plane, 1] * x[1]
        + scene.normals[plane, 2] * x[2]
        - scene.offsets[plane]
    )


@njit(cache=True, nogil=True)
def grown(rows: Any, capacity: int) -> Any:
    """Copy a two-dimensional array into a new one with more or fewer rows.

    Loops instead of slices here and elsewhere: numba takes seconds to compile each assignment of a slice.
    """
    out = np.empty((capacity, rows.shape[1]), rows.dtype)
    for i in range(min(len(rows), capacity)):
        for j in range(rows.shape[1]):
            out[i, j] = rows[i, j]
    return out
