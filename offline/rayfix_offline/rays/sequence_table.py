"""The reflection sequences that a launch has found so far."""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.hits import Mirrors
from rayfix_offline.rays.segments import Sequences


class SequenceArrays(NamedTuple):
    """Sequences as the kernels read them; fields as in :class:`Sequences`."""

    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]
    parents: NDArray[np.int32]
    planes: NDArray[np.int32]
    num_reflections: NDArray[np.int8]


class SequenceTable:
    """Sequences with a hash table of their parents and planes; sequence 0 is the direct path.

    Parameters
    ----------
    station : ndarray of shape (3,), m
    """

    def __init__(self, station: NDArray[np.float64]) -> None:
        self._count = 1
        self._arrays = SequenceArrays(
            images=station[None].copy(),
            mirrors=np.eye(3)[None].copy(),
            parents=np.array([-1], np.int32),
            planes=np.array([-1], np.int32),
            num_reflections=np.zeros(1, np.int8),
        )
        self._slots = np.full(2, -1, np.int32)

    @property
    def arrays(self) -> SequenceArrays:
        """The arrays; rows beyond the sequences found so far are empty."""
        return self._arrays

    def children(self, parents: NDArray[np.int32], faces: NDArray[np.int32], planes: Mirrors) -> NDArray[np.int32]:
        """Return the sequences with one more reflection, added if they are new; shape (n,).

        Parameters
        ----------
        parents, faces : ndarray of int32, shape (n,)
            Sequences, and the triangles at which they are reflected.
        """
        self._make_room(len(parents))
        children = np.empty(len(parents), np.int32)
        self._count = _find_children(parents, faces, planes, self._arrays, self._slots, self._count, children)
        return children

    def sequences(self, origin: NDArray[np.float64]) -> Sequences:
        """Return the sequences found, with images relative to a point that is ``origin`` here, m."""
        found = {name: array[: self._count].copy() for name, array in self._arrays._asdict().items()}
        return Sequences(**found | {"images": found["images"] + origin})

    def _make_room(self, more: int) -> None:
        """Make room for this many more sequences; pages that are never written take no memory."""
        capacity = self._count + more
        old = self._arrays
        self._arrays = SequenceArrays(*(np.empty((capacity, *array.shape[1:]), array.dtype) for array in old))
        for name, array in old._asdict().items():
            getattr(self._arrays, name)[: self._count] = array[: self._count]
        if len(self._slots) < 2 * capacity:
            self._slots = np.full(1 << (2 * capacity).bit_length(), -1, np.int32)
            _fill_slots(self._arrays.parents, self._arrays.planes, self._slots, self._count)


@numba.njit(cache=True, nogil=True)
def _fill_slots(parents: Any, planes: Any, slots: Any, count: Any) -> None:
    """Enter sequences into an empty hash table, whose length is a power of two, larger than their number."""
    for child in range(1, count):
        slot = _hashed(parents[child], planes[child]) & (len(slots) - 1)
        while slots[slot] >= 0:
            slot = (slot + 1) & (len(slots) - 1)
        slots[slot] = child


@numba.njit(cache=True, nogil=True)
def _find_children(parents: Any, faces: Any, planes: Any, sequences: Any, slots: Any, count: Any, children: Any) -> Any:
    """Fill ``children``; see :meth:`SequenceTable.children`. Returns the number of sequences."""
    for n in range(len(parents)):
        parent, plane = parents[n], planes.face_planes[faces[n]]
        slot = _hashed(parent, plane) & (len(slots) - 1)
        child = slots[slot]
        while child >= 0 and (sequences.parents[child] != parent or sequences.planes[child] != plane):
            slot = (slot + 1) & (len(slots) - 1)
            child = slots[slot]
        if child < 0:
            child = count
            count += 1
            slots[slot] = child
            sequences.parents[child] = parent
            sequences.planes[child] = plane
            sequences.num_reflections[child] = sequences.num_reflections[parent] + 1
            _mirror_at(
                planes.normals[plane],
                planes.offsets[plane],
                sequences.images[parent],
                sequences.mirrors[parent],
                sequences.images[child],
                sequences.mirrors[child],
            )
        children[n] = child
    return count


@numba.njit(cache=True, nogil=True)
def _hashed(parent: Any, plane: Any) -> Any:
    """Hash of a pair of indices (Fibonacci hashing)."""
    return np.int64(
        ((np.uint64(parent) << np.uint64(32)) ^ np.uint64(plane)) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(32)
    )


@numba.njit(cache=True, nogil=True)
def _mirror_at(normal: Any, offset: Any, image: Any, mirror: Any, new_image: Any, new_mirror: Any) -> None:
    """Mirror an image and a mirror matrix at a plane."""
    height = normal[0] * image[0] + normal[1] * image[1] + normal[2] * image[2] - offset
    for i in range(3):
        new_image[i] = image[i] - 2.0 * height * normal[i]
        for j in range(3):
            along = normal[0] * mirror[0, j] + normal[1] * mirror[1, j] + normal[2] * mirror[2, j]
            new_mirror[i, j] = mirror[i, j] - 2.0 * along * normal[i]
