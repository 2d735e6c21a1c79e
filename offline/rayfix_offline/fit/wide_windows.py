"""Cells of wide windows, each a weighted sum of cells of the next finer level.

The windows of the finer cells f around a cell c add up to its own, N(a; 0, W) = sum_f q_f N(a - f; 0, W_f) with
``q_f = N(f; 0, W - W_f) dOmega_f``; their grid is so fine that the sum is exact to 1e-5. Rays are not gathered again,
and edges that cut rays off remain as sharp as in the fine cells. Gaussians fitted over the wide window would blur them.

Such a sum has thousands of components. A wide window is used for angles with more noise than the finer level is for,
and most of the components cannot be distinguished under that noise. They are merged under it.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.fit.moments import SIZE
from rayfix_offline.fit.settings import CoarseFit
from rayfix_offline.fit.tubes import Labels, fitted_cells
from rayfix_tables.compact.expanding import expanded_tubes
from rayfix_tables.gaussians.tree_reduction import halve_and_merge
from rayfix_tables.gaussians.triangles import unpack_upper
from rayfix_tables.level import Level
from rayfix_tables.mixture import TubeMixture


class _FinerCells(NamedTuple):
    """The finer level, as the kernel reads it; fields as in its grid, in :class:`Level` and in its mixture."""

    window: float
    ring_offsets: NDArray[np.int64]
    ring_cells: NDArray[np.int64]
    solid_angles: NDArray[np.float64]
    cell_offsets: NDArray[np.int64]
    cell_log_mass: NDArray[np.float64]
    cell_change: NDArray[np.float64]
    log_weight: NDArray[np.floating]
    u_mean: NDArray[np.floating]
    u_cov: NDArray[np.floating]
    x_mean: NDArray[np.floating]
    jacobian: NDArray[np.floating]
    x_cov: NDArray[np.floating]

    @classmethod
    def of(cls, level: Level, change: NDArray[np.float64]) -> "_FinerCells":
        """Return the cells of a level, and bounds on their changes as fractions of their present masses."""
        grid, tubes = level.grid, expanded_tubes(level.mixture, 0, len(level.mixture))
        return cls(
            window=level.window,
            ring_offsets=grid.ring_offsets,
            ring_cells=grid.ring_cells,
            solid_angles=grid.solid_angles,
            cell_offsets=level.cell_offsets,
            cell_log_mass=level.cell_log_mass,
            cell_change=change,
            **tubes._asdict(),
        )


@dataclass(frozen=True, kw_only=True)
class SummedCells:
    """Cells of a wide window.

    Attributes
    ----------
    counts : ndarray of int64, shape (n_cells,)
        Components of each cell.
    log_mass : ndarray of shape (n_cells,)
        Natural logarithm of each cell's mass; -inf if no ray reaches it.
    change : ndarray of shape (n_cells,)
        Bound on the change of each cell's measure, as a fraction of its mass.
    mixture : TubeMixture
        Components of all cells.
    dropped : ndarray of int64, shape (n_cells,)
        As in :class:`~rayfix_offline.fit.tubes.Fitted`.
    """

    counts: NDArray[np.int64]
    log_mass: NDArray[np.float64]
    change: NDArray[np.float64]
    mixture: TubeMixture
    dropped: NDArray[np.int64]


def sum_cells(
    centres: NDArray[np.float64], window: float, finer: Level, finer_change: NDArray[np.float32], fit: CoarseFit
) -> SummedCells:
    """Make cells of a wide window.

    Parameters
    ----------
    centres : ndarray of shape (n_cells, 2), rad
        Azimuths and zeniths of at least one cell.
    window : float, rad
        At least ``MIN_WINDOW_RATIO`` of the site file times the finer level's.
    finer_change : ndarray of shape (n_finer_cells,)
        Bound on the change of each finer cell's measure, as a fraction of its mass.
    """
    # For less noise than this, the finer level is used.
    angle = fit.noise_share * finer.window / fit.window_ratio
    noise = np.array([fit.range_stdev**2, angle**2, angle**2, 0.0, 0.0, 0.0])
    # A change is a fraction of the mass that an exact build gives; summed are the present masses.
    of_present = finer_change / np.maximum(1.0 - finer_change, 0.5)
    log_mass, change = np.empty(len(centres)), np.empty(len(centres))
    cells = _FinerCells.of(finer, of_present)
    parts = []
    for n, (azimuth, zenith) in enumerate(centres):
        log_mass[n], change[n], *components = _sum_cell(
            azimuth,
            zenith,
            window,
            cells,
            noise,
            fit.reach,
            fit.max_divergence,
            fit.length_stretch,
            fit.min_length,
        )
        parts.append(components)
    weight, mean, cov, heaviest = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    labels = Labels(finer.mixture.num_reflections[heaviest], finer.mixture.num_walls[heaviest])
    counts = np.array([len(components[0]) for components in parts])
    fitted = fitted_cells(counts, log_mass, np.log(weight), mean, cov, labels, position_floor=fit.position_floor)
    return SummedCells(change=change / np.maximum(1.0 - change, 0.5), **fitted._asdict())


@numba.njit(cache=True, nogil=True)
def _scale(weight: Any, mean: Any, noise: Any, length_stretch: Any, min_length: Any) -> Any:
    """Units in which the sides of boxes are compared: the effect of the angle noise at the mean path length."""
    length = 0.0
    for i in range(len(weight)):
        length += weight[i] * mean[i, 0]
    angle = np.sqrt(noise[1])
    scale = np.full(SIZE, max(length, min_length) * angle)
    scale[0] *= length_stretch  # tubes are straight along their length
    scale[1] = angle
    scale[2] = angle
    return scale


@numba.njit(cache=True, nogil=True)
def _joint(k: Any, stored: Any, mean: Any, cov: Any) -> None:
    """Mean and covariance of (u, x) of a component of :class:`_FinerCells`, with its widening."""
    jacobian = stored.jacobian
    unpack_upper(stored.u_cov, k, cov, 0)
    unpack_upper(stored.x_cov, k, cov, 3)
    for i in range(3):
        mean[i], mean[3 + i] = stored.u_mean[k, i], stored.x_mean[k, i]
    for i in range(3):
        for j in range(3):
            total = 0.0
            for m in range(3):
                total += jacobian[k, i, m] * cov[m, j]
            cov[3 + i, j] = total
            cov[j, 3 + i] = total
    for i in range(3):
        for j in range(i, 3):
            for m in range(3):
                cov[3 + i, 3 + j] += cov[3 + i, m] * jacobian[k, j, m]
            for a in range(1, 3):
                for b in range(1, 3):
                    products = cov[0, 0] * cov[a, b] + cov[0, a] * cov[0, b]
                    cov[3 + i, 3 + j] += products * jacobian[k, i, a] * jacobian[k, j, b] / (mean[0] * mean[0])
            cov[3 + j, 3 + i] = cov[3 + i, 3 + j]


@numba.njit(cache=True, nogil=True)
def _sum_cell(
    azimuth: Any,
    zenith: Any,
    window: Any,
    finer: Any,
    noise: Any,
    reach: Any,
    max_divergence: Any,
    length_stretch: Any,
    min_length: Any,
) -> Any:
    """Sum the cells around a direction: log mass, change, weights, means, covariances and heaviest finer components."""
    fine_window, ring_offsets, ring_cells = finer.window, finer.ring_offsets, finer.ring_cells
    offsets, cell_log_mass = finer.cell_offsets, finer.cell_log_mass
    num_rings = len(ring_cells)
    sine = np.sin(zenith)
    vertical = window * window - fine_window * fine_window
    far = reach * np.sqrt(vertical)
    cells, logs, moved = [0], [0.0], [(0.0, 0.0, 0.0)]
    cells.pop()
    logs.pop()
    moved.pop()
    total = 0
    first = max(0, int((zenith - far) / np.pi * num_rings))
    last = min(num_rings - 1, int((zenith + far) / np.pi * num_rings))
    for ring in range(first, last + 1):
        ring_zenith = (ring + 0.5) * np.pi / num_rings
        # A step of azimuth is longer in one cell's tangent plane than in the other's.
        stretch = sine / np.sin(ring_zenith)
        horizontal = max(window * window - (fine_window * stretch) ** 2, fine_window * fine_window)
        down = ring_zenith - zenith
        for step in range(ring_cells[ring]):
            cell = ring_offsets[ring] + step
            if offsets[cell] == offsets[cell + 1]:
                continue
            turn = -np.pi + (step + 0.5) * 2.0 * np.pi / ring_cells[ring] - azimuth
            turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
            across = sine * turn
            square = across * across / horizontal + down * down / vertical
            if square > reach * reach:
                continue
            cells.append(cell)
            density = np.exp(-0.5 * square) / (2.0 * np.pi * np.sqrt(horizontal * vertical))
            logs.append(np.log(density * finer.solid_angles[ring]) + cell_log_mass[cell])
            moved.append((across, down, stretch))
            total += offsets[cell + 1] - offsets[cell]
    weight, label = np.empty(total), np.empty(total, np.int64)
    mean, cov = np.empty((total, SIZE)), np.empty((total, SIZE, SIZE))
    if total == 0:
        return -np.inf, 0.0, weight, mean, cov, label
    top = max(logs)
    row = 0
    mass = 0.0
    change = 0.0
    for n in range(len(cells)):
        across, down, stretch = moved[n]
        factor = np.exp(logs[n] - top)
        mass += factor
        change += factor * finer.cell_change[cells[n]]
        for k in range(offsets[cells[n]], offsets[cells[n] + 1]):
            weight[row] = factor * np.exp(np.float64(finer.log_weight[k]))
            label[row] = k
            _joint(k, finer, mean[row], cov[row])
            mean[row, 1] = across + stretch * mean[row, 1]
            mean[row, 2] += down
            for i in range(SIZE):
                cov[row, 1, i] *= stretch
                cov[row, i, 1] *= stretch
            row += 1
    weight /= weight.sum()
    # A merged component has the labels of its heaviest part.
    heaviest = weight.copy()
    scale, one_group = _scale(weight, mean, noise, length_stretch, min_length), np.zeros(total, np.int64)
    into = halve_and_merge(weight, mean, cov, one_group, scale, noise, max_divergence)
    for n in range(total):
        if heaviest[n] > heaviest[into[n]]:
            heaviest[into[n]], label[into[n]] = heaviest[n], label[n]
    alive = into == np.arange(total)
    return top + np.log(mass), change / mass, weight[alive], mean[alive], cov[alive], label[alive]
