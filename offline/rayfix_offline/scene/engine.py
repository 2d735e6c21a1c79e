"""Which triangle a ray hits first: a small interface, and Embree behind it."""

from typing import Protocol

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray


class RayEngine(Protocol):
    """Finds first hits."""

    def first_hit(self, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> NDArray[np.int32]:
        """Triangle that each ray hits first.

        Parameters
        ----------
        origins : ndarray of shape (n_rays, 3), m
        directions : ndarray of shape (n_rays, 3)
            Unit vectors.

        Returns
        -------
        ndarray of int32, shape (n_rays,)
            Index of the triangle, -1 for none.
        """
        ...


class EmbreeEngine:
    """Intel Embree. It works in float32; whoever needs the hit point computes it from the triangle's plane."""

    def __init__(self, triangles: NDArray[np.float64]) -> None:
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, np.ascontiguousarray(triangles, dtype=np.float32))

    def first_hit(self, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> NDArray[np.int32]:
        """See :meth:`RayEngine.first_hit`."""
        if not len(origins):
            return np.zeros(0, np.int32)
        hits = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
        )
        return np.asarray(hits, dtype=np.int32)
