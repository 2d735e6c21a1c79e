"""Multiply factors: hypotheses that pick one alternative of each, the best of them kept."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.factors import ALL_OUTLIER, Factor
from rayfix_service.fusion.kernels import extend_beam


@dataclass(frozen=True, kw_only=True)
class Hypotheses:
    """Products of factors, each a Gaussian over the position.

    Attributes
    ----------
    log_weight : ndarray of shape (h,)
        Log evidence, the best first.
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
    outlier : ndarray of int8, shape (h, n_factors)
        What the hypothesis takes for an outlier in each factor.
    log_lost : float
        Log evidence of the hypothesis that all factors are outliers.
    """

    log_weight: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]
    outlier: NDArray[np.int8]
    log_lost: float


def multiply(
    factors: Sequence[Factor], *, num_clocks: int, max_path_length: float, log_volume: float, width: int
) -> Hypotheses:
    """Find the most probable products of one alternative of each factor.

    Parameters
    ----------
    factors : sequence of Factor
        At least one.
    max_path_length : float, m
        Standard deviation of the prior of the clocks' offsets.
    width : int
        Hypotheses that are kept after each factor.
    """
    dimension = 3 + num_clocks
    information = np.zeros((1, dimension, dimension))
    for clock in range(3, dimension):
        information[0, clock, clock] = max_path_length**-2
    eta = np.zeros((1, dimension))
    log_scale = np.full(1, -num_clocks * (0.5 * np.log(2.0 * np.pi) + np.log(max_path_length)) - log_volume)
    # Few alternatives first: they cut the beam before it meets the many.
    order = sorted(range(len(factors)), key=lambda i: len(factors[i]))
    chosen = np.zeros((1, len(factors)), np.int8)
    score = np.zeros(1)
    for i in order:
        factor = factors[i]
        parent, choice, score = extend_beam(
            information, eta, log_scale, factor.information, factor.eta, factor.log_scale, width, log_volume
        )
        information = information[parent] + factor.information[choice]
        eta = eta[parent] + factor.eta[choice]
        log_scale = log_scale[parent] + factor.log_scale[choice]
        chosen = chosen[parent]
        chosen[:, i] = factor.outlier[choice]
    placed = np.trace(information[:, :3, :3], axis1=1, axis2=2) > 0.0
    cov = np.linalg.inv(information[placed])
    mean = np.einsum("hij,hj->hi", cov, eta[placed])
    log_lost = sum(float(f.log_scale[f.outlier == ALL_OUTLIER][0]) for f in factors)
    return Hypotheses(
        log_weight=score[placed],
        mean=mean[:, :3],
        cov=cov[:, :3, :3],
        outlier=chosen[placed],
        log_lost=log_lost,
    )
