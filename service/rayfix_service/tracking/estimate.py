"""Summary of the particles: the position of the largest group of them."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from rayfix_service.tracking.particles import Particles
from rayfix_service.tracking.track import Estimate

_REACH = 0.5
"""Particles in neighbouring cells of this side, m, are of one group."""

_NEIGHBOURS = [step for step in product((-1, 0, 1), repeat=3) if any(step)]

Array = NDArray[np.float64]


def estimate(particles: Particles) -> Estimate:
    """Mean and covariance of the largest connected group of particles."""
    mine = largest_group(particles.position)
    position, velocity = particles.position[mine], particles.velocity[mine]
    return Estimate(
        probability=float(mine.mean()),
        position=position.mean(axis=0),
        covariance=_covariance(position),
        velocity=velocity.mean(axis=0),
        velocity_covariance=_covariance(velocity) + np.diag(particles.velocity_variance),
    )


def largest_group(positions: Array) -> NDArray[np.bool_]:
    """Which points are of the largest group: of cells that touch, if only at a corner.

    Parameters
    ----------
    positions : ndarray of shape (n, 3), m

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    cells, member, sizes = np.unique(
        np.floor(positions / _REACH).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    index = {tuple(cell): n for n, cell in enumerate(cells.tolist())}
    group = np.full(len(cells), -1)
    largest, most = 0, 0
    for start in range(len(cells)):
        if group[start] >= 0:
            continue
        group[start], todo, total = start, [start], 0
        while todo:
            n = todo.pop()
            total += int(sizes[n])
            x, y, z = cells[n].tolist()
            for i, j, k in _NEIGHBOURS:
                neighbour = index.get((x + i, y + j, z + k))
                if neighbour is not None and group[neighbour] < 0:
                    group[neighbour] = start
                    todo.append(neighbour)
        if total > most:
            largest, most = start, total
    return np.asarray(group[member.ravel()] == largest)


def _covariance(values: Array) -> Array:
    """Covariance of values, shape (3, 3), regular whatever they are."""
    apart = values - values.mean(axis=0)
    return np.asarray(apart.T @ apart / max(len(values) - 1, 1) + 1e-9 * np.eye(3))
