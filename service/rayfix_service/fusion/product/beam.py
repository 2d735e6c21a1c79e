"""Multiply factors: hypotheses of one alternative of each factor; the best are kept and similar ones merged."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.product.beam_kernels import BeamLimits, FactorArrays, multiply_factors
from rayfix_service.fusion.product.factors import Factor
from rayfix_service.fusion.product.prior import Prior
from rayfix_service.fusion.stopping import NEVER, Stop

_MOST_PRODUCTS = 1e15
"""Stands for no limit: more products than can be formed in any reasonable time, and the number fits an integer."""


@dataclass(frozen=True, kw_only=True)
class Hypotheses:
    """Products of factors, each a Gaussian over the position.

    Attributes
    ----------
    log_weight : ndarray of shape (h,)
        Log evidence, the best first.
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
        Positive definite, if :func:`multiply` made them.
    outlier : ndarray of int8, shape (h, n_factors)
        What the hypothesis takes for an outlier in each factor.
    log_all_outlier : float
        Log evidence of the hypothesis that all factors are outliers, which is none of the above.
    omitted : int
        Hypotheses that were left out because there were too many products to form.
    dropped : int
        Alternatives and products that were left out because rounding made their matrices singular.
    """

    log_weight: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]
    outlier: NDArray[np.int8]
    log_all_outlier: float
    omitted: int = 0
    dropped: int = 0

    def __len__(self) -> int:
        """Return the number of hypotheses."""
        return len(self.log_weight)

    def best(self, most: int) -> "Hypotheses":
        """Give the best of them alone, at most so many."""
        if len(self) <= most:
            return self
        return replace(
            self,
            log_weight=self.log_weight[:most],
            mean=self.mean[:most],
            cov=self.cov[:most],
            outlier=self.outlier[:most],
        )


def multiply(
    factors: Sequence[Factor],
    *,
    max_path_length: float,
    prior: Prior,
    width: int,
    max_divergence: float,
    most_products: float = math.inf,
    stop: Stop = NEVER,
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
        Products that are kept after each factor, before similar ones are merged.
    max_divergence : float
        What such a merge may cost, nats.
    most_products : float
        Products that may be formed; those of a state with clocks count for more.
    stop : Stop
        Ends it early.

    Raises
    ------
    FixStoppedError
        When it was.
    """
    columns = np.concatenate([factor.columns for factor in factors], axis=1)
    outlier = np.concatenate([factor.outlier for factor in factors])
    offsets = np.array([0, *itertools.accumulate([len(factor) for factor in factors])])
    log_weight, mean, cov, outlier, log_all_outlier, omitted, dropped = multiply_factors(
        tuple(FactorArrays(columns, outlier, offsets)),
        tuple(prior),
        math.log(max_path_length),
        tuple(BeamLimits(width, float(max_divergence), float(min(most_products, _MOST_PRODUCTS)))),
        stop.cell,
    )
    stop.check()
    return Hypotheses(
        log_weight=log_weight,
        mean=mean,
        cov=cov,
        outlier=outlier,
        log_all_outlier=log_all_outlier,
        omitted=omitted,
        dropped=dropped + sum([factor.dropped for factor in factors]),
    )
