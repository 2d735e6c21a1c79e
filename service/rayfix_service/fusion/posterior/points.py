"""Points that stand for a posterior.

The thousand of a fix are 25 kB, and most fixes never need them. A fix keeps the ten or so Gaussians that they are drawn
from and, for each point of a fixed standard normal, the Gaussian that it belongs to.
"""

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.posterior.voxels import in_voxels, is_free
from rayfix_tables.gaussians.cholesky import cholesky, log_sum
from rayfix_tables.gaussians.normal_points import normal_points

IN_SOLID = -1
"""Owner of a point that would lie in a solid."""


class Points(Protocol):
    """Points that stand for a density, all alike."""

    def places(self) -> NDArray[np.float64]:
        """Where they are, shape (k, 3), m."""

    def moved(self, by: NDArray[np.float64]) -> "Points":
        """Return the same points elsewhere, moved by a vector of shape (3,), m."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ListedPoints:
    """Points listed one by one.

    Attributes
    ----------
    position : ndarray of shape (k, 3), m
    """

    position: NDArray[np.float64]

    def places(self) -> NDArray[np.float64]:
        """Where they are, shape (k, 3), m."""
        return self.position

    def moved(self, by: NDArray[np.float64]) -> "ListedPoints":
        """Return the same points elsewhere, moved by a vector of shape (3,), m."""
        return ListedPoints(position=self.position + by)


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnPoints:
    """Points drawn from a mixture of Gaussians cut to the free space.

    Attributes
    ----------
    mean : ndarray of shape (m, 3), m
        Of the Gaussians that have points.
    root : ndarray of shape (m, 3, 3), m
        A matrix of each, ``covariance = root root'``.
    owner : ndarray of int16, shape (n,)
        Gaussian of each of the n points of :func:`~rayfix_tables.gaussians.normal_points.normal_points`, or
        :data:`IN_SOLID`.
    """

    mean: NDArray[np.float64]
    root: NDArray[np.float64]
    owner: NDArray[np.int16]

    def places(self) -> NDArray[np.float64]:
        """Where they are, shape (k, 3), m."""
        return np.asarray(_places(self.mean, self.root, self.owner, normal_points(len(self.owner))).T)

    def moved(self, by: NDArray[np.float64]) -> "DrawnPoints":
        """Return the same points elsewhere, moved by a vector of shape (3,), m."""
        return replace(self, mean=self.mean + by)


@numba.njit(cache=True, nogil=True)
def _places(mean: Any, root: Any, owner: Any, normal: Any) -> Any:
    """Where points of :class:`DrawnPoints` are, shape (3, k), m; ``normal`` are those of the standard normal."""
    places = np.empty((3, len(owner)))
    count = 0
    for n in range(len(owner)):
        h = owner[n]
        if h != IN_SOLID:
            for i in range(3):
                places[i, count] = mean[h, i] + root[h, i, 0] * normal[n, 0] + root[h, i, 1] * normal[n, 1]
                places[i, count] += root[h, i, 2] * normal[n, 2]
            count += 1
    return places[:, :count].copy()


@numba.njit(cache=True, nogil=True)
def draw_points(log_weight: Any, mean: Any, cov: Any, normal: Any, origin: Any, voxel_size: Any, free: Any) -> Any:
    """Draw points from a mixture of Gaussians cut to the free space.

    Each Gaussian gets points in proportion to its weight (systematic resampling); those in solids are left out,
    unless all of them are: then they all are of the first Gaussian.

    Parameters
    ----------
    log_weight : ndarray of shape (h,)
        Of the Gaussians before they are cut.
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
    normal : ndarray of shape (n, 3)
        Cover a standard normal uniformly, and so does any run of them.
    origin, voxel_size, free
        As in :class:`~rayfix_tables.freespace.FreeSpace`.

    Returns
    -------
    mean, root, owner : ndarray
        As in :class:`DrawnPoints`.
    """
    weight = np.exp(log_weight - log_sum(log_weight))
    total = len(normal)
    owner = np.full(total, IN_SOLID, np.int16)
    chosen, root = np.empty((len(weight), 3)), np.zeros((len(weight), 3, 3))
    owners, drawn, placed = 0, 0, 0
    reached = 0.0
    for h in range(len(weight)):
        reached += weight[h]
        last = h == len(weight) - 1
        if drawn >= total or (not last and (drawn + 0.5) / total > reached):
            continue
        lower = root[owners]
        if not cholesky(cov[h], lower):
            continue
        chosen[owners] = mean[h]
        (x, y, z), (xx, yx, yy, zx, zy, zz) = in_voxels(mean[h], lower, origin, voxel_size)
        while drawn < total and (last or (drawn + 0.5) / total <= reached):
            p, q, r = normal[drawn, 0], normal[drawn, 1], normal[drawn, 2]
            if is_free(free, x + xx * p, y + yx * p + yy * q, z + zx * p + zy * q + zz * r):
                owner[drawn] = owners
                placed += 1
            drawn += 1
        owners += 1
    if placed == 0:
        owner[:] = 0
        owners = 1
        chosen[0] = mean[0]
        if not cholesky(cov[0], root[0]):
            root[0] = 0.0
    return chosen[:owners].copy(), root[:owners].copy(), owner
