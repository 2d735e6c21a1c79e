"""``fit = "tubes"``: components by analytic moments of ray pieces, reduced by merging."""

from dataclasses import asdict
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.fit.join_surfaces import join_groups
from rayfix_offline.fit.moments import blur, gather_groups, gathered_rays, new_rows
from rayfix_offline.fit.runnalls import merge_runnalls
from rayfix_offline.fit.settings import TubeFit
from rayfix_offline.rays.trace import LevelRays
from rayfix_tables.gaussians.definite import is_definite
from rayfix_tables.mixture import TubeMixture, pack, widening_cov


class Fitted(NamedTuple):
    """Mixtures of a block of cells.

    Attributes
    ----------
    counts : ndarray of int64, shape (n_cells,)
        Components of each cell.
    log_mass : ndarray of shape (n_cells,)
        Natural logarithm of each cell's mass; -inf if no ray reaches it.
    mixture : TubeMixture
        Components of all cells.
    dropped : ndarray of int64, shape (n_cells,)
        Components of each cell that were dropped with their weight, because they had no positive definite covariance.
    """

    counts: NDArray[np.int64]
    log_mass: NDArray[np.float64]
    mixture: TubeMixture
    dropped: NDArray[np.int64]


class Labels(NamedTuple):
    """What components are called; fields as in :class:`~rayfix_tables.mixture.TubeMixture`."""

    num_reflections: NDArray[np.int8]
    num_walls: NDArray[np.int8]


class _Numbers(NamedTuple):
    """:class:`~rayfix_offline.fit.settings.TubeFit`, as the kernel reads it."""

    cutoff: float
    position_floor: float
    length_floor: float
    dropped_mass: float
    max_groups: int
    max_components: int
    max_divergence: float


def fit_tubes(centres: NDArray[np.float64], level: LevelRays, fit: TubeFit) -> Fitted:
    """Fit a block of cells.

    Parameters
    ----------
    centres : ndarray of shape (n_cells, 2), rad
        Azimuths and zeniths.
    """
    sequences = level.sequences
    counts, log_mass, log_weight, mean, cov, label, num_walls = _fit_block(
        centres,
        level.window,
        gathered_rays(level.rays, level.pieces, sequences),
        level.surface_sequences,
        bool(np.any(level.surface_sequences != np.arange(len(sequences.images)))),
        level.pieces.num_slices,
        level.ray_spacing,
        _Numbers(**asdict(fit)),
        new_rows(len(sequences.images)),
    )
    labels = Labels(sequences.num_reflections[label], num_walls.astype(np.int8))
    return fitted_cells(counts, log_mass, log_weight, mean, cov, labels, position_floor=fit.position_floor)


def fitted_cells(
    counts: NDArray[np.int64],
    log_mass: NDArray[np.float64],
    log_weight: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    labels: Labels,
    *,
    position_floor: float,
) -> Fitted:
    """Turn the joint moments of the components of cells into mixtures.

    Components without a positive definite covariance are dropped with their weight: the cell's mass is reduced, and the
    remaining weights add up to 1. Rounding can produce such components where masses are close to the smallest number.

    Parameters
    ----------
    counts, log_mass
        As in :class:`Fitted`, before components are dropped.
    log_weight : ndarray of shape (n,)
    mean, cov, labels, position_floor
        As in :func:`joint_to_tubes`.
    """
    proper = np.isfinite(mean).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)) & (mean[:, 0] > 0.0)
    proper[proper] = is_definite(cov[proper, :3, :3])
    dropped = np.zeros(len(counts), np.int64)
    if not proper.all():
        cell = np.repeat(np.arange(len(counts)), counts)
        weight = np.exp(log_weight)
        left, whole = (np.bincount(cell, w, len(counts)) for w in (np.where(proper, weight, 0.0), weight))
        proper &= left[cell] > 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            log_left = np.where(whole > 0.0, np.log(left) - np.log(whole), 0.0)
        dropped = np.bincount(cell[~proper], minlength=len(counts))
        counts, log_mass = counts - dropped, log_mass + log_left
        log_weight = (log_weight - log_left[cell])[proper]
        mean, cov, labels = mean[proper], cov[proper], Labels(*(column[proper] for column in labels))
    mixture = joint_to_tubes(log_weight, mean, cov, labels, position_floor=position_floor)
    return Fitted(counts, log_mass, mixture, dropped)


