"""Compiled look-ups in the voxel map of the free space."""

from typing import Any

import numba
import numpy as np

from rayfix_tables.gaussians.cholesky import cholesky, invert

_BLOCK = 8
"""Voxels along each side of a block that is searched at a time."""


@numba.njit(cache=True, nogil=True)
def is_free(free: Any, x: Any, y: Any, z: Any) -> Any:
    """Whether a position lies in a free voxel; its coordinates are in voxels from the map's low corner.

    The compiled twin of :meth:`rayfix_tables.freespace.FreeSpace.contains`.
    """
    nx, ny, nz = free.shape
    return 0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz and free[int(x), int(y), int(z)]


@numba.njit(cache=True, nogil=True)
def in_voxels(mean: Any, lower: Any, origin: Any, voxel_size: Any) -> Any:
    """Mean (x, y, z) and Cholesky factor (xx, yx, yy, zx, zy, zz) of a Gaussian in the units of :func:`is_free`."""
    middle = (
        (mean[0] - origin[0]) / voxel_size,
        (mean[1] - origin[1]) / voxel_size,
        (mean[2] - origin[2]) / voxel_size,
    )
    root = (
        lower[0, 0] / voxel_size,
        lower[1, 0] / voxel_size,
        lower[1, 1] / voxel_size,
        lower[2, 0] / voxel_size,
        lower[2, 1] / voxel_size,
        lower[2, 2] / voxel_size,
    )
    return middle, root


@numba.njit(cache=True, nogil=True)
def is_free_position(free: Any, origin: Any, voxel_size: Any, position: Any) -> Any:
    """Whether a position of shape (3,), m, lies in a free voxel."""
    x, y, z = position[0] - origin[0], position[1] - origin[1], position[2] - origin[2]
    return is_free(free, x / voxel_size, y / voxel_size, z / voxel_size)


@numba.njit(cache=True, nogil=True)
def nearest_free(position: Any, cov: Any, origin: Any, voxel_size: Any, free: Any) -> Any:
    """Move a position, in place, to the nearest one in the free space; False when there is no free space.

    Blocks of voxels are searched from the nearest on, until none that is left can hold a nearer position. With the
    block's centre c and the normal n = cov^-1 (c - position) of the ellipsoid through it, no x of the block is nearer
    than n . (x - position) / sqrt(n . cov n) (the inequality of Cauchy and Schwarz).

    Parameters
    ----------
    position : ndarray of shape (3,), m
    cov : ndarray of shape (3, 3), m2
        Of the Mahalanobis distance; there is no nearest position if it is not positive definite.
    origin, voxel_size, free
        As in :class:`~rayfix_tables.freespace.FreeSpace`.
    """
    lower, precision = np.empty((3, 3)), np.empty((3, 3))
    if not cholesky(cov, lower):
        return False
    invert(lower, precision)
    nx, ny, nz = free.shape
    bx, by, bz = (nx + _BLOCK - 1) // _BLOCK, (ny + _BLOCK - 1) // _BLOCK, (nz + _BLOCK - 1) // _BLOCK
    bound = np.empty(bx * by * bz)
    half = 0.5 * voxel_size * _BLOCK
    apart, best = np.empty(3), np.empty(3)
    for b in range(len(bound)):
        for i, n in enumerate((b // (by * bz), b // bz % by, b % bz)):
            apart[i] = origin[i] + half * (2 * n + 1) - position[i]
        square, reach = 0.0, 0.0
        for i in range(3):
            normal = precision[i, 0] * apart[0] + precision[i, 1] * apart[1] + precision[i, 2] * apart[2]
            square += normal * apart[i]
            reach += abs(normal) * half
        bound[b] = (square - reach) ** 2 / square if square > reach else 0.0
    least = np.inf
    # Just inside the voxels: their faces may be another's.
    inside = 1e-6 * voxel_size
    for b in np.argsort(bound):
        if bound[b] >= least:
            break
        x, y, z = _BLOCK * (b // (by * bz)), _BLOCK * (b // bz % by), _BLOCK * (b % bz)
        for vx in range(x, min(x + _BLOCK, nx)):
            for vy in range(y, min(y + _BLOCK, ny)):
                for vz in range(z, min(z + _BLOCK, nz)):
                    if not free[vx, vy, vz]:
                        continue
                    square = 0.0
                    for i, n in enumerate((vx, vy, vz)):
                        low = origin[i] + voxel_size * n
                        apart[i] = min(max(position[i], low + inside), low + voxel_size - inside) - position[i]
                    for i in range(3):
                        for j in range(3):
                            square += apart[i] * precision[i, j] * apart[j]
                    if square < least:
                        least = square
                        for i in range(3):
                            best[i] = apart[i]
    if least == np.inf:
        return False
    for i in range(3):
        position[i] += best[i]
    return True
