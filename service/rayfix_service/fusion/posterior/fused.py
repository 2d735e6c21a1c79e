"""A fix together with the likelihood that it comes from."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import Prior

if TYPE_CHECKING:
    from rayfix_service.fusion.quadrature.factor import PathFactor


class StationFactor(NamedTuple):
    """What a station measured of one path; ``factor`` is None where the report went the way of Gaussians."""

    station_id: str
    factor: "PathFactor | None"


@dataclass(frozen=True, kw_only=True)
class Fused:
    """A fix, its posterior, and the likelihood for filters that have a prior of their own.

    The probability density of the report at a position x is ``V sum_h exp(log_weight_h) N(x; mean_h, cov_h)`` with the
    volume V of the free space and the Gaussians of ``likelihood``, and ``exp(log_all_outlier)`` besides for the case
    that all measurements are outliers.

    Attributes
    ----------
    fix : Fix
    hypotheses : Hypotheses or None
        Of the position, not yet cut to the free space; None where no measurement could be used. In the table's frame,
        as the prior.
    prior : Prior
        Of the position, with which the hypotheses' Gaussians are multiplied.
    likelihood : Hypotheses or None
        The same without what is known of the height: from a product with a uniform prior of its own, since dividing the
        height out of merged hypotheses leaves precisions that are not positive. None where it was not asked for.
    factors : tuple of StationFactor
        The measurements themselves, for filters that evaluate them at positions.
    """

    fix: Fix
    hypotheses: Hypotheses | None
    prior: Prior
    likelihood: Hypotheses | None
    factors: tuple[StationFactor, ...] = ()
