"""Multiply factors: hypotheses that pick one alternative of each, the best of them kept."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.factors import ALL_OUTLIER, Factor
from rayfix_service.fusion.kernels import extend_beam
from rayfix_service.fusion.prior import Prior


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
        Log evidence of the hypothesis that all factors are outliers, which is none of the above.
    """

    log_weight: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]
    outlier: NDArray[np.int8]
    log_lost: float

    def __len__(self) -> int:
        """Return the number of hypotheses."""
        return len(self.log_weight)


def multiply(
    factors: Sequence[Factor], *, num_clocks: int, max_path_length: float, prior: Prior, width: int
) -> Hypotheses:
    """Find the most probable products of one alternative of each factor.

    Parameters
    ----------
    factors : sequence of Factor
        At least one.
    max_path_length : float, m
        What the prior density of a clock's offset is the inverse of, wherever the offset is.
    prior : Prior
        Of the position.
    width : int
        Hypotheses that are kept after each factor.
    """
    dimension = 3 + num_clocks
    log_range = float(np.log(max_path_length))
    information = np.zeros((1, dimension, dimension))
    eta = np.zeros((1, dimension))
    information[0, 2, 2], eta[0, 2] = prior.precision, prior.eta
    log_scale = np.full(1, -num_clocks * log_range - prior.log_volume)
    chosen = np.zeros((1, len(factors)), np.int8)
    score = np.zeros(1)
    # Few alternatives first: they cut the beam before it meets the many. Which of two alike comes first must not
    # depend on the report's order.
    for i in sorted(range(len(factors)), key=lambda i: (len(factors[i]), factors[i].log_scale.sum())):
        factor = factors[i]
        parent, choice, score = extend_beam(
            information,
            eta,
            log_scale,
            factor.information,
            factor.eta,
            factor.log_scale,
            width,
            prior.log_volume,
            log_range,
        )
        information = information[parent] + factor.information[choice]
        eta = eta[parent] + factor.eta[choice]
        log_scale = log_scale[parent] + factor.log_scale[choice]
        chosen = chosen[parent]
        chosen[:, i] = factor.outlier[choice]
    placed = (information[:, 0, 0] > 0.0) & (score > -np.inf)
    information, eta = information[placed], eta[placed]
    for clock in range(3, dimension):
        # Of a clock that nothing constrains only this entry is not zero; it changes nothing else.
        information[information[:, clock, clock] <= 0.0, clock, clock] = 1.0
    cov = np.linalg.inv(information)
    cov = 0.5 * (cov + cov.transpose(0, 2, 1))
    mean = (cov @ eta[:, :, None])[:, :, 0]
    return Hypotheses(
        log_weight=score[placed],
        mean=mean[:, :3],
        cov=cov[:, :3, :3],
        outlier=chosen[placed],
        log_lost=sum(float(f.log_scale[f.outlier == ALL_OUTLIER][0]) for f in factors),
    )
