"""Compiled look-ups in the voxel map of the free space."""

from typing import Any

import numba
import numpy as np

from rayfix_service.fusion.posterior.cholesky import cholesky, invert


@numba.njit(cache=True, nogil=True)
def is_free(free: Any, x: Any, y: Any, z: Any) -> Any:
    """Whether a place lies in a free voxel; its coordinates are counted in voxels from the map's low corner.

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
def is_free_place(free: Any, origin: Any, voxel_size: Any, place: Any) -> Any:
    """Whether a place of shape (3,), m, lies in a free voxel."""
    x, y, z = place[0] - origin[0], place[1] - origin[1], place[2] - origin[2]
    return is_free(free, x / voxel_size, y / voxel_size, z / voxel_size)


@numba.njit(cache=True, nogil=True)
def nearest_free(position: Any, cov: Any, reach: Any, origin: Any, voxel_size: Any, free: Any) -> Any:
    """Move a position, in place, to the nearest one in the free space; False when there is none within reach.

    Parameters
    ----------
    position : ndarray of shape (3,), m
    cov : ndarray of shape (3, 3), m2
        What near means; nothing is, if it is not positive definite.
    reach : float
        Standard deviations along each axis of the box that is searched, which is wider by a voxel.
    origin, voxel_size, free
        As in :class:`~rayfix_tables.freespace.FreeSpace`.
    """
    lower, precision = np.empty((3, 3)), np.empty((3, 3))
    if not cholesky(cov, lower):
        return False
    invert(lower, precision)
    first, stop = np.empty(3, np.int64), np.empty(3, np.int64)
    for i in range(3):
        far = reach * np.sqrt(cov[i, i]) + voxel_size
        first[i] = max(0, int(np.floor((position[i] - far - origin[i]) / voxel_size)))
        stop[i] = min(free.shape[i], int(np.floor((position[i] + far - origin[i]) / voxel_size)) + 1)
    least = np.inf
    apart, best = np.empty(3), np.empty(3)
    # Just inside the voxels: their faces may be another's.
    inside = 1e-6 * voxel_size
    for x in range(first[0], stop[0]):
        for y in range(first[1], stop[1]):
            for z in range(first[2], stop[2]):
                if not free[x, y, z]:
                    continue
                square = 0.0
                for i, n in enumerate((x, y, z)):
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
