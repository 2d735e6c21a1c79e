"""Launch rays from a station and follow them from mirror to mirror.

Of every ray only lengths are kept: along one reflection sequence a ray runs on ``image + length * mirror @ direction``,
where ``image`` is the station mirrored at the sequence's planes and ``mirror`` the product of their reflections. So a
hit comes from one division, however many reflections went before, and nothing accumulates.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.engine import RayEngine
from rayfix_offline.materials import Reflectivity
from rayfix_offline.planes import Planes
from rayfix_tables.angles import direction
from rayfix_tables.grid import AngularGrid

OFFSET = 1e-5
"""A reflected ray starts this times (1 + largest coordinate) off its mirror, m."""


@dataclass(frozen=True, kw_only=True)
class RaySet:
    """Directions that sample the sphere, one in each cell of a fine grid.

    Attributes
    ----------
    azimuth, zenith : ndarray of shape (n_rays,), rad
    solid_angle : ndarray of shape (n_rays,), sr
        What each ray stands for.
    """

    grid: AngularGrid
    azimuth: NDArray[np.float64]
    zenith: NDArray[np.float64]
    solid_angle: NDArray[np.float64]

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """Unit vectors, shape (n_rays, 3)."""
        return direction(self.azimuth, self.zenith)

    def __len__(self) -> int:
        """Return the number of rays."""
        return len(self.azimuth)


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """Reflection sequences that rays went through; number 0 is the direct one.

    Attributes
    ----------
    images : ndarray of shape (n_sequences, 3), m
        The station, mirrored.
    mirrors : ndarray of shape (n_sequences, 3, 3)
        Takes a launch direction to the direction after the last reflection.
    parents : ndarray of int32, shape (n_sequences,)
        The sequence without its last reflection, -1 for the direct one.
    planes : ndarray of int32, shape (n_sequences,)
        Plane of the last reflection, -1 for the direct one.
    num_reflections : ndarray of int8, shape (n_sequences,)
    """

    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]
    parents: NDArray[np.int32]
    planes: NDArray[np.int32]
    num_reflections: NDArray[np.int8]


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Straight pieces of rays, one column per number of reflections.

    Attributes
    ----------
    sequence : ndarray of int32, shape (n_rays, max_reflections + 1)
        Reflection sequence of the piece, -1 where the ray has ended before.
    start, end : ndarray of that shape, m
        Path lengths at which the piece begins and ends.
    log_gain : ndarray of that shape
        Logarithm to base 10 of the share of the power that the reflections before the piece left, 0 before the first.
    lost_ray_share : float
        Share of the rays that left the scene instead of hitting a surface.
    """

    sequence: NDArray[np.int32]
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    log_gain: NDArray[np.float64]
    sequences: Sequences
    lost_ray_share: float


def sample_rays(spacing: float, rng: np.random.Generator) -> RaySet:
    """Draw one direction in each cell of a grid whose cells are about ``spacing`` [rad] wide."""
    grid = AngularGrid.from_spacing(spacing)
    ring = np.repeat(np.arange(grid.num_rings), grid.ring_cells)
    step = np.arange(grid.num_cells) - grid.ring_offsets[ring]
    azimuth = -np.pi + (step + rng.random(grid.num_cells)) * 2.0 * np.pi / grid.ring_cells[ring]
    # Uniform in the cosine within the ring, so that each ray stands for the same solid angle as its cell.
    high, low = np.cos(ring * np.pi / grid.num_rings), np.cos((ring + 1) * np.pi / grid.num_rings)
    zenith = np.arccos(high + (low - high) * rng.random(grid.num_cells))
    return RaySet(grid=grid, azimuth=azimuth, zenith=zenith, solid_angle=grid.solid_angles[ring])


