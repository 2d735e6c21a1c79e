"""Prior of the position: uniform over the free space, or over the part of it about a known height.

The prior density is ``exp(eta z - precision z^2 / 2 - log_volume)`` in the free space and zero elsewhere. Without a
known height ``eta`` and ``precision`` are zero and ``log_volume`` is the logarithm of the free space's volume; with one
it is that of the integral of the exponential over the free space, which a sum over layers of voxels gives exactly.
"""

import math
from typing import NamedTuple

import numpy as np

from rayfix_service.fusion.measurements.report import Height
from rayfix_tables.errors import ReportError
from rayfix_tables.freespace import FreeSpace

_LEAST_AREA = 1e-9
"""A height with less free area [m2] than this lies in a solid between two storeys."""

_FARTHEST = 6.0
"""A height farther than this many standard deviations from all free space is a mistake."""


class Prior(NamedTuple):
    """Prior density of the position.

    Attributes
    ----------
    log_volume : float
        Natural logarithm of the integral of ``exp(eta z - precision z^2 / 2)`` over the free space, m3.
    precision : float, 1 / m2
    eta : float, 1 / m
    """

    log_volume: float
    precision: float = 0.0
    eta: float = 0.0

    def raised(self, by: float) -> "Prior":
        """Return the prior of a place that lies higher by so much, m: of ``z + by``."""
        return Prior(
            log_volume=self.log_volume + self.eta * by + 0.5 * self.precision * by**2,
            precision=self.precision,
            eta=self.eta + self.precision * by,
        )


def uniform_prior(free_space: FreeSpace) -> Prior:
    """Prior of a UE of unknown height."""
    return Prior(log_volume=math.log(max(free_space.volume, 1.0)))


def height_prior(height: Height, free_space: FreeSpace) -> Prior:
    """Prior of a UE whose height is known.

    Raises
    ------
    ReportError
        When no free space is near that height.
    """
    layers = np.count_nonzero(free_space.free, axis=(0, 1))
    edges = free_space.origin[2] + free_space.voxel_size * np.arange(len(layers) + 1)
    used = np.flatnonzero(layers)
    low, high = (edges[used[0]], edges[used[-1] + 1]) if len(used) else (0.0, 0.0)
    in_layer = np.diff([_normal_cdf((edge - height.z) / height.stdev) for edge in edges])
    area = float(layers @ in_layer) * free_space.voxel_size**2
    if area < _LEAST_AREA or not low - _FARTHEST * height.stdev <= height.z <= high + _FARTHEST * height.stdev:
        raise ReportError(
            f"height is {height.z:g} m with a deviation of {height.stdev:g} m, but the free space lies from {low:.2f} "
            f"to {high:.2f} m; give a height there, in the scene frame",
            path=("height",),
        )
    precision, eta = height.stdev**-2, height.z * height.stdev**-2
    log_peak = -0.5 * height.z * eta - math.log(math.sqrt(2.0 * math.pi) * height.stdev)
    return Prior(log_volume=math.log(area) - log_peak, precision=precision, eta=eta)


def _normal_cdf(x: float) -> float:
    return 0.5 * math.erfc(-x / math.sqrt(2.0))
