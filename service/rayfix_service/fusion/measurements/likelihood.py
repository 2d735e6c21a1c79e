"""Likelihoods that are not Gaussian, as sums of Gaussians.

The fusion multiplies Gaussians, so that a measurement with heavier tails becomes alternatives: each is a weighted
Gaussian, and a hypothesis picks one. That is exact for the contaminated Gaussian; a log-normal error is approximated.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from rayfix_service.fusion.measurements.report import ErrorModel
from rayfix_tables.gaussians.constants import LOG_2PI

_NARROW = 0.25
"""Standard deviation of a logarithm up to which the log-normal is cut no finer than in two: an error of 25 %."""

_GAUSSIAN_BELOW = 0.05
"""Standard deviation of a logarithm below which one Gaussian is enough."""

_STEP = 1.5
"""From one narrow Gaussian to the next, in their standard deviations: their sum ripples by less than a thousandth."""

_REACH = 2.6
"""Standard deviations of the weights at which a sum of narrow Gaussians ends."""


class Spread(NamedTuple):
    """One of the Gaussians that an error may be of; ``scale`` is in standard deviations of the measurement."""

    log_weight: float
    scale: float


class Term(NamedTuple):
    """``exp(log_weight) N(path length; value, variance)``, a part of a likelihood; m and m2."""

    log_weight: float
    value: float
    variance: float


ONE_GAUSSIAN = (Spread(0.0, 1.0),)


def spreads(model: ErrorModel) -> tuple[Spread, ...]:
    """Gaussians that an error of this model may be of."""
    if model.tail_share <= 0.0 or model.tail_scale == 1.0:
        return ONE_GAUSSIAN
    return (
        Spread(math.log1p(-model.tail_share), 1.0),
        Spread(math.log(model.tail_share), model.tail_scale),
    )


def gaussian_terms(value: float, stdev: float, model: ErrorModel) -> tuple[Term, ...]:
    """Likelihood of a path length [m] with additive error."""
    return tuple([Term(log_weight, value, (scale * stdev) ** 2) for log_weight, scale in spreads(model)])


def log_normal_terms(value: float, log_stdev: float) -> tuple[Term, ...]:
    """Likelihood of a path length [m] with a relative error, per metre: ``N(log value; log L, log_stdev^2) / value``.

    The Gaussian in log L is cut into narrow ones (a Gaussian is very nearly a sum of equally spaced narrower ones),
    each of which is a log-normal in L so narrow that the Gaussian with its moments is close enough: 9 for a standard
    deviation of up to 0.5, with an error of at most 5 % of the peak.
    """
    if log_stdev < _GAUSSIAN_BELOW:
        narrow, rest, count = log_stdev, 1.0, 0
    else:
        narrow = min(0.5 * log_stdev, _NARROW)
        rest = math.sqrt(log_stdev**2 - narrow**2)
        count = math.ceil(_REACH * rest / (_STEP * narrow))
    step = _STEP * narrow
    offsets = [step * k for k in range(-count, count + 1)]
    weights = [math.exp(-0.5 * (offset / rest) ** 2) for offset in offsets]
    # As a function of L this is a log-normal density with the median value exp(log_stdev^2), times this constant.
    log_total = 0.5 * log_stdev**2 - math.log(sum(weights))
    terms = []
    for offset, weight in zip(offsets, weights, strict=True):
        mean = value * math.exp(log_stdev**2 + offset + 0.5 * narrow**2)
        terms.append(Term(math.log(weight) + log_total, mean, math.expm1(narrow**2) * mean**2))
    return tuple(terms)


def total_variance(terms: Sequence[Term]) -> float:
    """Variance of the path length, m2, over all terms."""
    if len(terms) == 1:  # as most are
        return terms[0].variance
    weights = [math.exp(term.log_weight) for term in terms]
    total = sum(weights)
    mean = sum(w * term.value for w, term in zip(weights, terms, strict=True)) / total
    return sum(w * (t.variance + (t.value - mean) ** 2) for w, t in zip(weights, terms, strict=True)) / total


def product(terms: Sequence[Term], shared_variance: float) -> Term:
    """Product of Gaussians over one path length, whose errors have a part of this variance [m2] in common.

    Parameters
    ----------
    terms : sequence of Term
        At least one.
    """
    if len(terms) == 1:
        return Term(terms[0].log_weight, terms[0].value, terms[0].variance + shared_variance)
    precision = sum(1.0 / term.variance for term in terms)
    value = sum(term.value / term.variance for term in terms) / precision
    log_weight = 0.5 * (LOG_2PI - math.log(precision))
    for term in terms:
        square = (term.value - value) ** 2 / term.variance
        log_weight += term.log_weight - 0.5 * (square + math.log(term.variance) + LOG_2PI)
    return Term(log_weight, value, 1.0 / precision + shared_variance)
