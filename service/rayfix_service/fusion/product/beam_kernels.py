"""The compiled loop of the beam, on columns in information form.

:mod:`rayfix_service.fusion.product.beam` calls it; :mod:`rayfix_service.fusion.product.information_form` defines the
columns.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.product.information_form import add, dimension_of, invert_all, log_integrals
from rayfix_service.fusion.product.merging import merge_hypotheses
from rayfix_tables.gaussians.cholesky import cholesky
from rayfix_tables.gaussians.triangles import triangle

HOPELESS = 20.0
"""A product this many nats below the best is dropped: two of the next stations would have to be outliers."""

_LOWEST = float(np.finfo(np.float64).min)
"""A logarithm below all others."""

_RANKED_AFTER = 26
"""Factors after which numbers of outlier patterns are ranked: 3**26 times a million hypotheses is below 2**63."""


class FactorArrays(NamedTuple):
    """Alternatives of all factors, one factor after the other.

    Attributes
    ----------
    columns : ndarray of shape (rows, k)
        As :mod:`rayfix_service.fusion.product.information_form` has them.
    outlier : ndarray of int8, shape (k,)
        What each takes for an outlier.
    offsets : ndarray of int64, shape (n + 1,)
        Alternatives of factor f are those from ``offsets[f]`` to ``offsets[f + 1]``.
        The last of them is that all of it is an outlier.
    """

    columns: NDArray[np.float64]
    outlier: NDArray[np.int8]
    offsets: NDArray[np.int64]


class BeamLimits(NamedTuple):
    """How far a beam goes.

    Attributes
    ----------
    width : int
        Products that are kept after each factor.
    max_divergence : float
        What a merge may cost, nats.
    most_products : float
        Products that may be formed, in those of no clock. Each factor may use an equal part of what is left.
    """

    width: int
    max_divergence: float
    most_products: float


@numba.njit(cache=True, nogil=True)
def multiply_factors(factors: Any, prior: Any, log_range: Any, limits: Any, stop: Any) -> Any:
    """Extend a beam by one factor after the other, merging similar hypotheses.

    Parameters
    ----------
    factors : tuple
        The fields of :class:`FactorArrays`. Plain tuples, since it takes numba 4 us to find out what a named one is.
    prior : tuple
        The fields of a ``Prior``.
    log_range : float
        As in :func:`~rayfix_service.fusion.product.information_form.log_integrals`.
    limits : tuple
        The fields of :class:`BeamLimits`.
    stop : ndarray of uint8, shape (1,)
        As in :class:`~rayfix_service.fusion.stopping.Stop`, looked at for each hypothesis.

    Returns
    -------
    log_weight : ndarray of shape (h,)
        Of the hypotheses that place the UE, the best first.
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
        Positive definite.
    outlier : ndarray of int8, shape (h, n)
    log_all_outlier : float
        Log evidence of the hypothesis that all factors are outliers, which is none of the above.
    omitted : int
        Hypotheses that ``most_products`` left out.
    dropped : int
        Products that were left out because rounding made their matrices singular.
    """
    alternatives, outlier, offsets = factors
    width, max_divergence, most_products = limits
    log_volume = prior[0]
    beam = _prior_column(dimension_of(alternatives), prior, log_range)
    chosen = np.zeros((1, len(offsets) - 1), np.int8)
    pattern = np.zeros(1, np.int64)
    score = np.zeros(1)
    product_cost, merge_cost = product_costs(dimension_of(alternatives))
    left_over, omitted, dropped = most_products, 0, 0
    order = _order(alternatives[-1], offsets)
    for step in range(len(order)):
        if stop[0] != 0:
            break
        factor = order[step]
        begin, end = offsets[factor], offsets[factor + 1]
        own = np.ascontiguousarray(alternatives[:, begin:end])
        # Half of a factor's budget is for the products, half for merging them.
        budget = 0.5 * left_over / (len(order) - step)
        most = max(1, int(budget / (product_cost * (end - begin))))
        if most < beam.shape[1]:
            omitted += beam.shape[1] - most
            beam = np.ascontiguousarray(beam[:, :most])
        kept = max(1, min(width, int(budget / merge_cost)))
        parent, choice, score, singular = extend_beam(beam, own, kept, HOPELESS, log_volume, log_range, stop)
        dropped += singular
        if kept < width and len(score) == kept:
            omitted += 1  # at least
        left_over -= product_cost * beam.shape[1] * (end - begin) + merge_cost * len(score)
        product = np.empty((len(beam), len(score)))
        next_pattern = extend_patterns(pattern[parent], outlier[begin + choice], step)
        for row in range(len(beam)):
            for n in range(len(score)):
                product[row, n] = beam[row, parent[n]] + own[row, choice[n]]
        left = merge_hypotheses(product, score, next_pattern, max_divergence)
        left = left[np.argsort(-score[left], kind="mergesort")]
        next_chosen = np.empty((len(left), chosen.shape[1]), np.int8)
        for n in range(len(left)):
            next_chosen[n] = chosen[parent[left[n]]]
            next_chosen[n, factor] = outlier[begin + choice[left[n]]]
        beam = np.empty((len(product), len(left)))
        for row in range(len(product)):
            for n in range(len(left)):
                beam[row, n] = product[row, left[n]]
        score, pattern, chosen = score[left], next_pattern[left], next_chosen
    log_all_outlier = 0.0
    for factor in range(len(offsets) - 1):
        log_all_outlier += alternatives[-1, offsets[factor + 1] - 1]
    log_weight, mean, cov, chosen, singular = place_hypotheses(beam, score, chosen)
    return log_weight, mean, cov, chosen, log_all_outlier, omitted, dropped + singular


@numba.njit(cache=True, nogil=True)
def extend_patterns(pattern: Any, outlier: Any, num_before: Any) -> Any:
    """Extend the numbers of hypotheses' outlier patterns by one factor; equal numbers mean equal patterns.

    A number has a digit to the base 3 for each factor. Every so many factors the numbers are replaced by their ranks,
    before they exceed 63 bits.

    Parameters
    ----------
    pattern : ndarray of int64, shape (h,)
        Numbers without the factor.
    outlier : ndarray of int8, shape (h,)
        What each hypothesis takes for an outlier in the factor: 0, 1 or 2.
    num_before : int
        Number of factors before this one.
    """
    extended = 3 * pattern + outlier
    if num_before % _RANKED_AFTER != _RANKED_AFTER - 1:
        return extended
    ranked = np.empty_like(extended)
    rank, order = -1, np.argsort(extended)
    for n in range(len(order)):
        if n == 0 or extended[order[n]] != extended[order[n - 1]]:
            rank += 1
        ranked[order[n]] = rank
    return ranked


@numba.njit(cache=True, nogil=True)
def product_costs(dimension: Any) -> Any:
    """Return what forming a product of a dimension and merging it take, in products of dimension 3."""
    # Fitted to times: 17 ns and 0.2 us a product of dimension 3, 1.25 us and 27 us of dimension 24.
    return 0.86 + 0.0052 * dimension**3, 12.0 + 3.0 * dimension * (dimension - 3)


@numba.njit(cache=True, nogil=True)
def _order(log_scale: Any, offsets: Any) -> Any:
    """Order in which factors are taken, shape (n,): those with few alternatives first, which keep the beam narrow.

    Which of two equal ones comes first must not depend on the report's order.
    """
    total = np.empty(len(offsets) - 1)
    for factor in range(len(total)):
        total[factor] = log_scale[offsets[factor] : offsets[factor + 1]].sum()
    by_total = np.argsort(total, kind="mergesort")
    count = np.diff(offsets)[by_total].astype(np.float64)  # of the type of total, so that one sort is compiled
    return by_total[np.argsort(count, kind="mergesort")]


@numba.njit(cache=True, nogil=True)
def _prior_column(dimension: Any, prior: Any, log_range: Any) -> Any:
    """Prior of position and clocks, shape (rows, 1); a clock's offset is uniform over a range of that logarithm."""
    log_volume, precision, eta = prior
    column = np.zeros((triangle(dimension) + dimension + 1, 1))
    column[triangle(3) - 1] = precision
    column[triangle(dimension) + 2] = eta
    column[-1] = -(dimension - 3) * log_range - log_volume
    return column


