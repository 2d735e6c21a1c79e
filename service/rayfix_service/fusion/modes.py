"""From a mixture of hypotheses to candidates: the hills of the posterior, and which hypotheses belong to which.

The posterior is zero outside the free space, so each Gaussian is first cut to it: a fixed set of points stands for the
Gaussian, and what lies in the free space gives the cut one's weight, mean and covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.mode_kernels import cut_gaussians, find_hills
from rayfix_tables.freespace import FreeSpace

_LEAST_FREE_SHARE = 1e-3
"""Weight that is left of a Gaussian which lies in a solid: the scene is not exact to the voxel."""

_SAME_HILL = 9.0

_NEAR = 3.0
"""A position in a solid moves to free space within this many standard deviations."""


@dataclass(frozen=True, kw_only=True)
class Modes:
    """Hills of the posterior, the most probable first.

    Attributes
    ----------
    probability : ndarray of shape (m,)
    position : ndarray of shape (m, 3), m
        Mean of the hill's hypotheses; the hill's mode, or the nearest free place, where the mean is in a solid.
    cov : ndarray of shape (m, 3, 3), m2
        Second moment of the hill's hypotheses about ``position``.
    member : ndarray of int64, shape (h,)
        Hill of each hypothesis.
    """

    probability: NDArray[np.float64]
    position: NDArray[np.float64]
    cov: NDArray[np.float64]
    member: NDArray[np.int64]


def cut_to_free_space(
    log_weight: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    free_space: FreeSpace,
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Weights, means and covariances of Gaussians cut to the free space.

    Parameters
    ----------
    points : ndarray of shape (n, 3)
        From :func:`rayfix_tables.normal.unit_points`.
    """
    mean, cov, share = mean.copy(), cov.copy(), np.empty(len(mean))
    cut_gaussians(mean, cov, points, free_space.origin, free_space.voxel_size, free_space.free, share)
    return log_weight + np.log(np.maximum(share, _LEAST_FREE_SHARE)), mean, cov


def find_modes(
    log_weight: NDArray[np.float64], mean: NDArray[np.float64], cov: NDArray[np.float64], free_space: FreeSpace
) -> Modes:
    """Climb from hypotheses to modes and gather the hypotheses by the hill they belong to.

    Parameters
    ----------
    log_weight : ndarray of shape (h,)
        Natural logarithms; the weights sum to 1.
    """
    space = free_space.origin, free_space.voxel_size, free_space.free
    probability, position, moment, member = find_hills(log_weight, mean, cov, *space, _SAME_HILL, _NEAR)
    return Modes(probability=probability, position=position, cov=moment, member=member)
