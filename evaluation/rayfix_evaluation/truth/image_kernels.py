"""Compiled loops of :mod:`rayfix_evaluation.truth.images`: merging triangles into planes, growing the tree."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rayfix_evaluation.truth.forward_kernels import SIDE_MARGIN, grown, plane_distance

if TYPE_CHECKING:
    from rayfix_evaluation.truth.mirrors import MirrorScene

BEAM_MARGIN = 1e-4
"""Widening [m] of the windows while the image tree grows; more than the tolerances of a hit."""
MAX_WINDOW = 16
"""Largest number of corners of a window; a polygon that reaches it is clipped no further."""

_PARALLEL = 0.999  # smallest cosine between the normals of coplanar triangles


@njit(cache=True, nogil=True)
def group_coplanar(
    corners: NDArray[np.float64], normals: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Group triangles, given from the largest to the smallest, into planes.

    The largest triangle without a group defines the next plane and takes all triangles whose three corners
    lie within the tolerance of it. Slivers within the tolerance that are not parallel to the plane are not included.

    Parameters
    ----------
    corners : ndarray of shape (n_triangles, 3, 3), m
        Corners of the triangles.
    normals : ndarray of shape (n_triangles, 3)
        Unit normals of the triangles.
    tolerance : float
        Largest distance of a corner from its plane, m.

    Returns
    -------
    planes : ndarray of int of shape (n_triangles,)
        Plane of each triangle.
    plane_normals : ndarray of shape (n_planes, 3)
        Unit normals.
    plane_offsets : ndarray of shape (n_planes,), m
        Distances from the origin along the normals.
    """
    count = len(corners)
    planes = np.full(count, -1, np.int64)
    leaders = np.empty(count, np.int64)
    offsets = np.empty(count)
    n_planes = 0
    for i in range(count):
        if planes[i] >= 0:
            continue
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        offset = 0.0
        for k in range(3):
            offset += (nx * corners[i, k, 0] + ny * corners[i, k, 1] + nz * corners[i, k, 2]) / 3.0
        for j in range(i, count):
            if planes[j] >= 0:
                continue
            if abs(nx * normals[j, 0] + ny * normals[j, 1] + nz * normals[j, 2]) < _PARALLEL:
                continue
            coplanar = True
            for k in range(3):
                distance = nx * corners[j, k, 0] + ny * corners[j, k, 1] + nz * corners[j, k, 2] - offset
                if abs(distance) > tolerance:
                    coplanar = False
                    break
            if coplanar:
                planes[j] = n_planes
        planes[i] = n_planes
        leaders[n_planes] = i
        offsets[n_planes] = offset
        n_planes += 1
    return planes, normals[leaders[:n_planes]], offsets[:n_planes].copy()


