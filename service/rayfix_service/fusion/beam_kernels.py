"""The compiled loop of :mod:`rayfix_service.fusion.beam`."""

from typing import Any

import numba
import numpy as np

from rayfix_service.fusion.kernels import cholesky, extend_beam, invert
from rayfix_service.fusion.merging import merge_hypotheses

HOPELESS = 20.0
"""A product this many nats below the best is given up: more than one station to come would have to be an outlier."""


@numba.njit(cache=True, nogil=True)
def multiply_factors(
    information: Any,
    eta: Any,
    log_scale: Any,
    factor_information: Any,
    factor_eta: Any,
    factor_scale: Any,
    factor_outlier: Any,
    offsets: Any,
    order: Any,
    width: Any,
    max_divergence: Any,
    log_volume: Any,
    log_range: Any,
) -> Any:
    """Extend a beam by one factor after the other, merging hypotheses that mean the same.

    Parameters
    ----------
    information : ndarray of shape (1, d, d)
        Of the prior.
    eta : ndarray of shape (1, d)
    log_scale : float
    factor_information : ndarray of shape (k, d, d)
        Alternatives of all factors.
    factor_eta : ndarray of shape (k, d)
    factor_scale : ndarray of shape (k,)
    factor_outlier : ndarray of int8, shape (k,)
    offsets : ndarray of int64, shape (n + 1,)
        Alternatives of factor f are those from ``offsets[f]`` to ``offsets[f + 1]``.
    order : ndarray of int64, shape (n,)
        In which the factors are taken.
    width : int
        Products that are kept after each factor.
    max_divergence : float
        What a merge may cost, nats.
    log_volume, log_range : float
        As in :func:`~rayfix_service.fusion.kernels.log_integral`.

    Returns
    -------
    log_weight : ndarray of shape (h,)
        Of the hypotheses that place the UE, the best first.
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
    outlier : ndarray of int8, shape (h, n)
    """
    size = eta.shape[1]
    num_factors = len(order)
    scale = np.full(1, log_scale)
    chosen = np.zeros((1, num_factors), np.int8)
    pattern = np.zeros(1, np.int64)
    score = np.zeros(1)
    for factor in order:
        begin, stop = offsets[factor], offsets[factor + 1]
        parent, choice, score = extend_beam(
            information,
            eta,
            scale,
            factor_information[begin:stop],
            factor_eta[begin:stop],
            factor_scale[begin:stop],
            width,
            HOPELESS,
            log_volume,
            log_range,
        )
        count = len(parent)
        next_information, next_eta = np.empty((count, size, size)), np.empty((count, size))
        next_scale, next_pattern = np.empty(count), np.empty(count, np.int64)
        for n in range(count):
            h, k = parent[n], begin + choice[n]
            for i in range(size):
                next_eta[n, i] = eta[h, i] + factor_eta[k, i]
                for j in range(size):
                    next_information[n, i, j] = information[h, i, j] + factor_information[k, i, j]
            next_scale[n] = scale[h] + factor_scale[k]
            next_pattern[n] = 3 * pattern[h] + factor_outlier[k]
        left = merge_hypotheses(next_information, next_eta, next_scale, score, next_pattern, max_divergence)
        left = left[np.argsort(-score[left], kind="mergesort")]
        next_chosen = np.empty((len(left), num_factors), np.int8)
        for n in range(len(left)):
            for i in range(num_factors):
                next_chosen[n, i] = chosen[parent[left[n]], i]
            next_chosen[n, factor] = factor_outlier[begin + choice[left[n]]]
        information, eta, scale = next_information[left], next_eta[left], next_scale[left]
        score, pattern, chosen = score[left], next_pattern[left], next_chosen
    return _placed(information, eta, score, chosen)


@numba.njit(cache=True, nogil=True)
def _placed(information: Any, eta: Any, score: Any, chosen: Any) -> Any:
    """Means and covariances of the position, of the hypotheses that say something of it."""
    count, size = eta.shape
    placed = np.empty(count, np.int64)
    mean, cov = np.empty((count, 3)), np.empty((count, 3, 3))
    lower, inverse = np.empty((size, size)), np.empty((size, size))
    num = 0
    for h in range(count):
        for clock in range(3, size):
            # Of a clock that nothing constrains only this entry is not zero; it changes nothing else.
            if information[h, clock, clock] <= 0.0:
                information[h, clock, clock] = 1.0
        if not (information[h, 0, 0] > 0.0 and score[h] > -np.inf and cholesky(information[h], lower)):
            continue
        invert(lower, inverse)
        for i in range(3):
            mean[num, i] = 0.0
            for j in range(size):
                mean[num, i] += inverse[i, j] * eta[h, j]
            for j in range(3):
                cov[num, i, j] = inverse[i, j]
        placed[num] = h
        num += 1
    placed = placed[:num]
    return score[placed], mean[:num].copy(), cov[:num].copy(), chosen[placed]
