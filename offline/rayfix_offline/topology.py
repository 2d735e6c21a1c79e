"""How the triangles of a scene hang together: which corners are one point and which sides one edge."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rayfix_offline.scene import Scene

WELD = 1e-6
"""Vertices whose coordinates round to the same multiple of this are one point, m."""


@dataclass(frozen=True, kw_only=True)
class Topology:
    """Points and edges of a scene's triangles.

    Attributes
    ----------
    points : ndarray of int64, shape (n_faces, 3)
        Point at each corner of each triangle.
    edges : ndarray of int64, shape (n_faces, 3)
        Edge of each side of each triangle; side k runs from corner k to the next.
    edge_uses : ndarray of int64, shape (n_edges,)
        Triangles that have the edge.
    edge_balance : ndarray of int64, shape (n_edges,)
        How many more triangles run through the edge one way than the other; 0 where they face the same way.
    """

    points: NDArray[np.int64]
    edges: NDArray[np.int64]
    edge_uses: NDArray[np.int64]
    edge_balance: NDArray[np.int64]

    def neighbours(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Sides that two triangles, and no third, have in common.

        Returns
        -------
        first, second : ndarray of int64, shape (n_pairs,)
            Sides of the one and of the other triangle: triangle k // 3, its side k % 3.
        """
        order = np.argsort(self.edges.reshape(-1), kind="stable")
        paired = order[self.edge_uses[self.edges.reshape(-1)[order]] == 2]
        return paired[0::2], paired[1::2]

    def components(self) -> NDArray[np.int64]:
        """Return the connected part of each triangle, shape (n_faces,); triangles hang together at points."""
        links = np.concatenate([self.points[:, [0, 1]], self.points[:, [1, 2]]])
        count = int(self.points.max()) + 1
        label = connect(links, count)[self.points[:, 0]]
        return np.unique(label, return_inverse=True)[1].reshape(-1)


def connect(links: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Label the connected components of a graph.

    Parameters
    ----------
    links : ndarray of int, shape (n_links, 2)
        Pairs of nodes.
    count : int
        Number of nodes.

    Returns
    -------
    ndarray of int64, shape (count,)
    """
    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def find_topology(scene: Scene) -> Topology:
    """Weld the corners of a scene's triangles and find their edges."""
    _, welded = np.unique(np.round(scene.vertices / WELD), axis=0, return_inverse=True)
    points = welded.reshape(-1)[scene.faces].astype(np.int64)
    starts, ends = points.reshape(-1), np.roll(points, -1, axis=1).reshape(-1)
    # One number instead of two for each edge: sorting pairs takes several times as long.
    keys = np.minimum(starts, ends) * (int(points.max()) + 1) + np.maximum(starts, ends)
    _, edges, uses = np.unique(keys, return_inverse=True, return_counts=True)
    edges = edges.reshape(-1)
    return Topology(
        points=points,
        edges=edges.reshape(points.shape),
        edge_uses=uses,
        edge_balance=np.bincount(edges, weights=np.where(starts < ends, 1.0, -1.0)).astype(np.int64),
    )
