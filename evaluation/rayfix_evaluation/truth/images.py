r"""Mirror planes, their outlines and the tree of image sources of the forward solver.

The image method finds a path by mirroring the station at one plane after another: a reflected path is a
straight line from the last image to the point. Which planes can follow each other is known per station and
stored as a tree. A node carries its image and its *window*, a convex polygon on its plane that holds every
point where a path of this sequence can hit::

        image of (a)
             *
            / \           the beam of node (a) leaves its image through its window;
        ---=====------    plane a, and the window of (a) on it
          /     \         plane b follows only if some of its outline lies in the beam,
     ----=========----    plane b, and the window of (a, b) on it, which is that part

Outlines and beams are supersets, widened by more than the tolerances of the hit tests, a sequence is therefore dropped
only when it cannot carry a path.
"""

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.truth.image_kernels import expand_level, group_coplanar
from rayfix_evaluation.truth.mirrors import ImageTree, MirrorScene
from rayfix_evaluation.truth.passages import inner_sides
from rayfix_evaluation.truth.walls import Walls
from rayfix_tables.errors import SceneError

COPLANAR_DISTANCE = 1e-5
"""Triangles whose vertices lie within this distance [m] of a plane belong to it."""

_BOX_MARGIN = 1e-4  # m; boxes are only used for first tests and may be larger than necessary
_MAX_OUTLINE = 12  # corners; a hull with more is replaced by its bounding rectangle
_LEAF_SIZE = 4  # triangles in a leaf of the hierarchy


def mirror_scene(vertices: NDArray[np.float64], faces: NDArray[np.int64], walls: Walls | None = None) -> MirrorScene:
    """Merge the triangles of a mesh into mirror planes and prepare the visibility tests.

    Parameters
    ----------
    vertices : ndarray of shape (n_vertices, 3), m
        Vertices of the mesh.
    faces : ndarray of int of shape (n_faces, 3)
        Vertex indices of the triangles; triangles without area are ignored.
    walls : Walls, optional
        What the faces are made of; nothing passes through any of them when left out.

    Returns
    -------
    MirrorScene
        Planes ordered by the area of their largest triangle.

    Raises
    ------
    SceneError
        If no triangle has an area, or a vertex is not finite.
    """
    # Contiguous from here on: numba would compile the kernels again for other memory layouts.
    corners = np.ascontiguousarray(vertices, dtype=np.float64)[np.ascontiguousarray(faces, dtype=np.int64)]
    if not np.isfinite(corners).all():
        raise SceneError("the mesh has vertices that are not finite; repair the scene file")
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    solid = double_area > 1e-9 * longest**2
    if not solid.any():
        raise SceneError("the mesh has no triangle with an area; check the scene file")
    corners, cross, double_area = corners[solid], cross[solid], double_area[solid]
    by_area = np.argsort(-double_area, kind="stable")
    corners = corners[by_area]
    triangle_normals = cross[by_area] / double_area[by_area, None]
    planes, normals, offsets = group_coplanar(corners, triangle_normals, COPLANAR_DISTANCE)

    by_plane = np.argsort(planes, kind="stable")
    corners, triangle_normals, planes = corners[by_plane], triangle_normals[by_plane], planes[by_plane]
    triangle_faces = np.flatnonzero(solid)[by_area][by_plane]
    starts = np.searchsorted(planes, np.arange(len(normals) + 1)).astype(np.int64)
    plane_low = np.minimum.reduceat(corners.min(axis=1), starts[:-1]) - _BOX_MARGIN
    plane_high = np.maximum.reduceat(corners.max(axis=1), starts[:-1]) + _BOX_MARGIN
    opened = np.zeros(len(corners), np.bool_)
    solids = np.full(len(corners), -1, np.int64)
    if walls is not None:
        opened = walls.lets_through[triangle_faces]
        solids = np.where(opened, walls.solid[triangle_faces], -1).astype(np.int64)
    inside = inner_sides(corners, triangle_normals, solids)
    inside *= np.where(np.einsum("fi,fi->f", triangle_normals, normals[planes]) > 0.0, 1, -1)
    edges = np.roll(corners, -1, axis=1) - corners
    edge_normals = np.cross(triangle_normals[:, None, :], edges)
    edge_normals /= np.linalg.norm(edge_normals, axis=2, keepdims=True)
    outlines, outline_sizes = _outlines(corners, starts, normals)
    box_low, box_high, (box_skips, box_starts, box_ends, box_triangles) = _box_hierarchy(corners)
    return MirrorScene(
        normals=normals,
        offsets=offsets,
        plane_low=plane_low,
        plane_high=plane_high,
        plane_starts=starts,
        outlines=outlines,
        outline_sizes=outline_sizes,
        facing=_facing(corners, starts, normals, offsets),
        triangle_planes=planes,
        triangle_faces=triangle_faces,
        triangle_normals=triangle_normals,
        triangle_offsets=np.einsum("fi,fi->f", triangle_normals, corners[:, 0]),
        triangle_open=opened,
        triangle_solids=solids,
        triangle_inside=inside,
        edge_normals=edge_normals,
        edge_offsets=np.einsum("fei,fei->fe", edge_normals, corners),
        box_low=box_low,
        box_high=box_high,
        box_skips=box_skips,
        box_starts=box_starts,
        box_ends=box_ends,
        box_triangles=box_triangles,
    )


