"""Connectivity of triangles: welded points, shared edges, connected components."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rayfix_offline.scene.scene import Scene
from rayfix_offline.twin.settings import TwinSettings


@dataclass(frozen=True, kw_only=True)
class Topology:
    """Points and edges of a scene's triangles.

    Attributes
    ----------
    points : ndarray of int64, shape (n_faces, 3)
        Point at each corner of each triangle.
    edges : ndarray of int64, shape (n_faces, 3)
        Edge of each side of each triangle; side k runs from corner k to the next.
    """

    points: NDArray[np.int64]
    edges: NDArray[np.int64]

    def neighbours(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Edges that exactly two triangles share, as pairs of their sides.

        Returns
        -------
        first, second : ndarray of int64, shape (n_pairs,)
            Side k is side ``k % 3`` of triangle ``k // 3``.
        """
        sides = self.edges.reshape(-1)
        order = np.argsort(sides, kind="stable")
        paired = order[np.bincount(sides)[sides[order]] == 2]
        return paired[0::2], paired[1::2]

    def components(self, groups: NDArray[np.integer], *, among: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """Label connected components; triangles of the same group that share a point are connected.

        Parameters
        ----------
        groups : ndarray of int, shape (n_faces,)
        among : ndarray of int, optional
            Indices of the triangles to label; all by default.

        Returns
        -------
        ndarray of int64, shape (n_faces,) or (len(among),)
        """
        points = self.points if among is None else self.points[among]
        group = groups if among is None else groups[among]
        if not len(points):
            return np.zeros(0, np.int64)
        keys = points * (int(group.max()) + 1) + np.asarray(group, np.int64)[:, None]
        nodes, at = np.unique(keys, return_inverse=True)
        at = at.reshape(points.shape)
        label = connect(np.concatenate([at[:, [0, 1]], at[:, [1, 2]]]), len(nodes))
        return np.asarray(label[at[:, 0]])

    def turned(self, groups: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Find the triangles to flip for a consistent orientation of neighbours.

        Neighbours are two triangles that share an edge with no third triangle of their group. In each connected set,
        the smaller number is flipped. Sets without a consistent orientation, such as a Moebius strip, are unchanged.

        Parameters
        ----------
        groups : ndarray of int, shape (n_faces,)

        Returns
        -------
        ndarray of bool, shape (n_faces,)
        """
        count = len(groups)
        keys = (self.edges * (int(groups.max(initial=0)) + 1) + np.asarray(groups, np.int64)[:, None]).reshape(-1)
        _, inverse, uses = np.unique(keys, return_inverse=True, return_counts=True)
        order = np.argsort(inverse.reshape(-1), kind="stable")
        order = order[uses[inverse.reshape(-1)[order]] == 2]
        first, second = order[0::2], order[1::2]
        forward = (self.points < np.roll(self.points, -1, axis=1)).reshape(-1)
        # Each triangle occurs twice, as drawn and flipped. Neighbours that traverse their edge in the same direction
        # agree if one of them is flipped.
        other = np.where(forward[first] == forward[second], count, 0)
        one, two = first // 3, second // 3
        links = np.concatenate(
            [np.stack([one, two + other], axis=1), np.stack([one + count, two + count - other], axis=1)]
        )
        label = connect(links, 2 * count)
        drawn, mirrored = label[:count], label[count:]
        # A part and its mirror image are two components of one name, the lesser of their labels.
        name = np.minimum(drawn, mirrored)
        turned = drawn > name
        size = np.bincount(name, minlength=2 * count)
        most = np.bincount(name, weights=turned, minlength=2 * count) * 2 > size
        return np.asarray(np.where(drawn == mirrored, False, turned ^ most[name]))

    def uses_within(self, groups: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Count the triangles of the same group at each edge.

        Parameters
        ----------
        groups : ndarray of int, shape (n_faces,)

        Returns
        -------
        uses : ndarray of int64, shape (n_faces, 3)
            Triangles of the group at the side's edge, the triangle itself included.
        balance : ndarray of int64, shape (n_faces, 3)
            Difference between the numbers of those that traverse the edge in one direction and in the other; 0 where
            they are oriented consistently.
        """
        keys = self.edges * (int(groups.max()) + 1) + np.asarray(groups, np.int64)[:, None]
        _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
        inverse = inverse.reshape(-1)
        forward = self.points < np.roll(self.points, -1, axis=1)
        balance = np.bincount(inverse, weights=np.where(forward.reshape(-1), 1.0, -1.0)).astype(np.int64)
        return counts[inverse].reshape(keys.shape), np.abs(balance)[inverse].reshape(keys.shape)


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


def number_rows(rows: NDArray[np.float64]) -> NDArray[np.int64]:
    """Rank rows in lexicographic order; equal rows have the same rank, as with ``np.unique(axis=0)``.

    It works column by column, because sorting numbers is much faster than sorting rows.

    Parameters
    ----------
    rows : ndarray of shape (n, d)

    Returns
    -------
    ndarray of int64, shape (n,)
    """
    number = np.zeros(len(rows), np.int64)
    for column in rows.T:
        _, rank = np.unique(column, return_inverse=True)
        _, number = np.unique(number * (int(rank.max(initial=0)) + 1) + rank.reshape(-1), return_inverse=True)
        number = number.reshape(-1)
    return number


def find_topology(scene: Scene, *, weld: float = TwinSettings.weld) -> Topology:
    """Weld the corners of a scene's triangles and find their edges.

    Parameters
    ----------
    weld : float, m
        Vertices whose coordinates round to the same multiple of this are one point.
    """
    points = number_rows(np.round(scene.vertices / weld))[scene.faces]
    ends = np.roll(points, -1, axis=1)
    keys = np.minimum(points, ends) * (int(points.max()) + 1) + np.maximum(points, ends)
    edges = np.unique(keys, return_inverse=True)[1].reshape(points.shape)
    return Topology(points=points, edges=edges)
