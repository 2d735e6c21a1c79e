"""The scene of a table, as it is written and read."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.freespace import FreeSpace


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The mesh that a table is built from, and its free space.

    Attributes
    ----------
    vertices : ndarray of float64, shape (n_vertices, 3), m
    faces : ndarray of int32, shape (n_faces, 3)
    face_materials : ndarray of int16, shape (n_faces,)
        Index into ``materials``; -1 for none.
    free_space : FreeSpace
    sha256 : str
        Checksum of the geometry and its materials, in the table's frame.
    origin : ndarray of shape (3,), m
        Origin of the table's frame in the scene frame; all positions in the file are relative to it. It is zero except
        for scenes on map coordinates, which single precision would resolve to decimetres only.
    face_thickness : ndarray of shape (n_faces,), optional, m
        Thickness that the scene file states of each triangle's material, NaN for none; None if it states none.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    face_materials: NDArray[np.int16]
    materials: tuple[str, ...]
    free_space: FreeSpace
    sha256: str
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    face_thickness: NDArray[np.float64] | None = None

    def moved(self, by: NDArray[np.float64]) -> "Scene":
        """Return the scene translated by a vector of shape (3,), m, together with the table's frame."""
        if not np.any(by):
            return self
        return replace(self, vertices=self.vertices + by, free_space=self.free_space.moved(by), origin=self.origin + by)

    @cached_property
    def free_space_in_table_frame(self) -> FreeSpace:
        """The free space in the table's frame."""
        return self.free_space.moved(-self.origin)

    @cached_property
    def in_table_frame(self) -> "Scene":
        """The scene in the table's frame, which is also that of the components' positions."""
        return self.moved(-self.origin)
