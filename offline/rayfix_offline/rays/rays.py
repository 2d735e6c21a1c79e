"""Directions in which a station's rays are launched."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.geometry.angles import direction
from rayfix_tables.grid import AngularGrid


@dataclass(frozen=True, kw_only=True)
class RaySet:
    """Directions that sample the sphere, one in each cell of a fine grid.

    Attributes
    ----------
    azimuth, zenith : ndarray of shape (n_rays,), rad
    solid_angle : ndarray of shape (n_rays,), sr
        Solid angle that each ray represents.
    """

    grid: AngularGrid
    azimuth: NDArray[np.float64]
    zenith: NDArray[np.float64]
    solid_angle: NDArray[np.float64]

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """Unit vectors, shape (n_rays, 3)."""
        return direction(self.azimuth, self.zenith)

    def __len__(self) -> int:
        """Return the number of rays."""
        return len(self.azimuth)


def sample_rays(spacing: float, rng: np.random.Generator) -> RaySet:
    """Draw one direction in each cell of a grid whose cells are about ``spacing`` [rad] wide."""
    grid = AngularGrid.from_spacing(spacing)
    ring = np.repeat(np.arange(grid.num_rings), grid.ring_cells)
    step = np.arange(grid.num_cells) - grid.ring_offsets[ring]
    azimuth = -np.pi + (step + rng.random(grid.num_cells)) * 2.0 * np.pi / grid.ring_cells[ring]
    # Uniform in the cosine within the ring, so that the directions are uniform on the sphere.
    high, low = np.cos(ring * np.pi / grid.num_rings), np.cos((ring + 1) * np.pi / grid.num_rings)
    zenith = np.arccos(high + (low - high) * rng.random(grid.num_cells))
    return RaySet(grid=grid, azimuth=azimuth, zenith=zenith, solid_angle=grid.solid_angles[ring])
