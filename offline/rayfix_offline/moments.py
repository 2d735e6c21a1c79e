"""Moments of a cell's ray pieces, grouped by reflection sequence and slice.

The joint vector is (path length, horizontal angle, vertical angle, x, y, z); the angles are tangent coordinates of the
cell. Moments are taken about the group's own reference point, so that nothing large cancels.
"""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.pieces import FIRST_NODE

SIZE = 6
"""Length of the joint vector."""

CUTOFF = 3.0
"""A cell gathers rays within this many standard deviations of its window."""

POSITION_FLOOR = 0.005
"""Standard deviation that every component has at least across its tube, m."""

LENGTH_FLOOR = 0.05
"""Standard deviation that every component has at least along its tube, m."""

_KEY_STRIDE = 4096


@numba.njit(cache=True, nogil=True)
def gather_groups(
    centre_azimuth: Any,
    centre_zenith: Any,
    window: Any,
    ring_offsets: Any,
    ring_cells: Any,
    azimuth: Any,
    zenith: Any,
    solid_angle: Any,
    directions: Any,
    piece_offsets: Any,
    piece_sequence: Any,
    piece_slice: Any,
    piece_mass: Any,
    piece_mean: Any,
    piece_variance: Any,
    images: Any,
    mirrors: Any,
    log_ratio: Any,
    slots: Any,
) -> Any:
    """Add up the weighted moments of one cell.

    Parameters
    ----------
    window : float, rad
        Standard deviation of the cell's window.
    slots : ndarray of int64, shape (2**k,)
        Scratch of a hash table, all -1; left so.

    Returns
    -------
    sequence : ndarray of int64, shape (n_groups,)
    mass : ndarray of shape (n_groups,)
    mean : ndarray of shape (n_groups, 6)
    cov : ndarray of shape (n_groups, 6, 6)
    """
    capacity = 64
    keys = np.empty(capacity, np.int64)
    places = np.empty(capacity, np.int64)
    mass = np.zeros(capacity)
    first = np.zeros((capacity, SIZE))
    second = np.zeros((capacity, SIZE, SIZE))
    references = np.zeros((capacity, 4))
    count = 0
    num_slots = len(slots)

    centre = np.array(
        [
            np.sin(centre_zenith) * np.cos(centre_azimuth),
            np.sin(centre_zenith) * np.sin(centre_azimuth),
            np.cos(centre_zenith),
        ]
    )
    sine = np.sin(centre_zenith)
    reach = CUTOFF * window
    num_rings = len(ring_cells)
    first_ring = max(0, int((centre_zenith - reach) / np.pi * num_rings))
    last_ring = min(num_rings - 1, int((centre_zenith + reach) / np.pi * num_rings))
    delta = np.empty(SIZE)
    heading = np.empty(3)
    for ring in range(first_ring, last_ring + 1):
        cells = ring_cells[ring]
        half = reach / sine / (2.0 * np.pi) * cells
        middle = (centre_azimuth + np.pi) / (2.0 * np.pi) * cells
        if 2.0 * half + 2.0 >= cells:
            begin, stop = 0, cells
        else:
            begin, stop = int(np.floor(middle - half)), int(np.floor(middle + half)) + 1
        for step in range(begin, stop):
            ray = ring_offsets[ring] + step % cells
            turn = azimuth[ray] - centre_azimuth
            turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
            horizontal = sine * turn
            vertical = zenith[ray] - centre_zenith
            square = (horizontal * horizontal + vertical * vertical) / (window * window)
            if square > CUTOFF * CUTOFF:
                continue
            density = np.exp(-0.5 * square) / (2.0 * np.pi * window * window) * solid_angle[ray]
            for piece in range(piece_offsets[ray], piece_offsets[ray + 1]):
                if piece_mass[piece] <= 0.0:
                    continue
                seq = piece_sequence[piece]
                key = np.int64(seq) * _KEY_STRIDE + piece_slice[piece]
                slot = (key * np.int64(2654435761)) % num_slots
                while slots[slot] >= 0 and keys[slots[slot]] != key:
                    slot = (slot + 1) % num_slots
                group = slots[slot]
                if group < 0:
                    if 2 * count >= num_slots:
                        # The table is full: what comes last is the least of a cell with tens of thousands of groups.
                        continue
                    if count == capacity:
                        capacity *= 2
                        keys = _grown(keys, capacity)
                        places = _grown(places, capacity)
                        mass = _grown(mass, capacity)
                        first = _grown(first, capacity)
                        second = _grown(second, capacity)
                        references = _grown(references, capacity)
                    group = count
                    count += 1
                    slots[slot] = group
                    keys[group] = key
                    places[group] = slot
                    length = FIRST_NODE * np.exp(piece_slice[piece] * log_ratio)
                    references[group, 0] = length
                    for i in range(3):
                        references[group, 1 + i] = images[seq, i] + length * (
                            mirrors[seq, i, 0] * centre[0]
                            + mirrors[seq, i, 1] * centre[1]
                            + mirrors[seq, i, 2] * centre[2]
                        )
                for i in range(3):
                    heading[i] = (
                        mirrors[seq, i, 0] * directions[ray, 0]
                        + mirrors[seq, i, 1] * directions[ray, 1]
                        + mirrors[seq, i, 2] * directions[ray, 2]
                    )
                weight = density * piece_mass[piece]
                mean, variance = piece_mean[piece], piece_variance[piece]
                delta[0] = mean - references[group, 0]
                delta[1] = horizontal
                delta[2] = vertical
                for i in range(3):
                    delta[3 + i] = images[seq, i] + mean * heading[i] - references[group, 1 + i]
                mass[group] += weight
                for i in range(SIZE):
                    first[group, i] += weight * delta[i]
                    for j in range(i, SIZE):
                        second[group, i, j] += weight * delta[i] * delta[j]
                second[group, 0, 0] += weight * variance
                for i in range(3):
                    second[group, 0, 3 + i] += weight * variance * heading[i]
                    for j in range(i, 3):
                        second[group, 3 + i, 3 + j] += weight * variance * heading[i] * heading[j]

    sequence = np.empty(count, np.int64)
    means = np.empty((count, SIZE))
    for group in range(count):
        slots[places[group]] = -1
        sequence[group] = keys[group] // _KEY_STRIDE
        for i in range(SIZE):
            first[group, i] /= mass[group]
            means[group, i] = first[group, i]
        means[group, 0] += references[group, 0]
        for i in range(3):
            means[group, 3 + i] += references[group, 1 + i]
        for i in range(SIZE):
            for j in range(i, SIZE):
                second[group, i, j] = second[group, i, j] / mass[group] - first[group, i] * first[group, j]
                second[group, j, i] = second[group, i, j]
    return sequence, mass[:count], means, second[:count]


@numba.njit(cache=True, nogil=True)
def blur(
    mean: Any,
    cov: Any,
    mirror: Any,
    centre_azimuth: Any,
    centre_zenith: Any,
    ray_spacing: Any,
) -> None:
    """Give a group the width of its rays: each stands for a patch of directions, and nothing is exact to a millimetre.

    Parameters
    ----------
    mean : ndarray of shape (6,)
    cov : ndarray of shape (6, 6)
        Changed in place.
    mirror : ndarray of shape (3, 3)
        Of the group's reflection sequence.
    ray_spacing : float, rad
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
        LENGTH_FLOOR * LENGTH_FLOOR,
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
        cov[3 + i, 3 + i] += POSITION_FLOOR * POSITION_FLOOR


@numba.njit(cache=True, nogil=True)
def _grown(
    array: Any,
    capacity: Any,
) -> Any:
    larger = np.zeros((capacity, *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def new_slots(bits: int = 16) -> NDArray[np.int64]:
    """Scratch for :func:`gather_groups`."""
    return np.full(2**bits, -1, np.int64)