def image_tree(
    scene: MirrorScene, station: NDArray[np.float64], *, max_reflections: int, max_path_length: float
) -> ImageTree:
    """Mirror a station at all sequences of fewer than ``max_reflections`` planes that can carry a path.

    Parameters
    ----------
    scene : MirrorScene
        The mirror planes.
    station : ndarray of shape (3,), m
        Position of the station.
    max_reflections : int
        Largest number of reflections of a path.
    max_path_length : float
        Largest length of a path, m.

    Returns
    -------
    ImageTree
        Nodes by increasing number of reflections.
    """
    images = station.reshape(1, 3)
    planes, parents = np.full(1, -1), np.full(1, -1)
    windows, sizes = np.zeros((1, 1, 3)), np.zeros(1, dtype=np.int64)
    infinite = np.full((1, 3), np.inf)
    levels = [(images, planes, parents, -infinite, infinite)]
    first = 0
    for _ in range(max_reflections - 1):
        links, images, windows = expand_level(scene, images, planes, windows, sizes, max_path_length)
        planes, sizes = links[:, 1].copy(), links[:, 2].copy()
        if len(planes) == 0:
            break
        # Rows of a window beyond its size repeat its first corner, which leaves the box unchanged.
        low, high = windows.min(axis=1) - _BOX_MARGIN, windows.max(axis=1) + _BOX_MARGIN
        levels.append((images, planes, links[:, 0] + first, low, high))
        first += len(levels[-2][1])
    columns = [np.concatenate(column) for column in zip(*levels, strict=True)]
    return ImageTree(*columns)


def _outlines(
    corners: NDArray[np.float64], starts: NDArray[np.int64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Convex polygon around all triangles of each plane, as corners in cyclic order and their number."""
    outlines = np.zeros((len(normals), _MAX_OUTLINE, 3))
    sizes = np.zeros(len(normals), dtype=np.int64)
    for k, normal in enumerate(normals):
        points = corners[starts[k] : starts[k + 1]].reshape(-1, 3)
        u = np.eye(3)[np.argmin(np.abs(normal))]
        u = u - (u @ normal) * normal
        u /= np.linalg.norm(u)
        v = np.cross(normal, u)
        origin = points[0]
        flat = _convex_hull(np.stack([(points - origin) @ u, (points - origin) @ v], axis=1))
        if len(flat) > _MAX_OUTLINE:
            (a, c), (b, d) = flat.min(axis=0), flat.max(axis=0)
            flat = np.array([[a, c], [b, c], [b, d], [a, d]])
        sizes[k] = len(flat)
        outlines[k, : len(flat)] = origin + flat[:, :1] * u + flat[:, 1:] * v
    return outlines, sizes


def _convex_hull(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convex hull of points of shape (n, 2) in cyclic order (Andrew's monotone chain)."""
    ordered = np.unique(points, axis=0)

    def half(sequence: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        chain: list[NDArray[np.float64]] = []
        for point in sequence:
            while len(chain) >= 2:
                (ax, ay), (bx, by) = chain[-1] - chain[-2], point - chain[-2]
                if ax * by - ay * bx > 0.0:
                    break
                chain.pop()
            chain.append(point)
        return chain

    return np.array(half(ordered)[:-1] + half(ordered[::-1])[:-1])


def _facing(
    corners: NDArray[np.float64],
    starts: NDArray[np.int64],
    normals: NDArray[np.float64],
    offsets: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether a part of plane c lies on each side of plane b, shape (n_planes, 2, n_planes)."""
    facing = np.zeros((len(normals), 2, len(normals)), dtype=np.bool_)
    for k, (normal, offset) in enumerate(zip(normals, offsets, strict=True)):
        distances = corners @ normal - offset
        facing[k, 0] = np.minimum.reduceat(distances.min(axis=1), starts[:-1]) < 0.0
        facing[k, 1] = np.maximum.reduceat(distances.max(axis=1), starts[:-1]) > 0.0
        facing[k, :, k] = False
    return facing


def _box_hierarchy(
    corners: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[NDArray[np.int64]]]:
    """Bounding boxes split at the median of the longest side: lows, highs, and the four integer fields."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    middle = (low + high) / 2
    lows: list[NDArray[np.float64]] = []
    highs: list[NDArray[np.float64]] = []
    skips: list[int] = []
    starts: list[int] = []
    ends: list[int] = []
    order: list[int] = []

    def add(members: NDArray[np.int64]) -> None:
        box = len(lows)
        lows.append(low[members].min(axis=0) - _BOX_MARGIN)
        highs.append(high[members].max(axis=0) + _BOX_MARGIN)
        skips.append(-1)
        starts.append(len(order))
        if len(members) <= _LEAF_SIZE:
            order.extend(members.tolist())
            ends.append(len(order))
        else:
            ends.append(len(order))
            axis = int(np.argmax(np.ptp(middle[members], axis=0)))
            by_axis = members[np.argsort(middle[members, axis], kind="stable")]
            add(by_axis[: len(members) // 2])
            add(by_axis[len(members) // 2 :])
        skips[box] = len(lows)

    add(np.arange(len(corners)))
    integers = [np.array(column, dtype=np.int64) for column in (skips, starts, ends, order)]
    return np.array(lows), np.array(highs), integers