@numba.njit(cache=True, nogil=True)
def extend_beam(beam: Any, factor: Any, width: Any, hopeless: Any, log_volume: Any, log_range: Any, stop: Any) -> Any:
    """Multiply every hypothesis by every alternative of a factor and keep the best products.

    Parameters
    ----------
    beam : ndarray of shape (rows, h)
        Hypotheses; the better ones come first, for speed only.
    factor : ndarray of shape (rows, k)
        Alternatives.
    width : int
        Products to keep.
    hopeless : float
        Products this many nats below the best are dropped.
    log_volume, log_range : float
        As in :func:`~rayfix_service.fusion.product.information_form.log_integrals`.
    stop : ndarray of uint8, shape (1,)
        As in :class:`~rayfix_service.fusion.stopping.Stop`.

    Returns
    -------
    parent, choice : ndarray of int64, shape (n,)
        Hypothesis and alternative of each product, in no order.
    score : ndarray of shape (n,)
        Log evidence of each product.
    dropped : int
        Products that were left out because rounding made their matrices singular.
    """
    count = factor.shape[1]
    products = np.empty(factor.shape)
    values, scratch = np.empty(count), np.empty(count)
    most = min(width, beam.shape[1] * count)
    parent, choice = np.empty(most, np.int64), np.empty(most, np.int64)
    score = np.empty(most)
    heap = np.empty(most, np.int64)
    kept, dropped = 0, 0
    top = _LOWEST  # not -inf, which a singular product has
    for h in range(beam.shape[1]):
        if stop[0] != 0:
            break
        add(beam, h, factor, products)
        log_integrals(products, log_volume, log_range, scratch, values)
        for k in range(count):  # a loop of its own, which the compiler turns into a few instructions
            dropped += not values[k] > -np.inf
        for k in range(count):
            value = values[k]
            if not value >= top - hopeless:
                continue
            top = max(top, value)
            if kept < most:
                parent[kept], choice[kept], score[kept] = h, k, value
                _sift_up(score, heap[: kept + 1])
                kept += 1
            elif value > score[heap[0]]:
                slot = heap[0]
                parent[slot], choice[slot], score[slot] = h, k, value
                _sift_down(score, heap, kept)
    hopeful = np.flatnonzero(score[:kept] >= top - hopeless)
    return parent[hopeful], choice[hopeful], score[hopeful], dropped


