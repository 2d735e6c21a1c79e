"""Cut Gaussians to the free space, outside of which the posterior is zero.

A fixed set of points stands for a Gaussian, and what of it lies in the free space gives the cut one's weight, mean and
covariance. The NumPy twin is in ``reference.py``.
"""

from typing import Any

import numba
import numpy as np

from rayfix_service.fusion.posterior.voxels import in_voxels, is_free
from rayfix_tables.gaussians.cholesky import cholesky

_LEAST_FREE_SHARE = 1e-3
"""Weight that is left of a Gaussian which lies in a solid: the scene is not exact to the voxel."""


@numba.njit(cache=True, nogil=True)
def cut_to_free_space(
    log_weight: Any, mean: Any, cov: Any, points: Any, origin: Any, voxel_size: Any, free: Any
) -> Any:
    """Weights, means and covariances of Gaussians cut to the free space.

    Parameters
    ----------
    log_weight : ndarray of shape (h,)
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
    points : ndarray of shape (n, 3)
        From :func:`rayfix_tables.gaussians.normal_points.unit_points`.
    origin, voxel_size, free
        As in :class:`~rayfix_tables.freespace.FreeSpace`.

    Returns
    -------
    log_weight, mean, cov : ndarray
        A Gaussian without any points in the free space keeps its moments, and one with few its covariance. One whose
        covariance is not positive definite loses all of its weight.
    """
    log_weight, mean, cov = log_weight.copy(), mean.copy(), cov.copy()
    lower, second = np.zeros((3, 3)), np.empty((3, 3))
    first = np.empty(3)
    inside = np.empty(len(points), np.int64)
    for h in range(len(mean)):
        if not cholesky(cov[h], lower):
            log_weight[h] = -np.inf
            continue
        (x, y, z), (xx, yx, yy, zx, zy, zz) = in_voxels(mean[h], lower, origin, voxel_size)
        count = 0
        for n in range(len(points)):
            p, q, r = points[n, 0], points[n, 1], points[n, 2]
            if is_free(free, x + xx * p, y + yx * p + yy * q, z + zx * p + zy * q + zz * r):
                inside[count] = n
                count += 1
        log_weight[h] += np.log(max(count / len(points), _LEAST_FREE_SHARE))
        if count == 0 or count == len(points):
            continue
        first[:] = 0.0
        second[:] = 0.0
        for n in inside[:count]:
            for i in range(3):
                first[i] += points[n, i]
                for j in range(i + 1):
                    second[i, j] += points[n, i] * points[n, j]
        first /= count
        for i in range(3):
            for j in range(i + 1):
                second[i, j] = second[i, j] / count - first[i] * first[j]
                second[j, i] = second[i, j]
            mean[h, i] += lower[i, 0] * first[0] + lower[i, 1] * first[1] + lower[i, 2] * first[2]
        if count > 8:
            # A little of the uncut covariance keeps the cut one regular.
            for i in range(3):
                for j in range(3):
                    inner = 0.0
                    for k in range(i + 1):
                        for m in range(j + 1):
                            inner += lower[i, k] * second[k, m] * lower[j, m]
                    cov[h, i, j] = 0.9 * inner + 0.1 * cov[h, i, j]
    return log_weight, mean, cov
