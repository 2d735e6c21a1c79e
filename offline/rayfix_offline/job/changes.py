"""Changes of cells between two traces of a station: how far the measures that they are fitted to differ.

Rays of both traces have the same launch directions, so that they are compared one by one, piece by piece. A piece
contributes the part of its mass that is missing in the other trace: all of it where the rays differ, ``|m - m'|`` where
they are the same with other weights. The change of a cell is the sum over its rays, weighted by its window, as a
fraction of its mass: a bound on the L1 distance of the two measures. Cells whose pieces are equal to the last bit have
a change of exactly 0, and their fits are equal to the last bit.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.fit.moments import ring_span
from rayfix_offline.fit.settings import RayFit
from rayfix_offline.rays.trace import LevelRays

SMALLEST = float(np.finfo(np.float32).tiny)
"""Smallest change of a cell that is not equal to the last bit: 0 means exact."""


@dataclass(frozen=True, kw_only=True)
class ComparisonSettings:
    """Settings of the comparison; part of the identity of every station's part of a table.

    Attributes
    ----------
    same_course : float, m and 1
        Largest difference between the mirror images and mirrors of equal reflection sequences.
    """

    same_course: float = 1e-6


class _Trace(NamedTuple):
    """Pieces and sequences of a trace, as the kernel reads them."""

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
    surfaces: NDArray[np.int64]

    @classmethod
    def of(cls, level: LevelRays) -> "_Trace":
        """Return the trace of a level."""
        pieces, sequences = level.pieces, level.sequences
        return cls(
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
            surfaces=level.surface_sequences,
        )


def cell_changes(
    old: LevelRays,
    new: LevelRays,
    *,
    cutoff: float = RayFit.cutoff,
    settings: ComparisonSettings | None = None,
) -> NDArray[np.float64]:
    """Compare the cells of a level between two traces.

    Parameters
    ----------
    old, new : LevelRays
        Of the same station, window and seed, in two scenes.
    cutoff : float
        The fit gathers rays within this many standard deviations of the window.
    settings : ComparisonSettings, optional

    Returns
    -------
    ndarray of shape (n_cells,)
        Change of each cell's measure as a fraction of its new mass: 0 if nothing has changed, inf if no ray reaches the
        cell any longer, and inf for all cells if the launch directions differ.
    """
    if not np.array_equal(old.rays.directions, new.rays.directions):
        return np.full(new.grid.num_cells, np.inf)
    change, mass, same = ray_changes(old, new, settings)
    rays = new.rays
    return np.asarray(
        _sum_over_cells(
            new.grid.centres,
            new.window,
            cutoff,
            rays.grid.ring_offsets,
            rays.grid.ring_cells,
            rays.azimuth,
            rays.zenith,
            rays.solid_angle,
            change,
            mass,
            same,
        )
    )


def ray_changes(
    old: LevelRays, new: LevelRays, settings: ComparisonSettings | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Compare rays piece by piece.

    Returns
    -------
    change : ndarray of shape (n_rays,), m3 / sr
        Mass that occurs in one of the traces only.
    mass : ndarray of shape (n_rays,), m3 / sr
        Mass in the new trace.
    same : ndarray of bool, shape (n_rays,)
        Whether all pieces are equal to the last bit.
    """
    same_course = (settings or ComparisonSettings()).same_course
    change, mass, same = _compare(_Trace.of(old), _Trace.of(new), same_course)
    return change, mass, same


