"""Launch rays from a station and trace their reflections.

Only path lengths are stored: after a reflection sequence a ray is the line ``image + length * mirror @ direction``,
where ``image`` is the station mirrored at the planes of the sequence and ``mirror`` the product of their reflections. A
hit point therefore takes one division, whatever the number of reflections, and rounding errors do not accumulate.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.segments import Segments, Sequences
from rayfix_offline.rays.settings import RaySettings
from rayfix_offline.scene.engine import RayEngine
from rayfix_offline.scene.walls import Walls
from rayfix_offline.twin.planes import Planes


def launch(
    station: NDArray[np.float64],
    directions: NDArray[np.float64],
    *,
    engine: RayEngine,
    planes: Planes,
    walls: Walls,
    bounds: NDArray[np.float64],
    max_reflections: int,
    max_path_length: float,
    mirror_offset: float = RaySettings.mirror_offset,
) -> Segments:
    """Launch rays and reflect them at the planes that they hit.

    Parameters
    ----------
    station : ndarray of shape (3,), m
    directions : ndarray of shape (n_rays, 3)
        Unit vectors.
    walls : Walls
        Of the engine's triangles.
    bounds : ndarray of shape (2, 3), m
        Low and high corner of the scene; a ray that hits no triangle ends there.
    max_path_length : float, m
        Rays end at this unfolded length.
    mirror_offset : float
        A reflected ray starts this times (1 + largest coordinate in m) off its mirror.
    """
    num_rays = len(directions)
    # All that single precision holds counts from the engine's origin; what is returned, from the scene's.
    station, bounds = station - engine.origin, bounds - engine.origin
    plane_offsets = planes.offsets - planes.normals @ engine.origin
    offset = mirror_offset * (1.0 + float(np.abs(bounds).max()))
    sequence = np.full((num_rays, max_reflections + 1), -1, np.int32)
    start = np.zeros(sequence.shape)
    end = np.zeros(sequence.shape)
    log_gain = np.zeros(sequence.shape)
    sequence[:, 0] = 0
    mirrors = _Mirrors(planes.face_planes, planes.normals, plane_offsets)
    direct = np.array([-1], np.int32)
    generations = [_Generation(parents=direct, planes=direct, images=station[None, :], mirrors=np.eye(3)[None])]

    rays = np.arange(num_rays)
    origins = np.broadcast_to(station.astype(np.float32), (num_rays, 3)).copy()
    headings = directions.astype(np.float32)
    first = 0
    lost = 0
    for depth in range(max_reflections + 1):
        count = len(rays)
        faces = engine.first_hit(origins, headings)
        children = _Generation.of_at_most(count if depth < max_reflections else 0)
        front = _Front(faces, rays, np.empty(count), origins, headings)
        num_on, num_children, num_lost = _reflect(
            depth,
            directions,
            mirrors,
            bounds,
            offset,
            max_path_length,
            first,
            generations[-1],
            children,
            np.full(1 << (2 * max(1, len(children.parents))).bit_length(), -1, np.int32),
            _Columns(sequence, start, end),
            front,
        )
        lost += num_lost
        if depth == max_reflections:
            break
        first += len(generations[-1].parents)
        generations.append(children.shortened(num_children))
        rays, origins, headings = rays[:num_on], origins[:num_on], headings[:num_on]
        loss = walls.reflected(faces[:num_on], front.cosines[:num_on])
        log_gain[rays, depth + 1] = log_gain[rays, depth] + loss
    return Segments(
        sequence=sequence,
        start=start,
        end=end,
        log_gain=log_gain,
        sequences=Sequences(
            images=np.concatenate([g.images for g in generations]) + engine.origin,
            mirrors=np.concatenate([g.mirrors for g in generations]),
            parents=np.concatenate([g.parents for g in generations]),
            planes=np.concatenate([g.planes for g in generations]),
            num_reflections=np.repeat(np.arange(len(generations)), [len(g.parents) for g in generations]).astype(
                np.int8
            ),
        ),
        lost_ray_share=lost / max(1, num_rays),
    )


class _Mirrors(NamedTuple):
    """Mirror planes as the kernel reads them; fields as in :class:`~rayfix_offline.twin.planes.Planes`."""

    face_planes: NDArray[np.int32]
    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]


class _Columns(NamedTuple):
    """Columns of :class:`Segments`, filled depth by depth."""

    sequence: NDArray[np.int32]
    start: NDArray[np.float64]
    end: NDArray[np.float64]


class _Front(NamedTuple):
    """Rays that have not ended.

    Attributes
    ----------
    faces : ndarray of int32, shape (n,)
        Triangle that each ray hits, -1 for none.
    rays : ndarray of int64, shape (n,)
        Rows of the directions and of :class:`_Columns`.
    cosines : ndarray of shape (n,)
        Cosine of the angle of incidence.
    origins, headings : ndarray of float32, shape (n, 3)
        Where and in which direction each ray continues.
    """

    faces: NDArray[np.int32]
    rays: NDArray[np.int64]
    cosines: NDArray[np.float64]
    origins: NDArray[np.float32]
    headings: NDArray[np.float32]


class _Generation(NamedTuple):
    """Sequences of the same number of reflections; fields as in :class:`Sequences`."""

    parents: NDArray[np.int32]
    planes: NDArray[np.int32]
    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]

    @classmethod
    def of_at_most(cls, count: int) -> "_Generation":
        """Allocate space; pages that are never written take no memory."""
        return cls(
            parents=np.empty(count, np.int32),
            planes=np.empty(count, np.int32),
            images=np.empty((count, 3)),
            mirrors=np.empty((count, 3, 3)),
        )

    def shortened(self, count: int) -> "_Generation":
        """Copy the first sequences."""
        return _Generation(
            parents=self.parents[:count].copy(),
            planes=self.planes[:count].copy(),
            images=self.images[:count].copy(),
            mirrors=self.mirrors[:count].copy(),
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reflect(
    depth: Any,
    directions: Any,
    planes: Any,
    bounds: Any,
    offset: Any,
    max_path_length: Any,
    first: Any,
    parents: Any,
    children: Any,
    table: Any,
    columns: Any,
    front: Any,
) -> Any:
    """End the segments of one depth where the rays hit a plane, and reflect the rays there.

    The rays that continue are moved to the beginning of the arrays of ``front``.

    Parameters
    ----------
    planes : _Mirrors
    first : int
        Index of the first of ``parents``; the children's indices follow theirs.
    parents : _Generation
    children : _Generation
        Space for the children; empty at the last depth.
    table : ndarray of int32, all -1
        Space for a hash table of the children; its length is a power of two, larger than their number.
    columns : _Columns
    front : _Front

    Returns
    -------
    num_on, num_children, num_lost : int
        Rays that continue, sequences found, and rays that hit nothing.
    """
    face_planes, normals, offsets = planes.face_planes, planes.normals, planes.offsets
    images, mirrors = parents.images, parents.mirrors
    child_parents, child_planes = children.parents, children.planes
    child_images, child_mirrors = children.images, children.mirrors
    sequence, start, end = columns.sequence, columns.start, columns.end
    faces, rays, cosines, origins, headings = front.faces, front.rays, front.cosines, front.origins, front.headings
    num_on, num_children, num_lost = 0, 0, 0
    next_first = first + len(images)
    last = len(child_parents) == 0
    for n in range(len(rays)):
        ray = rays[n]
        parent = sequence[ray, depth] - first
        hx, hy, hz = turned(mirrors, parent, directions, ray)
        length = start[ray, depth]
        plane = -1
        reach = 0.0
        approach = 0.0
        if faces[n] >= 0:
            plane = face_planes[faces[n]]
            nx, ny, nz = normals[plane, 0], normals[plane, 1], normals[plane, 2]
            approach = nx * hx + ny * hy + nz * hz
            height = offsets[plane] - (nx * images[parent, 0] + ny * images[parent, 1] + nz * images[parent, 2])
            reach = height / approach
        # A hit behind the ray's start is float32 noise at an edge: the ray has passed through a gap and is lost.
        hit = plane >= 0 and np.isfinite(reach) and reach > length
        if not hit:
            num_lost += 1
            reach = max(length, _exit_length(images[parent], (hx, hy, hz), bounds))
        end[ray, depth] = min(reach, max_path_length)
        if last or not hit or reach >= max_path_length:
            continue
        slot = _hashed(parent, plane) & (len(table) - 1)
        child = table[slot]
        while child >= 0 and (child_parents[child] != parent + first or child_planes[child] != plane):
            slot = (slot + 1) & (len(table) - 1)
            child = table[slot]
        if child < 0:
            child = num_children
            num_children += 1
            table[slot] = child
            child_parents[child] = parent + first
            child_planes[child] = plane
            _mirror_at(
                normals[plane],
                offsets[plane],
                images[parent],
                mirrors[parent],
                child_images[child],
                child_mirrors[child],
            )
        hx, hy, hz = turned(child_mirrors, child, directions, ray)
        # Towards the side that the ray came from.
        aside = -np.sign(approach) * offset
        rays[num_on] = ray
        faces[num_on] = faces[n]
        cosines[num_on] = abs(approach)
        sequence[ray, depth + 1] = next_first + child
        start[ray, depth + 1] = reach
        origins[num_on, 0] = child_images[child, 0] + reach * hx + aside * nx
        origins[num_on, 1] = child_images[child, 1] + reach * hy + aside * ny
        origins[num_on, 2] = child_images[child, 2] + reach * hz + aside * nz
        headings[num_on, 0], headings[num_on, 1], headings[num_on, 2] = hx, hy, hz
        num_on += 1
    return num_on, num_children, num_lost


@numba.njit(cache=True, nogil=True)
def turned(mirrors: Any, sequence: Any, directions: Any, ray: Any) -> Any:
    """Direction of a ray after the reflections of a sequence."""
    x, y, z = directions[ray, 0], directions[ray, 1], directions[ray, 2]
    return (
        mirrors[sequence, 0, 0] * x + mirrors[sequence, 0, 1] * y + mirrors[sequence, 0, 2] * z,
        mirrors[sequence, 1, 0] * x + mirrors[sequence, 1, 1] * y + mirrors[sequence, 1, 2] * z,
        mirrors[sequence, 2, 0] * x + mirrors[sequence, 2, 1] * y + mirrors[sequence, 2, 2] * z,
    )


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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _exit_length(image: Any, heading: Any, bounds: Any) -> Any:
    """Length at which a ray leaves the scene's bounding box, m."""
    length = np.inf
    for i in range(3):
        if heading[i] != 0.0:
            length = min(length, (bounds[1 if heading[i] > 0.0 else 0, i] - image[i]) / heading[i])
    return length
