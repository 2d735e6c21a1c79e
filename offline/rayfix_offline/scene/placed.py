"""The result of a scene file's reader: objects with their transforms, and remarks."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

MOST_TRIANGLES = 20_000_000
"""Largest number of triangles of a scene, with every instance of a mesh; they take about 10 GB of memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """An object of a scene and its transform.

    Attributes
    ----------
    name : str
    vertices : ndarray of float64, shape (n_vertices, 3)
        In the file's unit and the object's own frame.
    faces : ndarray of int64, shape (n_faces, 3)
    materials : tuple of str
    face_materials : ndarray of int64, shape (n_faces,)
        Index into ``materials``; -1 for none.
    transform : ndarray of shape (4, 4)
        From the object's frame to the scene's.
    thickness : float, m
        Of the object's material, if the file states it, whatever the file's unit; else NaN.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    materials: tuple[str, ...] = ()
    face_materials: NDArray[np.int64]
    transform: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    thickness: float = np.nan


@dataclass(frozen=True, kw_only=True)
class Remark:
    """Something in a scene file that its reader left out or changed.

    Attributes
    ----------
    kind : str
        Topic in one or two words.
    problem : str
        The problem, and how it was handled.
    remedy : str
    """

    kind: str
    problem: str
    remedy: str


@dataclass(frozen=True, kw_only=True)
class Contents:
    """The content of a scene file.

    Attributes
    ----------
    objects : tuple of Placed
    remarks : tuple of Remark
    metres : float, optional
        Length of the file's unit, m, if the file states it.
    up : {"x", "y", "z"}, optional
        Upward axis, if the file states it.
    """

    objects: tuple[Placed, ...]
    remarks: tuple[Remark, ...] = ()
    metres: float | None = None
    up: str | None = None


def one_material(name: str | None, num_faces: int) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """Return the materials of an object that is made of one, or of none."""
    return ((name,), np.zeros(num_faces, np.int64)) if name else ((), np.full(num_faces, -1, np.int64))


def counted(number: int, noun: str) -> str:
    """Return a number and its noun, in the plural unless it is one."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def too_few_corners(number: int) -> Remark:
    """Return the remark on faces with one or two corners."""
    problem = f"{counted(number, 'face')} of fewer than three corners left out"
    return Remark(kind="left out", problem=problem, remedy="clean the mesh")