@numba.njit(cache=True, nogil=True)
def _compare(a: Any, b: Any, same_course: Any) -> Any:
    """Compare the rays of two traces piece by piece; see :func:`ray_changes`."""
    num_rays = len(b.offsets) - 1
    change = np.zeros(num_rays)
    mass = np.zeros(num_rays)
    same = np.ones(num_rays, np.bool_)
    # Sequences that the fit joins in one scene only, because a curved surface has changed.
    partner_a, partner_b = np.full(len(a.images), -1), np.full(len(b.images), -1)
    torn = np.zeros(len(b.images), np.bool_)
    for ray in range(num_rays):
        i, stop_i = a.offsets[ray], a.offsets[ray + 1]
        j, stop_j = b.offsets[ray], b.offsets[ray + 1]
        while i < stop_i or j < stop_j:
            # The next straight segment of the ray in each trace.
            end_i, end_j = i, j
            while end_i < stop_i and a.sequence[end_i] == a.sequence[i]:
                end_i += 1
            while end_j < stop_j and b.sequence[end_j] == b.sequence[j]:
                end_j += 1
            distance = np.inf
            if i < end_i and j < end_j:
                distance = _distance(
                    a.images[a.sequence[i]], a.mirrors[a.sequence[i]], b.images[b.sequence[j]], b.mirrors[b.sequence[j]]
                )
            if distance != 0.0:
                same[ray] = False
            else:
                whole_a, whole_b = a.surfaces[a.sequence[i]], b.surfaces[b.sequence[j]]
                if partner_a[whole_a] < 0 and partner_b[whole_b] < 0:
                    partner_a[whole_a], partner_b[whole_b] = whole_b, whole_a
                elif partner_a[whole_a] != whole_b:
                    torn[whole_b] = True
                    if partner_a[whole_a] >= 0:
                        torn[partner_a[whole_a]] = True
            while i < end_i or j < end_j:
                if distance <= same_course and i < end_i and j < end_j and a.slice[i] == b.slice[j]:
                    change[ray] += abs(a.mass[i] - b.mass[j])
                    mass[ray] += b.mass[j]
                    moved = abs(a.mean[i] - b.mean[j]) + abs(a.excess[i] - b.excess[j])
                    if moved > 0.0:
                        # The L1 distance of two normal densities is below their distance in standard deviations.
                        stdev = np.sqrt(max(a.variance[i], b.variance[j]))
                        change[ray] += min(a.mass[i], b.mass[j]) * (min(2.0, moved / stdev) if stdev else 2.0)
                    if a.mass[i] != b.mass[j] or moved > 0.0 or a.variance[i] != b.variance[j]:
                        same[ray] = False
                    if a.num_walls[i] != b.num_walls[j]:
                        same[ray] = False
                    i += 1
                    j += 1
                elif j == end_j or (i < end_i and a.slice[i] < b.slice[j]):
                    change[ray] += a.mass[i]
                    same[ray] = False
                    i += 1
                else:
                    change[ray] += b.mass[j]
                    mass[ray] += b.mass[j]
                    same[ray] = False
                    j += 1
    if torn.any():
        for ray in range(num_rays):
            for piece in range(b.offsets[ray], b.offsets[ray + 1]):
                if torn[b.surfaces[b.sequence[piece]]]:
                    same[ray] = False
    return change, mass, same


@numba.njit(cache=True, nogil=True)
def _distance(image_a: Any, mirror_a: Any, image_b: Any, mirror_b: Any) -> Any:
    """Largest difference between the images and mirrors of two reflection sequences."""
    largest = 0.0
    for row in range(3):
        largest = max(largest, abs(image_a[row] - image_b[row]))
        for column in range(3):
            largest = max(largest, abs(mirror_a[row, column] - mirror_b[row, column]))
    return largest


@numba.njit(cache=True, nogil=True)
def _sum_over_cells(
    centres: Any,
    window: Any,
    cutoff: Any,
    ring_offsets: Any,
    ring_cells: Any,
    azimuth: Any,
    zenith: Any,
    solid_angle: Any,
    change: Any,
    mass: Any,
    same: Any,
) -> Any:
    """Sum the changes of the rays of each cell; see :func:`rayfix_offline.fit.moments.gather_groups`."""
    result = np.zeros(len(centres))
    reach = cutoff * window
    num_rings = len(ring_cells)
    for cell in range(len(centres)):
        centre_azimuth, centre_zenith = centres[cell]
        sine = np.sin(centre_zenith)
        changed, whole, identical = 0.0, 0.0, True
        first_ring = max(0, int((centre_zenith - reach) / np.pi * num_rings))
        last_ring = min(num_rings - 1, int((centre_zenith + reach) / np.pi * num_rings))
        for ring in range(first_ring, last_ring + 1):
            cells = ring_cells[ring]
            begin, stop = ring_span(centre_azimuth, reach / sine, cells)
            for step in range(begin, stop):
                ray = ring_offsets[ring] + step % cells
                turn = azimuth[ray] - centre_azimuth
                turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
                horizontal = sine * turn
                vertical = zenith[ray] - centre_zenith
                square = (horizontal * horizontal + vertical * vertical) / (window * window)
                if square > cutoff * cutoff:
                    continue
                density = np.exp(-0.5 * square) * solid_angle[ray]
                changed += density * change[ray]
                whole += density * mass[ray]
                identical = identical and same[ray]
        if identical:
            continue
        result[cell] = max(changed / whole, SMALLEST) if whole > 0.0 else np.inf
    return result
