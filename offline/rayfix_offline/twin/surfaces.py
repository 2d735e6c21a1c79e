"""Curved surfaces: facets with mirror planes of their own that count as one surface.

A pillar of 256 facets has 256 mirror images of a station, and each would be a group of its own in every cell that sees
the pillar. Rays that are reflected by the same surfaces in the same order are therefore gathered in one group,
whichever facets they hit. The reflections themselves are computed facet by facet.
"""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.twin.mesh import Mesh
from rayfix_offline.twin.planes import Planes
from rayfix_offline.twin.settings import TwinSettings
from rayfix_offline.twin.topology import connect


def join_facets(
    mesh: Mesh,
    planes: Planes,
    *,
    surface_angle: float = TwinSettings.surface_angle,
    facet_size: float = TwinSettings.facet_size,
) -> Planes:
    """Find the curved surfaces of a mesh.

    Small facets that share an edge form a surface as long as their normals stay within ``surface_angle`` of that of the
    first facet.

    Parameters
    ----------
    mesh : Mesh
    planes : Planes
        Of its triangles.
    surface_angle : float, rad
    facet_size : float, m
        See :class:`~rayfix_offline.twin.settings.TwinSettings`.

    Returns
    -------
    Planes
        Facets of different surfaces have different planes, even if they are coplanar. The same object as ``planes``
        where nothing is curved.
    """
    triangles = mesh.scene.triangles
    first, second = mesh.topology.neighbours()
    faces = np.stack([first // 3, second // 3], axis=1)
    flat = planes.face_planes[faces[:, 0]] == planes.face_planes[faces[:, 1]]
    small = _patch_sizes(triangles, faces[flat], np.concatenate([first[flat], second[flat]])) <= facet_size
    both = small[faces].all(axis=1)
    first, second, faces = first[both], second[both], faces[both]
    smooth = faces[_fold_cosines(triangles, first, second) >= np.cos(surface_angle)]
    count = len(triangles)
    ends = np.concatenate([smooth, smooth[:, ::-1]])
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    offsets = np.concatenate([[0], np.cumsum(np.bincount(ends[:, 0], minlength=count))])
    crosses = _crosses(triangles)
    normals = crosses / np.linalg.norm(crosses, axis=1)[:, None]
    return _split(planes, _grow(offsets, ends[:, 1], normals, np.cos(surface_angle)))


def _crosses(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _patch_sizes(
    triangles: NDArray[np.float64], links: NDArray[np.int64], inner_sides: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Size of the flat patch of each triangle, 4 area / circumference, shape (n_faces,), m."""
    patch = connect(links, len(triangles))
    sides = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    outer = sides.reshape(-1).copy()
    outer[inner_sides] = 0.0
    around = np.bincount(patch, weights=outer.reshape(sides.shape).sum(axis=1))
    area = np.bincount(patch, weights=0.5 * np.linalg.norm(_crosses(triangles), axis=1))
    # Tolerances can produce a closed patch, which has no circumference.
    size = np.divide(4.0 * area, around, out=np.full(len(area), np.inf), where=around > 0.0)
    return np.asarray(size[patch])


def _fold_cosines(
    triangles: NDArray[np.float64], first: NDArray[np.int64], second: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Cosine of the fold angle between neighbours: 1 for a flat surface, -1 where it turns back.

    It does not depend on the orientation of the triangles.
    """
    inward = []
    for side in (first, second):
        corners = triangles[side // 3]
        rows = np.arange(len(side))
        start, end, apex = (corners[rows, (side + k) % 3] for k in range(3))
        along = (end - start) / np.linalg.norm(end - start, axis=1)[:, None]
        across = apex - start
        across -= np.einsum("ij,ij->i", across, along)[:, None] * along
        inward.append(across / np.linalg.norm(across, axis=1)[:, None])
    return np.asarray(-np.einsum("ij,ij->i", *inward))


@numba.njit(cache=True, nogil=True)
def _grow(offsets: Any, neighbours: Any, normals: Any, cosine: Any) -> Any:
    """Grow surfaces across smooth edges, from one seed triangle after another; -1 for a triangle without one."""
    count = len(offsets) - 1
    surface = np.full(count, -1, np.int64)
    oriented = normals.copy()
    stack = np.empty(count, np.int64)
    grown = 0
    for seed in range(count):
        if surface[seed] >= 0 or offsets[seed] == offsets[seed + 1]:
            continue
        surface[seed] = grown
        stack[0] = seed
        size = 1
        while size > 0:
            size -= 1
            face = stack[size]
            for k in range(offsets[face], offsets[face + 1]):
                other = neighbours[k]
                if surface[other] >= 0:
                    continue
                agreement = 0.0
                for i in range(3):
                    agreement += oriented[face, i] * normals[other, i]
                sign = 1.0 if agreement >= 0.0 else -1.0
                near = 0.0
                for i in range(3):
                    near += oriented[seed, i] * sign * normals[other, i]
                if near >= cosine:
                    surface[other] = grown
                    for i in range(3):
                        oriented[other, i] = sign * normals[other, i]
                    stack[size] = other
                    size += 1
        grown += 1
    return surface


def _split(planes: Planes, surface: NDArray[np.int64]) -> Planes:
    """Give the facets of each surface planes of their own, and the planes their surface."""
    plane = planes.face_planes.astype(np.int64)
    # A surface with a single plane is not curved.
    pairs = np.unique(np.stack([surface, plane], axis=1), axis=0)
    curved = np.bincount(pairs[:, 0] + 1)[1:] > 1
    if not curved.any():
        return planes
    surface = np.where(surface >= 0, np.where(curved[surface], surface, -1), -1)
    keys, face_planes = np.unique(plane * (len(curved) + 1) + surface + 1, return_inverse=True)
    old_plane, of_surface = keys // (len(curved) + 1), keys % (len(curved) + 1) - 1
    # Each flat plane is a surface of its own.
    named = np.where(of_surface >= 0, len(planes) + of_surface, old_plane)
    return Planes(
        normals=planes.normals[old_plane],
        offsets=planes.offsets[old_plane],
        face_planes=face_planes.reshape(-1).astype(np.int32),
        surfaces=np.unique(named, return_inverse=True)[1].reshape(-1).astype(np.int32),
    )