@njit(cache=True, nogil=True)
def expand_level(
    scene: "MirrorScene",
    images: NDArray[np.float64],
    planes: NDArray[np.int64],
    windows: NDArray[np.float64],
    sizes: NDArray[np.int64],
    max_path_length: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Mirror each image of one level of the tree at every plane that its beam reaches.

    Parameters
    ----------
    scene : MirrorScene
        The mirror planes.
    images : ndarray of shape (n_nodes, 3), m
        Image sources of the level.
    planes : ndarray of int of shape (n_nodes,)
        Last plane of each node, -1 for the station.
    windows, sizes : ndarray of shape (n_nodes, any, 3) and (n_nodes,), m
        Window polygon of each node and its number of corners; not read for the station.
    max_path_length : float
        Largest length of a path, m.

    Returns
    -------
    links : ndarray of int of shape (n_next, 3)
        Of each node of the next level: its parent's row in this level, its plane, the corners of its window.
    images : ndarray of shape (n_next, 3), m
        Its image source.
    windows : ndarray of shape (n_next, 16, 3), m
        Its window; unused rows repeat the first corner.
    """
    n_planes = len(scene.normals)
    capacity = 256
    out_links = np.empty((capacity, 3), np.int64)
    out_images = np.empty((capacity, 3))
    out_windows = np.empty((capacity, 3 * MAX_WINDOW))
    count = 0
    polygon = np.empty((MAX_WINDOW + 2, 3))
    spare = np.empty((MAX_WINDOW + 2, 3))
    normal = np.empty(3)
    for node in range(len(images)):
        apex = images[node]
        last = planes[node]
        side = 0.0
        height = 0.0
        if last >= 0:
            height = plane_distance(scene, last, apex)
            side = -1.0 if height > 0.0 else 1.0  # the image is behind the mirror
            height = abs(height)
        for plane in range(n_planes):
            if plane == last or (last >= 0 and not scene.facing[last, 1 if side > 0.0 else 0, plane]):
                continue
            distance = plane_distance(scene, plane, apex)
            if abs(distance) < SIDE_MARGIN:
                continue
            size = scene.outline_sizes[plane]
            _copy(scene.outlines[plane], size, polygon)
            if last >= 0:
                # The previous hit must be on the same side of the new mirror as its image.
                in_front = False
                for i in range(sizes[node]):
                    if plane_distance(scene, plane, windows[node, i]) * distance > -BEAM_MARGIN * abs(distance):
                        in_front = True
                        break
                if not in_front:
                    continue
                for k in range(3):
                    normal[k] = side * scene.normals[last, k]
                size = _clip(polygon, size, normal, side * scene.offsets[last], spare)
                _copy(spare, size, polygon)
                if size > 0:
                    size = _clip_to_beam(polygon, size, apex, height, windows[node], sizes[node], spare)
                if size == 0:
                    continue
            if _box_distance(polygon, size, apex) > max_path_length:
                continue
            if count == capacity:
                capacity *= 2
                out_links = grown(out_links, capacity)
                out_images, out_windows = grown(out_images, capacity), grown(out_windows, capacity)
            out_links[count, 0], out_links[count, 1], out_links[count, 2] = node, plane, size
            for i in range(MAX_WINDOW):
                for k in range(3):
                    out_windows[count, 3 * i + k] = polygon[i if i < size else 0, k]
            for k in range(3):
                out_images[count, k] = apex[k] - 2.0 * distance * scene.normals[plane, k]
            count += 1
    windows_out = grown(out_windows, count).reshape((count, MAX_WINDOW, 3))
    return grown(out_links, count), grown(out_images, count), windows_out


@njit(cache=True, nogil=True)
def _copy(polygon: NDArray[np.float64], size: int, out: NDArray[np.float64]) -> None:
    """Copy the corners of a polygon."""
    for i in range(size):
        for k in range(3):
            out[i, k] = polygon[i, k]


@njit(cache=True, nogil=True)
def _clip(
    polygon: NDArray[np.float64],
    size: int,
    normal: NDArray[np.float64],
    offset: float,
    out: NDArray[np.float64],
) -> int:
    """Keep the part of a convex polygon where ``normal @ x >= offset`` and return its size.

    The algorithm is Sutherland's and Hodgman's.
    """
    kept = 0
    for i in range(size):
        j = i + 1 if i + 1 < size else 0
        fi = polygon[i, 0] * normal[0] + polygon[i, 1] * normal[1] + polygon[i, 2] * normal[2] - offset
        fj = polygon[j, 0] * normal[0] + polygon[j, 1] * normal[1] + polygon[j, 2] * normal[2] - offset
        if fi >= 0.0:
            for k in range(3):
                out[kept, k] = polygon[i, k]
            kept += 1
        if (fi >= 0.0) != (fj >= 0.0):
            share = fi / (fi - fj)
            for k in range(3):
                out[kept, k] = polygon[i, k] + share * (polygon[j, k] - polygon[i, k])
            kept += 1
    return kept


@njit(cache=True, nogil=True)
def _clip_to_beam(
    polygon: NDArray[np.float64],
    size: int,
    apex: NDArray[np.float64],
    height: float,
    window: NDArray[np.float64],
    window_size: int,
    spare: NDArray[np.float64],
) -> int:
    """Clip a polygon in place to the beam from an image through its window; return its size.

    A hit may lie BEAM_MARGIN outside the window, whose plane is ``height`` away from the apex: at a distance
    r from the apex that is a displacement of at most ``BEAM_MARGIN * r / height``.
    """
    normal = np.empty(3)
    centre = np.zeros(3)
    for i in range(window_size):
        for k in range(3):
            centre[k] += window[i, k] / window_size
    reach = 0.0
    for i in range(size):
        square = 0.0
        for k in range(3):
            square += (polygon[i, k] - apex[k]) ** 2
        reach = max(reach, square)
    slack = BEAM_MARGIN * (1.0 + np.sqrt(reach) / height)
    for i in range(window_size):
        j = i + 1 if i + 1 < window_size else 0
        ax, ay, az = window[i, 0] - apex[0], window[i, 1] - apex[1], window[i, 2] - apex[2]
        bx, by, bz = window[j, 0] - apex[0], window[j, 1] - apex[1], window[j, 2] - apex[2]
        normal[0], normal[1], normal[2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        norm = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        scale = np.sqrt((ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz))
        if norm < 1e-9 * scale or norm == 0.0:
            continue  # an edge that is too short, or seen end-on, is not a reliable bound
        inside = 0.0
        for k in range(3):
            normal[k] /= norm
            inside += normal[k] * (centre[k] - apex[k])
        if abs(inside) < BEAM_MARGIN:
            continue  # a window without width: the inner side is uncertain
        if inside < 0.0:
            for k in range(3):
                normal[k] = -normal[k]
        if size >= MAX_WINDOW - 1:
            return size
        offset = normal[0] * apex[0] + normal[1] * apex[1] + normal[2] * apex[2] - slack
        size = _clip(polygon, size, normal, offset, spare)
        if size == 0:
            return 0
        _copy(spare, size, polygon)
    return size


@njit(cache=True, nogil=True)
def _box_distance(polygon: NDArray[np.float64], size: int, x: NDArray[np.float64]) -> Any:
    """Distance [m] of a point from a polygon's bounding box."""
    square = 0.0
    for k in range(3):
        low, high = polygon[0, k], polygon[0, k]
        for i in range(1, size):
            low, high = min(low, polygon[i, k]), max(high, polygon[i, k])
        square += max(low - x[k], x[k] - high, 0.0) ** 2
    return np.sqrt(square)
