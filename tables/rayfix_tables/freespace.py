"""The positions where a UE can be: a voxel map of the building's free space."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

_NUM_ALL_OVER = 1000


@dataclass(frozen=True, kw_only=True)
class FreeSpace:
    """The voxels in which a UE can be.

    Attributes
    ----------
    origin : ndarray of shape (3,), m
        Low corner of voxel (0, 0, 0).
    voxel_size : float, m
    free : ndarray of bool, shape (nx, ny, nz)
        False inside solids and outside the building.
    """

    origin: NDArray[np.float64]
    voxel_size: float
    free: NDArray[np.bool_]

    @property
    def volume(self) -> float:
        """Volume of the free space, m3."""
        return float(np.count_nonzero(self.free)) * self.voxel_size**3

    @cached_property
    def largest_stdev(self) -> float:
        """Standard deviation, m, along the longest axis of a position that may be anywhere in the free space."""
        volume = max(np.count_nonzero(self.free), 1)
        cov = np.zeros((3, 3))
        for i, j in ((0, 1), (0, 2), (1, 2)):
            share = np.count_nonzero(self.free, axis=3 - i - j) / volume
            x, y = (np.arange(n) for n in share.shape)
            x, y = x - share.sum(axis=1) @ x, y - share.sum(axis=0) @ y
            cov[i, j] = cov[j, i] = x @ share @ y
            cov[i, i], cov[j, j] = share.sum(axis=1) @ x**2, share.sum(axis=0) @ y**2
        # Within a voxel it may be anywhere as well.
        return self.voxel_size * float(np.sqrt(np.linalg.eigvalsh(cov)[-1] + 1.0 / 12.0))

    @cached_property
    def points_all_over(self) -> NDArray[np.float64]:
        """Centres of some free voxels, in even steps through all, for a position of which nothing is known.

        An ndarray of shape (p, 3), m; p is 1000 to 2000, or the number of voxels if that is less.
        """
        counts = np.count_nonzero(self.free, axis=(1, 2))
        ends = np.cumsum(counts)
        ranks = np.arange(0, ends[-1], max(1, ends[-1] // _NUM_ALL_OVER))
        layers = np.searchsorted(ends, ranks, side="right")
        voxels = np.empty((len(ranks), 3))
        voxels[:, 0] = layers
        for i in np.unique(layers):  # one at a time: a list of all free voxels of a large site takes gigabytes
            here = layers == i
            free = np.flatnonzero(self.free[i])[ranks[here] - ends[i] + counts[i]]
            voxels[here, 1], voxels[here, 2] = np.divmod(free, self.free.shape[2])
        return self.origin + self.voxel_size * (voxels + 0.5)

    def moved(self, by: NDArray[np.float64]) -> "FreeSpace":
        """Return the map translated by a vector of shape (3,), m."""
        return replace(self, origin=self.origin + by) if np.any(by) else self

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points lie in free voxels.

        Parameters
        ----------
        points : ndarray of shape (..., 3), m

        Returns
        -------
        ndarray of bool, shape (...)
        """
        index = np.floor((points - self.origin) / self.voxel_size).astype(np.int64)
        inside = np.all((index >= 0) & (index < self.free.shape), axis=-1)
        index = np.where(inside[..., None], index, 0)
        return np.asarray(inside & self.free[index[..., 0], index[..., 1], index[..., 2]])
