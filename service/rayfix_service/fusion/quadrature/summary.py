"""Summarise a posterior on blocks, in compiled kernels."""

import math
from typing import Any

import numba
import numpy as np

from rayfix_service.fusion.posterior.modes import VALLEY
from rayfix_service.fusion.posterior.points import ListedPoints
from rayfix_service.fusion.posterior.summary import Summary
from rayfix_service.fusion.posterior.voxels import is_free_position, nearest_free
from rayfix_service.fusion.product.factor_kernels import ALL_OUTLIER
from rayfix_service.fusion.product.outliers import OutlierIndex
from rayfix_service.fusion.quadrature.grid import Leaves
from rayfix_service.fusion.quadrature.modes import modes_of_blocks
from rayfix_service.fusion.stopping import NEVER, Stop
from rayfix_tables.freespace import FreeSpace

_NUM_POINTS = 1024
"""Points that stand for the posterior in credible regions."""

_STEPS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)
"""Of an additive recurrence that fills a cube evenly: powers of 1 / 1.2207440846, the generalised golden ratio."""


def sum_up_leaves(
    leaves: Leaves, log_all_outlier: float, index: OutlierIndex, free_space: FreeSpace, stop: Stop = NEVER
) -> Summary:
    """Summarise a posterior on blocks.

    Parameters
    ----------
    leaves : Leaves
    log_all_outlier : float
        Log evidence of the case that everything is an outlier; the blocks' masses include it.
    """
    log_evidence = float(np.logaddexp.reduce(leaves.log_mass))
    share = np.exp(leaves.log_mass - log_evidence)
    lost = min(1.0, math.exp(log_all_outlier - log_evidence))
    outlier, half_bad = _outliers(share, leaves.late, leaves.lost, index.rows, len(index.places), ALL_OUTLIER)
    good = share * (1.0 - leaves.untold)
    top = modes_of_blocks(leaves.halvings, leaves.cell, leaves.log_mass - leaves.log_volume, VALLEY)
    space = free_space.origin, free_space.voxel_size, free_space.free
    stop.check()
    total = float(good.sum())
    if total <= 0.0:
        return Summary(log_evidence, 1.0, np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)), outlier, half_bad, _NONE)
    blocks = leaves.point, leaves.width, leaves.height
    probability, position, moment = _moments(good / total, *blocks, top, *space)
    points = ListedPoints(position=_points(good / total, *blocks, _NUM_POINTS, *space))
    return Summary(log_evidence, lost, probability, position, moment, outlier, half_bad, points)


_NONE = ListedPoints(position=np.empty((0, 3)))


@numba.njit(cache=True, nogil=True)
def _outliers(share: Any, late: Any, lost: Any, rows: Any, count: Any, all_outlier: Any) -> Any:
    """Probability of each measurement to be an outlier, and that at least half of the factors are altogether.

    Given a position, factors are outliers independently; what is left is the distribution of their number.
    """
    num_factors = lost.shape[1]
    lost_of, late_of = np.zeros(num_factors), np.zeros(num_factors)
    half_bad = 0.0
    number = np.empty(num_factors + 1)
    for n in range(len(share)):
        if share[n] < 1e-9:
            continue
        number[:] = 0.0
        number[0] = 1.0
        for f in range(num_factors):
            lost_of[f] += share[n] * lost[n, f]
            late_of[f] += share[n] * late[n, f]
            for k in range(f + 1, 0, -1):
                number[k] += (number[k - 1] - number[k]) * lost[n, f]
            number[0] *= 1.0 - lost[n, f]
        for k in range(num_factors + 1):
            if 2 * k >= num_factors:
                half_bad += share[n] * number[k]
    total = np.zeros(count)
    for r in range(len(rows)):
        factor = rows[r, 1]
        total[rows[r, 0]] += lost_of[factor] + (0.0 if rows[r, 2] == all_outlier else late_of[factor])
    return np.minimum(total, 1.0), min(half_bad, 1.0)


@numba.njit(cache=True, nogil=True)
def _moments(share: Any, point: Any, width: Any, height: Any, top: Any, origin: Any, voxel_size: Any, free: Any) -> Any:
    """Probability, position and second moment of each mode, the most probable first."""
    number = np.full(len(top), -1, np.int64)
    count = 0
    for n in range(len(top)):
        if number[top[n]] < 0:
            number[top[n]] = count
            count += 1
    probability, position, peak = np.zeros(count), np.zeros((count, 3)), np.empty((count, 3))
    for n in range(len(top)):
        mode = number[top[n]]
        probability[mode] += share[n]
        peak[mode] = point[top[n]]
        for i in range(3):
            position[mode, i] += share[n] * point[n, i]
    order = np.argsort(-probability, kind="mergesort")
    kept = 1
    while kept < count and probability[order[kept]] > 1e-6:
        kept += 1
    rank = np.full(count, -1, np.int64)
    for k in range(kept):
        rank[order[k]] = k
    probability, peak = probability[order[:kept]], peak[order[:kept]]
    position = position[order[:kept]] / probability.reshape(-1, 1)
    moment = np.zeros((kept, 3, 3))
    for again in range(2):
        for k in range(kept):
            if not is_free_position(free, origin, voxel_size, position[k]):
                if again == 0:
                    position[k] = peak[k]
                else:
                    nearest_free(position[k], moment[k], origin, voxel_size, free)
        moment[:] = 0.0
        for n in range(len(top)):
            k = rank[number[top[n]]]
            if k < 0:
                continue
            weight = share[n] / probability[k]
            for i in range(3):
                for j in range(3):
                    moment[k, i, j] += weight * (point[n, i] - position[k, i]) * (point[n, j] - position[k, j])
                moment[k, i, i] += weight * (height[n] if i == 2 else width[n]) ** 2 / 12.0
    return np.minimum(probability, 1.0), position, moment


@numba.njit(cache=True, nogil=True)
def _points(
    share: Any, point: Any, width: Any, height: Any, count: Any, origin: Any, voxel_size: Any, free: Any
) -> Any:
    """Places in blocks, each block having as many as its share (systematic resampling), spread evenly in it."""
    places = np.empty((count, 3))
    reached, n = share[0], 0
    for k in range(count):
        while (k + 0.5) / count > reached and n < len(share) - 1:
            n += 1
            reached += share[n]
        for i in range(3):
            aside = (0.5 + (k + 1) * _STEPS[i]) % 1.0 - 0.5
            places[k, i] = point[n, i] + aside * (height[n] if i == 2 else width[n])
        if not is_free_position(free, origin, voxel_size, places[k]):
            places[k] = point[n]
    return places
