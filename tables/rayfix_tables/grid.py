"""The angular grid: rings of constant zenith, each cut into cells of about equal width."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rayfix_tables.geometry.angles import wrap


@dataclass(frozen=True, kw_only=True)
class AngularGrid:
    """Cells of directions, ring by ring from the zenith to the nadir, in each ring by azimuth from -pi.

    Attributes
    ----------
    ring_cells : ndarray of int64, shape (n_rings,)
        Number of cells of each ring; ring ``r`` holds the zeniths from ``r pi / n_rings`` to ``(r + 1) pi / n_rings``.
    """

    ring_cells: NDArray[np.int64]

    @classmethod
    def from_spacing(cls, spacing: float) -> "AngularGrid":
        """Grid whose cells are about ``spacing`` [rad] wide and high."""
        num_rings = max(2, int(np.ceil(np.pi / spacing)))
        zenith = (np.arange(num_rings) + 0.5) * np.pi / num_rings
        cells = np.maximum(1, np.ceil(2.0 * np.pi * np.sin(zenith) / spacing)).astype(np.int64)
        return cls(ring_cells=cells)

    @property
    def num_rings(self) -> int:
        """Number of rings."""
        return len(self.ring_cells)

    @cached_property
    def ring_offsets(self) -> NDArray[np.int64]:
        """First cell of each ring and, last, the number of cells; shape (n_rings + 1,)."""
        return np.concatenate([[0], np.cumsum(self.ring_cells)]).astype(np.int64)

    @property
    def num_cells(self) -> int:
        """Number of cells of the whole sphere."""
        return int(self.ring_offsets[-1])

    @cached_property
    def centres(self) -> NDArray[np.float64]:
        """Azimuth and zenith of the cells' centres, shape (n_cells, 2), rad."""
        ring = np.repeat(np.arange(self.num_rings), self.ring_cells)
        step = np.arange(self.num_cells) - self.ring_offsets[ring]
        azimuth = -np.pi + (step + 0.5) * 2.0 * np.pi / self.ring_cells[ring]
        zenith = (ring + 0.5) * np.pi / self.num_rings
        return np.stack([azimuth, zenith], axis=-1)

    @cached_property
    def solid_angles(self) -> NDArray[np.float64]:
        """Solid angle of one cell of each ring, shape (n_rings,), sr."""
        edges = np.cos(np.arange(self.num_rings + 1) * np.pi / self.num_rings)
        return (edges[:-1] - edges[1:]) * 2.0 * np.pi / self.ring_cells

    def nearest(self, azimuth: ArrayLike, zenith: ArrayLike) -> NDArray[np.int64]:
        """Cells that hold directions.

        Parameters
        ----------
        azimuth, zenith : array_like of a common shape, rad

        Returns
        -------
        ndarray of int64 of that shape
        """
        ring = np.clip(np.asarray(zenith) * self.num_rings / np.pi, 0, self.num_rings - 1).astype(np.int64)
        cells = self.ring_cells[ring]
        turn = (wrap(azimuth) + np.pi) / (2.0 * np.pi)
        step = np.minimum((turn * cells).astype(np.int64), cells - 1)
        return self.ring_offsets[ring] + step

    def cell_around(self, azimuth: float, zenith: float) -> tuple[int, float, float]:
        """Cell that holds one direction, and the azimuth and zenith of its centre, rad.

        Scalar version of :meth:`nearest` and :attr:`centres`, because a report looks up only a few directions.
        """
        ring = min(max(int(zenith * self.num_rings / math.pi), 0), self.num_rings - 1)
        cells = int(self.ring_cells[ring])
        turn = (math.remainder(azimuth, 2.0 * math.pi) + math.pi) / (2.0 * math.pi)
        step = min(int(turn * cells), cells - 1)
        centre = -math.pi + (step + 0.5) * 2.0 * math.pi / cells
        return int(self.ring_offsets[ring]) + step, centre, (ring + 0.5) * math.pi / self.num_rings