def joint_to_tubes(
    log_weight: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    labels: Labels,
    *,
    position_floor: float,
) -> TubeMixture:
    """Convert joint moments of (u, x) into those of u and of x given u, in double precision.

    Parameters
    ----------
    mean : ndarray of shape (n, 6)
    cov : ndarray of shape (n, 6, 6)
        Positive definite; so are the covariances of the mixture.
    position_floor : float, m
        Smallest standard deviation of the position given u.
    """
    u_cov = cov[:, :3, :3]
    jacobian = np.swapaxes(np.linalg.solve(u_cov, cov[:, :3, 3:]), 1, 2) if len(mean) else np.zeros((0, 3, 3))
    x_cov = cov[:, 3:, 3:] - jacobian @ cov[:, :3, 3:] - widening_cov(mean[:, :3], u_cov, jacobian)
    # A component that is not a single tube may be narrower than the widening of one.
    spread, axes = np.linalg.eigh(x_cov)
    spread = np.maximum(spread, position_floor**2)
    x_cov = (axes * spread[:, None, :]) @ axes.transpose(0, 2, 1)
    # Entries that would be zero are what rounding leaves of them, which differs from one LAPACK to the next.
    quantum = position_floor**2 / 2**20
    x_cov = np.round(x_cov / quantum) * quantum + 0.0
    return TubeMixture(
        log_weight=log_weight,
        u_mean=mean[:, :3],
        u_cov=pack(u_cov),
        x_mean=mean[:, 3:],
        jacobian=jacobian,
        x_cov=pack(x_cov),
        **labels._asdict(),
    )


@numba.njit(cache=True, nogil=True)
def _fit_block(
    centres: Any,
    window: Any,
    rays: Any,
    surface_sequences: Any,
    curved: Any,
    num_slices: Any,
    ray_spacing: Any,
    fit: Any,
    rows: Any,
) -> Any:
    """Fit cells; ``rays`` are :class:`GatheredRays` and ``fit`` is :class:`_Numbers`."""
    num_cells = len(centres)
    counts = np.zeros(num_cells, np.int64)
    log_mass = np.full(num_cells, -np.inf)
    log_weight = np.empty(num_cells * fit.max_components)
    mean = np.empty((num_cells * fit.max_components, 6))
    cov = np.empty((num_cells * fit.max_components, 6, 6))
    label = np.empty(num_cells * fit.max_components, np.int64)
    num_walls = np.empty(num_cells * fit.max_components, np.int64)
    total = 0
    for cell in range(num_cells):
        seq, slices, walls, mass, group_mean, group_cov = gather_groups(
            centres[cell, 0], centres[cell, 1], window, fit.cutoff, rays, num_slices, rows
        )
        group_mirror = rays.mirrors[seq]
        if curved:
            seq, mass, group_mean, group_cov, group_mirror, walls = join_groups(
                surface_sequences[seq], slices, mass, group_mean, group_cov, group_mirror, walls
            )
        whole = mass.sum()
        if whole <= 0.0:
            continue
        order = np.argsort(-mass)
        kept = 0
        left = whole
        while kept < min(len(mass), fit.max_groups) and left > fit.dropped_mass * whole:
            left -= mass[order[kept]]
            kept += 1
        chosen = order[:kept]
        weight = mass[chosen] / mass[chosen].sum()
        part_mean = group_mean[chosen]
        part_cov = group_cov[chosen]
        part_label = chosen.copy()
        part_mirror = group_mirror[chosen]
        for i in range(kept):
            blur(
                part_mean[i],
                part_cov[i],
                part_mirror[i],
                centres[cell, 0],
                centres[cell, 1],
                ray_spacing,
                fit.length_floor,
                fit.position_floor,
            )
        alive = merge_runnalls(weight, part_mean, part_cov, part_label, fit.max_components, fit.max_divergence)
        log_mass[cell] = np.log(whole)
        for i in range(kept):
            if alive[i]:
                log_weight[total] = np.log(weight[i])
                mean[total] = part_mean[i]
                cov[total] = part_cov[i]
                label[total] = seq[part_label[i]]
                num_walls[total] = walls[part_label[i]]
                total += 1
                counts[cell] += 1
    return counts, log_mass, log_weight[:total], mean[:total], cov[:total], label[:total], num_walls[:total]
