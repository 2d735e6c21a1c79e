"""The mirror planes of a mesh and the image sources of a station, as the kernels read them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class MirrorScene(NamedTuple):
    """The mesh as the kernels read it (a named tuple, since numba knows no dataclass).

    Attributes
    ----------
    normals : ndarray of shape (n_planes, 3)
        Unit normals of the mirror planes.
    offsets : ndarray of shape (n_planes,), m
        A point x is on plane k where ``normals[k] @ x == offsets[k]``.
    plane_low, plane_high : ndarray of shape (n_planes, 3), m
        Bounding boxes of each plane's triangles, with a margin.
    plane_starts : ndarray of int of shape (n_planes + 1,)
        Triangles ``plane_starts[k]`` to ``plane_starts[k + 1]`` belong to plane k.
    outlines : ndarray of shape (n_planes, 12, 3), m
        Corners of a convex polygon that holds all the plane's triangles.
    outline_sizes : ndarray of int of shape (n_planes,)
        Number of corners of each outline.
    facing : ndarray of bool of shape (n_planes, 2, n_planes)
        ``facing[b, s, c]``: a part of plane c lies on side s of plane b (0: against the normal, 1: along it).
    triangle_planes : ndarray of int of shape (n_triangles,)
        Plane of each triangle.
    triangle_faces : ndarray of int of shape (n_triangles,)
        Index of the triangle among the mesh's faces.
    triangle_normals, triangle_offsets : ndarray of shape (n_triangles, 3) and (n_triangles,), 1 and m
        The triangle's own plane, which may differ from its mirror plane by the merging tolerance.
    triangle_open : ndarray of bool of shape (n_triangles,)
        Whether signals pass through the triangle.
    triangle_solids : ndarray of int of shape (n_triangles,)
        Closed part of the mesh that the triangle belongs to; -1 for sheets and for triangles that nothing passes.
    triangle_inside : ndarray of int of shape (n_triangles,)
        Side of the mirror plane on which this closed part lies: 1 along the plane's normal, -1 against it, 0 for
        sheets.
    edge_normals, edge_offsets : ndarray of shape (n_triangles, 3, 3) and (n_triangles, 3), 1 and m
        Inward unit normals of the edges within the triangle's plane: ``edge_normals @ x - edge_offsets`` are
        the distances of x from the three edges, positive inside.
    box_low, box_high : ndarray of shape (n_boxes, 3), m
        Boxes of the bounding volume hierarchy in depth-first order.
    box_skips : ndarray of int of shape (n_boxes,)
        Index of the next box if a box is missed.
    box_starts, box_ends : ndarray of int of shape (n_boxes,)
        Range of a leaf in ``box_triangles``; empty in an inner box.
    box_triangles : ndarray of int of shape (n_triangles,)
        Triangles in the order of the leaves.
    """

    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    plane_low: NDArray[np.float64]
    plane_high: NDArray[np.float64]
    plane_starts: NDArray[np.int64]
    outlines: NDArray[np.float64]
    outline_sizes: NDArray[np.int64]
    facing: NDArray[np.bool_]
    triangle_planes: NDArray[np.int64]
    triangle_faces: NDArray[np.int64]
    triangle_normals: NDArray[np.float64]
    triangle_offsets: NDArray[np.float64]
    triangle_open: NDArray[np.bool_]
    triangle_solids: NDArray[np.int64]
    triangle_inside: NDArray[np.int64]
    edge_normals: NDArray[np.float64]
    edge_offsets: NDArray[np.float64]
    box_low: NDArray[np.float64]
    box_high: NDArray[np.float64]
    box_skips: NDArray[np.int64]
    box_starts: NDArray[np.int64]
    box_ends: NDArray[np.int64]
    box_triangles: NDArray[np.int64]


class ImageTree(NamedTuple):
    """Image sources of one station, for all sequences of fewer than ``max_reflections`` planes that can carry a path.

    The last reflection of a path is looked up per point and needs no node.

    Attributes
    ----------
    images : ndarray of shape (n_nodes, 3), m
        Image sources; node 0 is the station itself.
    planes : ndarray of int of shape (n_nodes,)
        Last plane of each node's sequence, -1 for the station.
    parents : ndarray of int of shape (n_nodes,)
        Node of the sequence without its last plane, -1 for the station.
    window_low, window_high : ndarray of shape (n_nodes, 3), m
        Bounding box of the part of the plane that the sequence can reach, with a margin.
    """

    images: NDArray[np.float64]
    planes: NDArray[np.int64]
    parents: NDArray[np.int64]
    window_low: NDArray[np.float64]
    window_high: NDArray[np.float64]