def thin(rays: RaySet, spacing: float) -> tuple[RaySet, NDArray[np.int64]]:
    """Choose one ray in each cell of a coarser grid.

    Parameters
    ----------
    spacing : float, rad
        At least twice that of ``rays``.

    Returns
    -------
    rays : RaySet
    index : ndarray of int64
        Places of the chosen rays in the finer set.
    """
    grid = AngularGrid.from_spacing(spacing)
    if rays.grid.num_rings < 2 * grid.num_rings - 1:
        raise ValueError(f"rays {spacing} rad apart cannot be chosen from a set that is hardly finer")
    cell = grid.nearest(rays.azimuth, rays.zenith)
    # The rays are stratified already; the middle one of a cell is as good a draw as any.
    order = np.argsort(cell, kind="stable")
    count = np.bincount(cell, minlength=grid.num_cells)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    index = order[np.minimum(first + count // 2, len(order) - 1)]
    # At twice the spacing a few cells hold no whole finer cell, and may be empty: the ray at their centre is as near.
    empty = np.flatnonzero(count == 0)
    index[empty] = rays.grid.nearest(grid.centres[empty, 0], grid.centres[empty, 1])
    ring = np.repeat(np.arange(grid.num_rings), grid.ring_cells)
    chosen = RaySet(
        grid=grid, azimuth=rays.azimuth[index], zenith=rays.zenith[index], solid_angle=grid.solid_angles[ring]
    )
    return chosen, index


def launch(
    station: NDArray[np.float64],
    directions: NDArray[np.float64],
    *,
    engine: RayEngine,
    planes: Planes,
    reflectivity: Reflectivity,
    bounds: NDArray[np.float64],
    max_reflections: int,
    max_path_length: float,
) -> Segments:
    """Launch rays and mirror them at what they hit.

    Parameters
    ----------
    station : ndarray of shape (3,), m
    directions : ndarray of shape (n_rays, 3)
        Unit vectors.
    reflectivity : Reflectivity
        Of the engine's triangles.
    bounds : ndarray of shape (2, 3), m
        Low and high corner of the scene; a ray that hits nothing ends there.
    max_path_length : float, m
        Rays end at this unfolded length.
    """
    num_rays = len(directions)
    offset = OFFSET * (1.0 + float(np.abs(bounds).max()))
    sequence = np.full((num_rays, max_reflections + 1), -1, np.int32)
    start = np.zeros(sequence.shape)
    end = np.zeros(sequence.shape)
    log_gain = np.zeros(sequence.shape)
    images, mirrors = [station[None, :]], [np.eye(3)[None]]
    parents, sequence_planes, depths = [np.array([-1])], [np.array([-1])], [np.array([0])]
    num_sequences = 1

    rays = np.arange(num_rays)
    current = np.zeros(num_rays, np.int64)
    length = np.zeros(num_rays)
    reflected = np.zeros(num_rays)
    image = np.broadcast_to(station, (num_rays, 3))
    heading = directions
    origin = image
    lost = 0
    for depth in range(max_reflections + 1):
        faces = engine.first_hit(origin, heading)
        plane = np.where(faces >= 0, planes.face_planes[faces], -1)
        normal = planes.normals[plane]
        approach = np.einsum("ij,ij->i", normal, heading)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (planes.offsets[plane] - np.einsum("ij,ij->i", normal, image)) / approach
        # A hit behind the ray's start is float32 noise at an edge: such a ray has slipped through and is lost.
        hit = (plane >= 0) & np.isfinite(reach) & (reach > length)
        stop = np.where(hit, reach, _exit_length(image, heading, bounds))
        stop = np.clip(stop, length, max_path_length)
        sequence[rays, depth] = current
        start[rays, depth] = length
        end[rays, depth] = stop
        log_gain[rays, depth] = reflected
        lost += int(np.count_nonzero(~hit))
        if depth == max_reflections:
            break
        on = np.flatnonzero(hit & (reach < max_path_length))
        rays, plane, normal, approach, length = rays[on], plane[on], normal[on], approach[on], reach[on]
        reflected = reflected[on] + reflectivity.log_gain(faces[on], np.abs(approach))
        keys, inverse = np.unique(current[on] * len(planes) + plane, return_inverse=True)
        parent, mirror_plane = keys // len(planes), keys % len(planes)
        all_images, all_mirrors = np.concatenate(images), np.concatenate(mirrors)
        n = planes.normals[mirror_plane]
        reflection = np.eye(3) - 2.0 * n[:, :, None] * n[:, None, :]
        height = np.einsum("ij,ij->i", n, all_images[parent]) - planes.offsets[mirror_plane]
        images.append(all_images[parent] - 2.0 * height[:, None] * n)
        mirrors.append(reflection @ all_mirrors[parent])
        parents.append(parent)
        sequence_planes.append(mirror_plane)
        depths.append(np.full(len(keys), depth + 1))
        current = num_sequences + inverse
        num_sequences += len(keys)
        image = images[-1][inverse]
        heading = np.einsum("ijk,ik->ij", mirrors[-1][inverse], directions[rays])
        # The side the ray came from: against its old heading.
        origin = image + length[:, None] * heading - np.sign(approach)[:, None] * normal * offset
    return Segments(
        sequence=sequence,
        start=start,
        end=end,
        log_gain=log_gain,
        sequences=Sequences(
            images=np.concatenate(images),
            mirrors=np.concatenate(mirrors),
            parents=np.concatenate(parents).astype(np.int32),
            planes=np.concatenate(sequence_planes).astype(np.int32),
            num_reflections=np.concatenate(depths).astype(np.int8),
        ),
        lost_ray_share=lost / max(1, num_rays),
    )


def _exit_length(
    image: NDArray[np.float64], heading: NDArray[np.float64], bounds: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Length at which rays leave the scene's bounding box, shape (n_rays,), m."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (np.where(heading > 0, bounds[1], bounds[0]) - image) / heading
    return np.asarray(np.where(np.isfinite(reach), reach, np.inf).min(axis=1, initial=np.inf))
