"""From a mixture of hypotheses to candidates: modes of the posterior, and which hypotheses belong to which.

The posterior is zero outside the free space, so each Gaussian is first cut to it: a fixed set of points stands for the
Gaussian, and what lies in the free space gives the cut one's weight, mean and covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.linalg import cholesky, inv
from numpy.typing import NDArray

from rayfix_service.fusion.kernels import climb
from rayfix_tables.freespace import FreeSpace

_LEAST_FREE_SHARE = 1e-3
_SAME_MODE = 9.0


@dataclass(frozen=True, kw_only=True)
class Modes:
    """Modes of the posterior, the most probable first.

    Attributes
    ----------
    probability : ndarray of shape (m,)
    position : ndarray of shape (m, 3), m
    cov : ndarray of shape (m, 3, 3), m2
        Second moment of the mode's hypotheses about ``position``.
    member : ndarray of int64, shape (h,)
        Mode of each hypothesis.
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
    return np.asarray(np.linalg.solve(root, points.T).T)


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
    spread = mean[:, None, :] + np.einsum("hij,nj->hni", cholesky(cov), points)
    free = free_space.contains(spread)
    share = free.mean(axis=1)
    cut = np.flatnonzero((share < 1.0) & (share > 0.0))
    mean, cov = mean.copy(), cov.copy()
    for h in cut:
        inside = spread[h][free[h]]
        mean[h] = inside.mean(axis=0)
        if len(inside) > 8:
            centred = inside - mean[h]
            # A little of the uncut covariance keeps the cut one regular.
            cov[h] = 0.9 * centred.T @ centred / len(inside) + 0.1 * cov[h]
    return log_weight + np.log(np.maximum(share, _LEAST_FREE_SHARE)), mean, cov


def find_modes(
    log_weight: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    free_space: FreeSpace,
) -> Modes:
    """Climb from hypotheses to modes and gather the hypotheses by the mode they belong to.

    Parameters
    ----------
    log_weight : ndarray of shape (h,)
        Natural logarithms; the weights sum to 1.
    """
    precision = inv(cov)
    log_density = log_weight + 0.5 * np.linalg.slogdet(precision)[1]
    count = len(log_weight)
    member = np.full(count, -1)
    tops: list[NDArray[np.float64]] = []
    top_precisions: list[NDArray[np.float64]] = []
    for h in np.argsort(-log_density):
        top, curvature = climb(log_density, mean, precision, mean[h])
        for n, (other, other_precision) in enumerate(zip(tops, top_precisions, strict=True)):
            apart = top - other
            # One hill, though with two humps: their distance is within what either is uncertain by.
            if min(apart @ other_precision @ apart, apart @ curvature @ apart) < _SAME_MODE:
                member[h] = n
                break
        else:
            member[h] = len(tops)
            tops.append(top)
            top_precisions.append(curvature)
    weight = np.exp(log_weight)
    modes = []
    for n, top in enumerate(tops):
        mine = member == n
        share = weight[mine] / weight[mine].sum()
        position = share @ mean[mine]
        if not free_space.contains(position):
            position = top
        apart = mean[mine] - position
        moment = np.einsum("h,hij->ij", share, cov[mine] + apart[:, :, None] * apart[:, None, :])
        modes.append((float(weight[mine].sum()), position, moment))
    order = np.argsort([-m[0] for m in modes], kind="stable")
    rank = np.empty(len(modes), np.int64)
    rank[order] = np.arange(len(modes))
    return Modes(
        probability=np.array([modes[i][0] for i in order]),
        position=np.array([modes[i][1] for i in order]),
        cov=np.array([modes[i][2] for i in order]),
        member=rank[member],
    )
