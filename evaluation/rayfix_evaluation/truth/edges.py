"""Edges that bend paths: those of solids that stand out, and free edges of sheets."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.truth.mirrors import MirrorScene

Array = NDArray[np.float64]

_SAME = 1e-6  # m; corners this near are one
_FLAT = 1e-6  # sine of the angle between faces that are one plane
_ON_FACE = 1e-5  # m; an edge whose middle is this near to another triangle is a joint


class Edges(NamedTuple):
    """Edges of a scene, each between the face 0 and the face n, which are two sides of one face for free edges.

    Attributes
    ----------
    origin : ndarray of shape (n_edges, 3), m
        One end.
    along : ndarray of shape (n_edges, 3)
        Unit vectors to the other end.
    length : ndarray of shape (n_edges,), m
    normals : ndarray of shape (n_edges, 2, 3)
        Normals of both faces, away from the wedge.
    inwards : ndarray of shape (n_edges, 2, 3)
        Unit vectors within both faces, across the edge and away from it.
    triangles : ndarray of int of shape (n_edges, 2)
        Triangles of both faces; equal for free edges.
    """

    origin: Array
    along: Array
    length: Array
    normals: Array
    inwards: Array
    triangles: NDArray[np.int64]


def find_edges(scene: MirrorScene, corners: Array, parts: NDArray[np.int64] | None = None) -> Edges:
    """Find the edges of a scene between two faces, and free ones; of neither, those that another triangle touches.

    Parameters
    ----------
    scene : MirrorScene
    corners : ndarray of shape (n_triangles, 3, 3), m
        Of the scene's triangles, in their order.
    parts : ndarray of int of shape (n_triangles,), optional
        Part of each triangle. If given, the parts know nothing of each other: where one ends it has a free edge.
    """
    _, number = np.unique(np.round(corners.reshape(-1, 3) / _SAME).astype(np.int64), axis=0, return_inverse=True)
    number = number.reshape(-1, 3)
    if parts is not None:
        number = number + (number.max() + 1) * parts[:, None]
    ends = np.stack([number, np.roll(number, -1, axis=1)], axis=2).reshape(-1, 2)
    _, first, edge, uses = np.unique(
        np.sort(ends, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    order = np.argsort(edge.reshape(-1), kind="stable") // 3
    starts = np.cumsum(uses) - uses
    pair = np.stack([order[starts], order[starts + np.minimum(uses, 2) - 1]], axis=1)
    start = corners.reshape(-1, 3)[first]
    end = np.roll(corners, -1, axis=1).reshape(-1, 3)[first]
    length = np.linalg.norm(end - start, axis=1)
    along = (end - start) / length[:, None]
    normals = scene.triangle_normals[pair].copy()
    middles = corners[pair].mean(axis=2)
    free = uses == 1
    # Of a wedge, each normal points away from the other face; of a sheet, they are opposite.
    for side in (0, 1):
        towards = np.einsum("ni,ni->n", normals[:, side], middles[:, 1 - side] - start)
        normals[(towards > 0.0) & ~free, side] *= -1.0
    normals[free, 1] = -normals[free, 0]
    flat = np.linalg.norm(np.cross(normals[:, 0], normals[:, 1]), axis=1) < _FLAT
    inwards = middles - start[:, None]
    inwards -= np.einsum("nfi,ni->nf", inwards, along)[:, :, None] * along[:, None]
    inwards /= np.linalg.norm(inwards, axis=2, keepdims=True)
    kept = (uses <= 2) & (free | ~flat)
    if parts is None:
        kept[kept] &= ~_touched(corners, scene.triangle_normals, 0.5 * (start + end)[kept], pair[kept])
    return Edges(start[kept], along[kept], length[kept], normals[kept], inwards[kept], pair[kept])


def _touched(corners: Array, normals: Array, points: Array, own: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each point lies on a triangle other than its own two."""
    sides = np.cross(normals[:, None], np.roll(corners, -1, axis=1) - corners)
    sides /= np.linalg.norm(sides, axis=2, keepdims=True)
    out = np.zeros(len(points), np.bool_)
    for n, point in enumerate(points):
        apart = np.abs(np.einsum("fi,fi->f", point - corners[:, 0], normals)) < _ON_FACE
        within = (np.einsum("fki,fki->fk", point - corners, sides) > -_ON_FACE).all(axis=1)
        on = apart & within
        on[own[n]] = False
        out[n] = on.any()
    return out
