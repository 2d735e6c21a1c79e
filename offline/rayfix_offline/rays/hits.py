"""Where rays hit planes, and where they start again: the kernels of the launch."""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray


class Mirrors(NamedTuple):
    """Planes of the scene, as the kernels read them; fields as in :class:`~rayfix_offline.twin.planes.Planes`."""

    face_planes: NDArray[np.int32]
    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]


class Lines(NamedTuple):
    """Lines of rays: launch directions and reflection sequences.

    Attributes
    ----------
    directions : ndarray of shape (n_rays, 3)
    images, mirrors
        Of all sequences, as in :class:`~rayfix_offline.rays.segments.Sequences`.
    rays : ndarray of int64, shape (n,)
        Row of the direction of each line.
    sequence : ndarray of int32, shape (n,)
    """

    directions: NDArray[np.float64]
    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]
    rays: NDArray[np.int64]
    sequence: NDArray[np.int32]

    def only(self, index: NDArray[np.int64]) -> "Lines":
        """Return chosen lines."""
        return self._replace(rays=self.rays[index], sequence=self.sequence[index])


def find_hits(
    lines: Lines, start: NDArray[np.float64], faces: NDArray[np.int32], planes: Mirrors, bounds: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Find where rays hit the planes of triangles.

    Parameters
    ----------
    start : ndarray of shape (n,), m
        Path lengths at which the rays start.
    faces : ndarray of int32, shape (n,)
        Triangle that each ray hits; -1 for none.
    bounds : ndarray of shape (2, 3), m

    Returns
    -------
    hit : ndarray of bool, shape (n,)
        False for a ray that hits nothing. A hit behind the ray's start is float32 noise at an edge: the ray has passed
        through a gap.
    reach : ndarray of shape (n,), m
        Path length of the hit; without one, that at which the ray leaves the bounds.
    approach : ndarray of shape (n,)
        Component of the ray's direction along the plane's normal.
    """
    hit = np.empty(len(faces), np.bool_)
    reach, approach = np.empty(len(faces)), np.empty(len(faces))
    _find_hits(lines, start, faces, planes, bounds, hit, reach, approach)
    return hit, reach, approach


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _find_hits(
    lines: Any, start: Any, faces: Any, planes: Any, bounds: Any, hit: Any, reach: Any, approach: Any
) -> None:
    for n in range(len(faces)):
        sequence = lines.sequence[n]
        hx, hy, hz = turned(lines.mirrors, sequence, lines.directions, lines.rays[n])
        image = lines.images[sequence]
        hit[n] = False
        approach[n] = 0.0
        if faces[n] >= 0:
            plane = planes.face_planes[faces[n]]
            nx, ny, nz = planes.normals[plane, 0], planes.normals[plane, 1], planes.normals[plane, 2]
            approach[n] = nx * hx + ny * hy + nz * hz
            height = planes.offsets[plane] - (nx * image[0] + ny * image[1] + nz * image[2])
            reach[n] = height / approach[n]
            hit[n] = np.isfinite(reach[n]) and reach[n] > start[n]
        if not hit[n]:
            reach[n] = max(start[n], _exit_length(image, (hx, hy, hz), bounds))


def starts_beside(
    lines: Lines,
    length: NDArray[np.float64],
    faces: NDArray[np.int32],
    aside: NDArray[np.float64],
    planes: Mirrors,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where and in which direction rays start beside the planes of triangles, shapes (n, 3).

    Parameters
    ----------
    length : ndarray of shape (n,), m
        Path lengths at the planes.
    faces : ndarray of int32, shape (n,)
    aside : ndarray of shape (n,), m
        Distance from the plane, along its normal.
    """
    origins = np.empty((len(faces), 3), np.float32)
    headings = np.empty((len(faces), 3), np.float32)
    _start_beside(lines, length, faces, aside, planes, origins, headings)
    return origins, headings


@numba.njit(cache=True, nogil=True)
def _start_beside(lines: Any, length: Any, faces: Any, aside: Any, planes: Any, origins: Any, headings: Any) -> None:
    for n in range(len(faces)):
        sequence = lines.sequence[n]
        heading = turned(lines.mirrors, sequence, lines.directions, lines.rays[n])
        plane = planes.face_planes[faces[n]]
        for i in range(3):
            position = lines.images[sequence, i] + length[n] * heading[i] + aside[n] * planes.normals[plane, i]
            origins[n, i] = position
            headings[n, i] = heading[i]


@numba.njit(cache=True, nogil=True)
def turned(mirrors: Any, sequence: Any, directions: Any, ray: Any) -> Any:
    """Direction of a ray after the reflections of a sequence."""
    x, y, z = directions[ray, 0], directions[ray, 1], directions[ray, 2]
    return (
        mirrors[sequence, 0, 0] * x + mirrors[sequence, 0, 1] * y + mirrors[sequence, 0, 2] * z,
        mirrors[sequence, 1, 0] * x + mirrors[sequence, 1, 1] * y + mirrors[sequence, 1, 2] * z,
        mirrors[sequence, 2, 0] * x + mirrors[sequence, 2, 1] * y + mirrors[sequence, 2, 2] * z,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _exit_length(image: Any, heading: Any, bounds: Any) -> Any:
    """Length at which a ray leaves the scene's bounding box, m."""
    length = np.inf
    for i in range(3):
        if heading[i] != 0.0:
            length = min(length, (bounds[1 if heading[i] > 0.0 else 0, i] - image[i]) / heading[i])
    return length
