"""From a mixture of hypotheses to candidates: the hills of the posterior, and which hypotheses belong to which.

The posterior is zero outside the free space, so each Gaussian is first cut to it: a fixed set of points stands for the
Gaussian, and what lies in the free space gives the cut one's weight, mean and covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.linalg import cholesky, inv, slogdet
from numpy.typing import NDArray

from rayfix_service.fusion.mode_kernels import cut_gaussians, gather
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


def unit_points(count: int = 128) -> NDArray[np.float64]:
    """Points that stand for a standard normal in three dimensions, shape (count, 3): mean 0, covariance 1 exactly."""
    # An additive recurrence in three dimensions on the generalised golden ratio, mapped to the sphere and the radius.
    ratio = 1.2207440846057596
    index = np.arange(1, count // 2 + 1)
    uniform = (0.5 + index[:, None] * ratio ** -np.arange(1.0, 4.0)) % 1.0
    normal = np.sqrt(-2.0 * np.log(uniform[:, :1])) * np.stack(
        [np.cos(2.0 * np.pi * uniform[:, 1]), np.sin(2.0 * np.pi * uniform[:, 1])], axis=1
    )
    third = np.sqrt(-2.0 * np.log(np.roll(uniform[:, 0], count // 4))) * np.cos(2.0 * np.pi * uniform[:, 2])
    points = np.concatenate([normal, third[:, None]], axis=1)
    points = np.concatenate([points, -points])
    root = cholesky(np.cov(points.T, bias=True))
    return np.ascontiguousarray(np.linalg.solve(root, points.T).T)


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
        From :func:`unit_points`.
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
    precision = inv(cov)
    top, member = gather(log_weight + 0.5 * slogdet(precision)[1], mean, precision, _SAME_HILL)
    belongs = np.exp(log_weight) * (member == np.arange(len(top))[:, None])
    total = belongs.sum(axis=1)
    share = belongs / total[:, None]
    probability = np.minimum(total, 1.0)  # a sum of rounded numbers may be a little more
    position = share @ mean
    in_solid = ~free_space.contains(position)
    position[in_solid] = top[in_solid]
    moment = _second_moments(share, mean - position[member], cov)
    in_solid = ~free_space.contains(position)
    if in_solid.any():
        for n in np.flatnonzero(in_solid):
            position[n] = _nearest_free(position[n], moment[n], free_space)
        moment = _second_moments(share, mean - position[member], cov)
    order = np.argsort(-probability, kind="stable")
    rank = np.empty(len(top), np.int64)
    rank[order] = np.arange(len(top))
    return Modes(probability=probability[order], position=position[order], cov=moment[order], member=rank[member])


def _second_moments(
    share: NDArray[np.float64], apart: NDArray[np.float64], cov: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Second moment of each hill, shape (m, 3, 3), from its hypotheses' shares, shape (m, h), and distances from it."""
    about = cov + apart[:, :, None] * apart[:, None, :]
    return (share @ about.reshape(-1, 9)).reshape(-1, 3, 3)


def _nearest_free(
    position: NDArray[np.float64], cov: NDArray[np.float64], free_space: FreeSpace
) -> NDArray[np.float64]:
    """Nearest place in the free space, the position itself where none is near."""
    size = free_space.voxel_size
    reach = _NEAR * np.sqrt(np.diag(cov)) + size
    low = np.floor((position - reach - free_space.origin) / size).astype(np.int64)
    high = np.floor((position + reach - free_space.origin) / size).astype(np.int64) + 1
    low, high = np.clip(low, 0, free_space.free.shape), np.clip(high, 0, free_space.free.shape)
    block = free_space.free[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    corners = free_space.origin + size * (low + np.argwhere(block))
    if not len(corners):
        return position
    # Just inside the voxels: their faces may be another's.
    places = np.clip(position, corners + 1e-6 * size, corners + (1.0 - 1e-6) * size)
    apart = places - position
    return np.asarray(places[np.argmin(np.einsum("ni,ij,nj->n", apart, inv(cov), apart))])