@numba.njit(cache=True, nogil=True)
def _sift_up(scores: Any, heap: Any) -> None:
    """Take the last entry, which is new, into the heap whose least score is at ``heap[0]``."""
    i = len(heap) - 1
    heap[i] = i
    while i > 0 and scores[heap[(i - 1) // 2]] > scores[heap[i]]:
        up = (i - 1) // 2
        heap[i], heap[up] = heap[up], heap[i]
        i = up


@numba.njit(cache=True, nogil=True)
def _sift_down(scores: Any, heap: Any, count: Any) -> None:
    """Restore the heap whose least score is at ``heap[0]``, after that entry has changed."""
    i = 0
    while True:
        least = i
        for child in (2 * i + 1, 2 * i + 2):
            if child < count and scores[heap[child]] < scores[heap[least]]:
                least = child
        if least == i:
            return
        heap[i], heap[least] = heap[least], heap[i]
        i = least


@numba.njit(cache=True, nogil=True)
def place_hypotheses(beam: Any, score: Any, chosen: Any) -> Any:
    """Give means and covariances of the position, of the hypotheses that constrain it.

    Parameters
    ----------
    beam : ndarray of shape (rows, h)
        Hypotheses, as :mod:`rayfix_service.fusion.product.information_form` has them.
    score : ndarray of shape (h,)
        Log evidence.
    chosen : ndarray of int8, shape (h, n)
        What each hypothesis takes for an outlier.

    Returns
    -------
    score, mean, cov, chosen : ndarray
        Of the hypotheses that place the UE; covariances are positive definite.
    dropped : int
        Hypotheses that were left out because rounding made their matrices singular.
    """
    dimension = dimension_of(beam)
    first = triangle(dimension)
    inverse = beam.copy()
    for clock in range(3, dimension):
        pivot = inverse[triangle(clock) + clock]
        for h in range(len(pivot)):
            if pivot[h] <= 0.0:
                # Of a clock that nothing constrains only this entry is not zero; it changes nothing else.
                pivot[h] = 1.0
    det = np.empty(len(score))
    invert_all(inverse, dimension, det)
    placing = np.flatnonzero((beam[0] > 0.0) & (score > -np.inf))
    means, covs = np.zeros((len(placing), 3)), np.empty((len(placing), 3, 3))
    lower = np.empty((3, 3))
    definite = np.zeros(len(placing), np.bool_)
    for n in range(len(placing)):
        h = placing[n]
        for i in range(3):
            for j in range(dimension):
                means[n, i] += inverse[triangle(max(i, j)) + min(i, j), h] * beam[first + j, h]
            for j in range(3):
                covs[n, i, j] = inverse[triangle(max(i, j)) + min(i, j), h]
        definite[n] = det[h] > 0.0 and cholesky(covs[n], lower)
    kept = np.flatnonzero(definite)
    placed = placing[kept]
    return score[placed], means[kept], covs[kept], chosen[placed], len(placing) - len(kept)
