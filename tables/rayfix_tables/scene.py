"""The scene of a table, as it is written and read."""

from dataclasses import dataclass

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
        Of the geometry and its materials.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    face_materials: NDArray[np.int16]
    materials: tuple[str, ...]
    free_space: FreeSpace
    sha256: str
