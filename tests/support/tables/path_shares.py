"""Shares of places: what a level says of each, summed over all paths; a plain twin of the kernels of ``balance``."""

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.normal_points import normal_points
from rayfix_tables.level import WINDOW_RATIO, Level
from rayfix_tables.mixture import unpack

Array = NDArray[np.float64]

SIDE = 0.2
"""Side of the blocks, m."""

CHUNK = 4096
"""Components that are spread at a time."""


def path_shares(level: Level, free_space: FreeSpace) -> tuple[Array, Array]:
    """Sum of the probabilities of all paths in each block of the free space.

    Returns
    -------
    share : ndarray of shape (nx, ny, nz)
        0 where nothing is free.
    volume : ndarray of shape (nx, ny, nz), m3
        Of the block's free part.
    """
    side = max(1, round(SIDE / free_space.voxel_size))
    shape = tuple(-(-n // side) for n in free_space.free.shape)
    volume, mass = np.zeros(shape), np.zeros(shape)
    np.add.at(volume, tuple(np.argwhere(free_space.free).T // side), free_space.voxel_size**3)
    points = np.array(normal_points(64))
    weight, mean, cov = measured_places(level)
    root = np.linalg.cholesky(cov + 1e-6 * np.eye(3))  # rounding may have made it singular
    for n in range(0, len(weight), CHUNK):
        chosen = slice(n, n + CHUNK)
        places = mean[chosen, None] + np.einsum("nij,pj->npi", root[chosen], points)
        voxels = np.floor((places - free_space.origin) / free_space.voxel_size).astype(int)
        held = ((voxels >= 0) & (voxels < free_space.free.shape)).all(axis=-1)
        held[held] = free_space.free[tuple(voxels[held].T)]
        each = np.broadcast_to(weight[chosen, None] / len(points), held.shape)
        np.add.at(mass, tuple(voxels[held].T // side), each[held])
    return np.divide(mass, volume, out=np.zeros(shape), where=volume > 0.0), volume


def measured_places(level: Level) -> tuple[Array, Array, Array]:
    """Places of each component, given a measurement in the middle of its cell with the noise that the window is for.

    Times the cell's solid angle, that sums over the directions that may be measured.

    Returns
    -------
    weight : ndarray of shape (n,), m3
    mean : ndarray of shape (n, 3), m
    cov : ndarray of shape (n, 3, 3), m2
    """
    window = level.window**2
    noise = window / WINDOW_RATIO**2
    remainder = window * noise / (window - noise)  # the window is in the components already
    mixture = level.mixture
    cell = np.repeat(np.arange(level.num_cells), np.diff(level.cell_offsets))
    slope = np.asarray(mixture.jacobian, np.float64)
    spread = unpack(np.asarray(mixture.u_cov, np.float64))
    apart = -np.asarray(mixture.u_mean, np.float64)[:, 1:]
    innovation = spread[:, 1:, 1:] + remainder * np.eye(2)
    gain = np.linalg.solve(innovation, spread[:, 1:, :]).transpose(0, 2, 1)
    distance = np.einsum("ni,ni->n", apart, np.linalg.solve(innovation, apart[..., None])[..., 0])
    evidence = np.exp(-0.5 * distance) / (2.0 * np.pi * np.sqrt(np.linalg.det(innovation)))
    area = np.repeat(level.grid.solid_angles, level.grid.ring_cells)
    density = np.exp(level.cell_log_mass)[cell] * 2.0 * np.pi * window**2 / (window - noise)
    weight = np.exp(mixture.log_weight.astype(np.float64)) * density * area[cell] * evidence
    if len(level.log_balance):
        weight = weight * np.exp(level.log_balance.astype(np.float64))
    step, left = np.einsum("njk,nk->nj", gain, apart), spread - gain @ spread[:, 1:, :]
    mean, cov = np.empty((len(weight), 3)), unpack(np.asarray(mixture.x_cov, np.float64))
    for n in range(0, len(weight), CHUNK):
        chosen = slice(n, n + CHUNK)
        moments = widened(step[chosen], left[chosen], slope[chosen], mixture.u_mean[chosen, 0], spread[chosen, 0, 1:])
        mean[chosen], cov[chosen] = mixture.x_mean[chosen] + moments[0], cov[chosen] + moments[1]
    return weight, mean, cov


def widened(step: Array, cov: Array, slope: Array, length: Array, moved: Array) -> tuple[Array, Array]:
    """Mean and covariance of what widening tubes make of Gaussian steps of their ray coordinates, by quadrature."""
    line, share = np.polynomial.hermite_e.hermegauss(3)  # exact up to the fifth power
    nodes = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", share, share, share).ravel() / share.sum() ** 3
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    d = step[:, None] + np.einsum("nij,pj->npi", root, nodes)
    products = (d[..., :1] * d[..., 1:] - moved[:, None]) / length[:, None, None]
    x = np.einsum("nij,npj->npi", slope, d) + np.einsum("nij,npj->npi", slope[:, :, 1:], products)
    mean = np.einsum("p,npi->ni", weights, x)
    apart = x - mean[:, None]
    return mean, np.einsum("p,npi,npj->nij", weights, apart, apart)
