"""The positions where a UE can be: a voxel map of the building's free space."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


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
