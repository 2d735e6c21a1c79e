"""A fix together with the likelihood that it comes from."""

from dataclasses import dataclass

from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import Prior


@dataclass(frozen=True, kw_only=True)
class Fused:
    """A fix, and the likelihood that it comes from.

    The probability density of the report at a position x is ``sum_h exp(log_weight_h) N(x; mean_h, cov_h) / prior(x)``,
    and ``exp(log_all_outlier)`` besides for the case that all measurements are outliers.

    Attributes
    ----------
    fix : Fix
    hypotheses : Hypotheses or None
        Of the position, not yet cut to the free space; None where no measurement could be used. In the table's frame,
        as the prior.
    prior : Prior
        Of the position, with which the hypotheses' Gaussians are multiplied.
    """

    fix: Fix
    hypotheses: Hypotheses | None
    prior: Prior
