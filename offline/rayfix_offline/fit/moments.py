"""Moments of a cell's ray pieces, grouped by reflection sequence and slice.

The joint vector is (path length, horizontal angle, vertical angle, x, y, z); the angles are tangent coordinates of the
cell.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.pieces import Pieces
from rayfix_offline.rays.rays import RaySet
from rayfix_offline.rays.segments import Sequences

SIZE = 6
"""Length of the joint vector."""

NUM_SUMS = 29
"""Sums of a group: 6 of mass (1, a, a a), 12 of mass x length (1, a, d, d a), 10 of mass x length^2 (1, d, d d), and
mass x number of walls.

The length of d is the geometric one, the others are measured lengths, which walls make longer."""


@numba.njit(cache=True, nogil=True)
def ring_span(azimuth: Any, reach: Any, cells: Any) -> Any:
    """First step, and the one after the last, of the cells of a ring within a reach [rad] of an azimuth.

    Steps are counted from -pi and are to be taken modulo the number of cells.
    """
    half = reach / (2.0 * np.pi) * cells
    middle = (azimuth + np.pi) / (2.0 * np.pi) * cells
    if 2.0 * half + 2.0 >= cells:
        return 0, cells
    return int(np.floor(middle - half)), int(np.floor(middle + half)) + 1


class GatheredRays(NamedTuple):
    """Rays, their pieces and sequences, as the kernels read them.

    Attributes
    ----------
    ring_offsets, ring_cells
        Of the grid with a ray in each of its cells, as in :class:`~rayfix_tables.grid.AngularGrid`.
    azimuth, zenith, solid_angle, directions
        As in :class:`~rayfix_offline.rays.rays.RaySet`.
    offsets, sequence, slice, mass, mean, variance, excess, num_walls
        As in :class:`~rayfix_offline.rays.pieces.Pieces`.
    images, mirrors
        As in :class:`~rayfix_offline.rays.segments.Sequences`.
    """

    ring_offsets: NDArray[np.int64]
    ring_cells: NDArray[np.int64]
    azimuth: NDArray[np.float64]
    zenith: NDArray[np.float64]
    solid_angle: NDArray[np.float64]
    directions: NDArray[np.float64]
    offsets: NDArray[np.int64]
    sequence: NDArray[np.int32]
    slice: NDArray[np.int16]
    mass: NDArray[np.float64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    excess: NDArray[np.float32]
    num_walls: NDArray[np.int8]
    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]


def gathered_rays(rays: RaySet, pieces: Pieces, sequences: Sequences) -> GatheredRays:
    """Return the arrays of rays, pieces and sequences."""
    return GatheredRays(
        ring_offsets=rays.grid.ring_offsets,
        ring_cells=rays.grid.ring_cells,
        azimuth=rays.azimuth,
        zenith=rays.zenith,
        solid_angle=rays.solid_angle,
        directions=rays.directions,
        offsets=pieces.offsets,
        sequence=pieces.sequence,
        slice=pieces.slice,
        mass=pieces.mass,
        mean=pieces.mean,
        variance=pieces.variance,
        excess=pieces.excess,
        num_walls=pieces.num_walls,
        images=sequences.images,
        mirrors=sequences.mirrors,
    )


class _Groups(NamedTuple):
    """Groups of a cell during summation.

    Attributes
    ----------
    rows : ndarray of int32, shape (n_sequences,)
        Row of ``slots`` of a sequence, -1 for none.
    slots : ndarray of int32, shape (capacity, n_slices)
        Group of a sequence and slice, -1 for none.
    keys : ndarray of int64, shape (capacity, 2)
        Sequence and slice of each group.
    sums : ndarray of shape (capacity, NUM_SUMS)
    """

    rows: NDArray[np.int32]
    slots: NDArray[np.int32]
    keys: NDArray[np.int64]
    sums: NDArray[np.float64]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gather_groups(
    centre_azimuth: Any,
    centre_zenith: Any,
    window: Any,
    cutoff: Any,
    rays: Any,
    num_slices: Any,
    rows: Any,
) -> Any:
    """Sum up the weighted moments of one cell.

    Of a ray with launch direction d and tangent angles a, a piece of geometric length L lies at
    ``image + mirror @ (L d)``. The moments of (L, a, L d) are therefore those of L times products of a and d, which are
    the same for all pieces.

    Parameters
    ----------
    window : float, rad
        Standard deviation of the cell's window.
    cutoff : float
        Rays are gathered within this many standard deviations.
    rays : GatheredRays
    num_slices : int
        Number of slices.
    rows : ndarray of int32, shape (n_sequences,)
        Scratch, all -1; restored.

    Returns
    -------
    sequence : ndarray of int64, shape (n_groups,)
    slice : ndarray of int64, shape (n_groups,)
    num_walls : ndarray of int64, shape (n_groups,)
        Mean number of walls, rounded.
    mass : ndarray of shape (n_groups,)
    mean : ndarray of shape (n_groups, 6)
    cov : ndarray of shape (n_groups, 6, 6)
    """
    keys = np.empty((64, 2), np.int64)
    sums = np.zeros((64, NUM_SUMS))
    count = np.int64(0)  # plain zeros would have _add_ray compiled once more, for constants
    # Groups by slice, only for the sequences that occur in the cell: those of a whole station would be too many.
    slots = np.full((64, num_slices), -1, np.int32)
    num_rows = np.int64(0)
    sine = np.sin(centre_zenith)
    reach = cutoff * window
    num_rings = len(rays.ring_cells)
    first_ring = max(0, int((centre_zenith - reach) / np.pi * num_rings))
    last_ring = min(num_rings - 1, int((centre_zenith + reach) / np.pi * num_rings))
    for ring in range(first_ring, last_ring + 1):
        cells = rays.ring_cells[ring]
        begin, stop = ring_span(centre_azimuth, reach / sine, cells)
        for step in range(begin, stop):
            ray = rays.ring_offsets[ring] + step % cells
            turn = rays.azimuth[ray] - centre_azimuth
            turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
            horizontal = sine * turn
            vertical = rays.zenith[ray] - centre_zenith
            square = (horizontal * horizontal + vertical * vertical) / (window * window)
            if square > cutoff * cutoff:
                continue
            density = np.exp(-0.5 * square) / (2.0 * np.pi * window * window) * rays.solid_angle[ray]
            first, last = rays.offsets[ray], rays.offsets[ray + 1]
            if count + last - first > len(sums):
                capacity = 2 * (count + last - first)
                keys, sums = _grown(keys, capacity, 0), _grown(sums, capacity, 0)
            if num_rows + last - first > len(slots):
                slots = _grown(slots, 2 * (num_rows + last - first), -1)
            groups = _Groups(rows, slots, keys, sums)
            count, num_rows = _add_ray(density, horizontal, vertical, ray, rays, groups, count, num_rows)

    masses = np.empty(count)
    num_walls = np.empty(count, np.int64)
    means = np.empty((count, SIZE))
    covs = np.empty((count, SIZE, SIZE))
    for group in range(count):
        rows[keys[group, 0]] = -1
        masses[group] = sums[group, 0]
        num_walls[group] = int(sums[group, 28] / sums[group, 0] + 0.5)
        _to_moments(sums[group], rays.images[keys[group, 0]], rays.mirrors[keys[group, 0]], means[group], covs[group])
    return keys[:count, 0], keys[:count, 1], num_walls, masses, means, covs


@numba.njit(cache=True, nogil=True)
def _add_ray(
    density: Any,
    horizontal: Any,
    vertical: Any,
    ray: Any,
    rays: Any,
    groups: Any,
    count: Any,
    num_rows: Any,
) -> Any:
    """Add a ray's pieces to the sums of their groups, and return the numbers of groups and of sequences.

    The terms are mass, mass x length and mass x length^2 times products of a and d. The loops are unrolled by hand, so
    that the products remain in registers for all pieces of the ray: that is three times as fast.
    """
    x, y, z = rays.directions[ray, 0], rays.directions[ray, 1], rays.directions[ray, 2]
    slots, keys, sums = groups.slots, groups.keys, groups.sums
    for piece in range(rays.offsets[ray], rays.offsets[ray + 1]):
        mass = density * rays.mass[piece]
        if mass <= 0.0:
            continue
        sequence, number = rays.sequence[piece], rays.slice[piece]
        row = groups.rows[sequence]
        if row < 0:
            row = num_rows
            num_rows += 1
            groups.rows[sequence] = row
        group = slots[row, number]
        if group < 0:
            group = count
            count += 1
            slots[row, number] = group
            keys[group, 0] = sequence
            keys[group, 1] = number
        mean, excess = rays.mean[piece], rays.excess[piece]
        measured = mean + excess
        once = mass * mean
        twice = mass * (rays.variance[piece] + mean * mean)
        measured_once = mass * measured
        measured_twice = mass * (rays.variance[piece] + measured * measured)
        across = mass * (rays.variance[piece] + measured * mean)
        sums[group, 0] += mass
        sums[group, 1] += mass * horizontal
        sums[group, 2] += mass * vertical
        sums[group, 3] += mass * (horizontal * horizontal)
        sums[group, 4] += mass * (horizontal * vertical)
        sums[group, 5] += mass * (vertical * vertical)
        sums[group, 6] += measured_once
        sums[group, 7] += measured_once * horizontal
        sums[group, 8] += measured_once * vertical
        sums[group, 9] += once * x
        sums[group, 10] += once * y
        sums[group, 11] += once * z
        sums[group, 12] += once * (x * horizontal)
        sums[group, 13] += once * (y * horizontal)
        sums[group, 14] += once * (z * horizontal)
        sums[group, 15] += once * (x * vertical)
        sums[group, 16] += once * (y * vertical)
        sums[group, 17] += once * (z * vertical)
        sums[group, 18] += measured_twice
        sums[group, 19] += across * x
        sums[group, 20] += across * y
        sums[group, 21] += across * z
        sums[group, 22] += twice * (x * x)
        sums[group, 23] += twice * (x * y)
        sums[group, 24] += twice * (x * z)
        sums[group, 25] += twice * (y * y)
        sums[group, 26] += twice * (y * z)
        sums[group, 27] += twice * (z * z)
        sums[group, 28] += mass * rays.num_walls[piece]
    return count, num_rows


@numba.njit(cache=True, nogil=True)
def _to_moments(sums: Any, image: Any, mirror: Any, mean: Any, cov: Any) -> None:
    """Turn the sums of a group into the mean and covariance of (L, a, x)."""
    raw = np.empty((SIZE, SIZE))
    first = np.empty(SIZE)
    mass = sums[0]
    first[0] = sums[6] / mass
    first[1] = sums[1] / mass
    first[2] = sums[2] / mass
    raw[0, 0] = sums[18] / mass
    raw[0, 1] = sums[7] / mass
    raw[0, 2] = sums[8] / mass
    raw[1, 1] = sums[3] / mass
    raw[1, 2] = sums[4] / mass
    raw[2, 2] = sums[5] / mass
    index = 21 + 1
    for i in range(3):
        first[3 + i] = sums[9 + i] / mass
        raw[1, 3 + i] = sums[12 + i] / mass
        raw[2, 3 + i] = sums[15 + i] / mass
        raw[0, 3 + i] = sums[19 + i] / mass
        for j in range(i, 3):
            raw[3 + i, 3 + j] = sums[index] / mass
            index += 1
    for i in range(SIZE):
        for j in range(i, SIZE):
            raw[i, j] -= first[i] * first[j]
            raw[j, i] = raw[i, j]
    # From the unfolded position L d to the position x = image + mirror @ (L d).
    for i in range(3):
        mean[i] = first[i]
        mean[3 + i] = image[i]
        for j in range(3):
            cov[i, j] = raw[i, j]
            mean[3 + i] += mirror[i, j] * first[3 + j]
            cov[3 + i, j] = mirror[i, 0] * raw[3, j] + mirror[i, 1] * raw[4, j] + mirror[i, 2] * raw[5, j]
            cov[j, 3 + i] = cov[3 + i, j]
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += mirror[j, k] * (
                    mirror[i, 0] * raw[3, 3 + k] + mirror[i, 1] * raw[4, 3 + k] + mirror[i, 2] * raw[5, 3 + k]
                )
            cov[3 + i, 3 + j] = total


@numba.njit(cache=True, nogil=True)
def blur(
    mean: Any,
    cov: Any,
    mirror: Any,
    centre_azimuth: Any,
    centre_zenith: Any,
    ray_spacing: Any,
    length_floor: Any,
    position_floor: Any,
) -> None:
    """Widen a group by the solid angle that its rays represent, and by the floors of the standard deviations.

    Parameters
    ----------
    mean : ndarray of shape (6,)
    cov : ndarray of shape (6, 6)
        Changed in place.
    mirror : ndarray of shape (3, 3)
        Of the group's reflection sequence.
    ray_spacing : float, rad
    length_floor, position_floor : float, m
        Standard deviations that are added along the tube and to the position.
    """
    sine = np.sin(centre_zenith)
    azimuth = centre_azimuth + mean[1] / sine
    zenith = min(max(centre_zenith + mean[2], 0.0), np.pi)
    local = np.empty((3, 3))
    local[0, 0] = np.sin(zenith) * np.cos(azimuth)
    local[1, 0] = np.sin(zenith) * np.sin(azimuth)
    local[2, 0] = np.cos(zenith)
    local[0, 1] = -np.sin(azimuth) * mean[0] * np.sin(zenith) / sine
    local[1, 1] = np.cos(azimuth) * mean[0] * np.sin(zenith) / sine
    local[2, 1] = 0.0
    local[0, 2] = np.cos(zenith) * np.cos(azimuth) * mean[0]
    local[1, 2] = np.cos(zenith) * np.sin(azimuth) * mean[0]
    local[2, 2] = -np.sin(zenith) * mean[0]
    variances = (
        length_floor * length_floor,
        ray_spacing * ray_spacing / 12.0,
        ray_spacing * ray_spacing / 12.0,
    )
    for k in range(3):
        for i in range(3):
            step_i = 0.0
            for a in range(3):
                step_i += mirror[i, a] * local[a, k]
            cov[3 + i, k] += variances[k] * step_i
            cov[k, 3 + i] += variances[k] * step_i
            for j in range(3):
                step_j = 0.0
                for a in range(3):
                    step_j += mirror[j, a] * local[a, k]
                cov[3 + i, 3 + j] += variances[k] * step_i * step_j
        cov[k, k] += variances[k]
    for i in range(3):
        cov[3 + i, 3 + i] += position_floor * position_floor


@numba.njit(cache=True, nogil=True)
def _grown(array: Any, capacity: Any, filling: Any) -> Any:
    """Copy rows into a larger array, in loops, because an assignment of slices takes seconds to compile."""
    larger = np.full((capacity, array.shape[1]), filling, array.dtype)
    for i in range(len(array)):
        for j in range(array.shape[1]):
            larger[i, j] = array[i, j]
    return larger


def new_rows(num_sequences: int) -> NDArray[np.int32]:
    """Scratch for :func:`gather_groups`."""
    return np.full(num_sequences, -1, np.int32)
