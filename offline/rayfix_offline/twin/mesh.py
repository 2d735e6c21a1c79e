"""The mesh of a scene: its triangles and their connectivity."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.scene import Scene
from rayfix_offline.twin.settings import TwinSettings
from rayfix_offline.twin.topology import Topology, find_topology


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Triangles of a scene and their topology; a step of a repair takes a mesh and returns a mesh.

    Attributes
    ----------
    scene : Scene
    weld : float, m
        Vertices whose coordinates round to the same multiple of this are one point.
    """

    scene: Scene
    weld: float = TwinSettings.weld

    @cached_property
    def topology(self) -> Topology:
        """Points and edges of the triangles."""
        return find_topology(self.scene, weld=self.weld)

    def without(self, faces: NDArray[np.bool_]) -> "Mesh":
        """Return the mesh without some triangles, given by a mask of shape (n_faces,)."""
        if not faces.any():
            return self
        return replace(self, scene=self.scene.only(~faces))
