"""The first triangle that a ray hits: a small interface, implemented with Embree."""

from typing import Protocol

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

FAR = 10_000.0
"""Farther from the origin than this, m, single precision is coarser than a millimetre."""


class RayEngine(Protocol):
    """Finds first hits.

    Attributes
    ----------
    origin : ndarray of shape (3,), m
        Point of the scene that the engine's coordinates count from, so that single precision suffices for them.
    """

    origin: NDArray[np.float64]

    def first_hit(self, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> NDArray[np.int32]:
        """Triangle that each ray hits first.

        Parameters
        ----------
        origins : ndarray of shape (n_rays, 3), m
            Relative to :attr:`origin`.
        directions : ndarray of shape (n_rays, 3)
            Unit vectors.

        Returns
        -------
        ndarray of int32, shape (n_rays,)
            Index of the triangle, -1 for none.
        """
        ...


class EmbreeEngine:
    """Intel Embree. It works in float32; callers compute hit points from the triangle's plane.

    Scenes on map coordinates are translated to the origin; all others are not.
    """

    def __init__(self, triangles: NDArray[np.float64]) -> None:
        self.origin = np.zeros(3)
        if len(triangles):
            low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
            if max(np.abs(low).max(), np.abs(high).max()) > FAR:
                self.origin = np.round((low + high) / 2.0)
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, np.ascontiguousarray(triangles - self.origin, dtype=np.float32))

    def first_hit(self, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> NDArray[np.int32]:
        """See :meth:`RayEngine.first_hit`."""
        if not len(origins):
            return np.zeros(0, np.int32)
        hits = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
        )
        return np.asarray(hits, dtype=np.int32)
