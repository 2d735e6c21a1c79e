"""The likelihood of the position given a report, without the prior: for multiplying with a track.

A fix is the product of the likelihood and of a prior, uniform over the free space. A track has a prior of its own, its
prediction, so that the fix's must not count again with each report.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import Prior
from rayfix_tables.gaussians.constants import LOG_2PI
from rayfix_tables.gaussians.definite import inverses

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Likelihood:
    """Likelihood ``sum_h exp(log_scale_h + slope_h . d - d . information_h . d / 2)`` with ``d = x - mean_h``.

    Attributes
    ----------
    log_scale : ndarray of shape (h,)
        Of the probability density of the report; the last is of the case that all measurements are outliers.
    mean : ndarray of shape (h, 3), m
    slope : ndarray of shape (h, 3), 1 / m
    information : ndarray of shape (h, 3, 3), 1 / m2
        May be singular: an azimuth alone does not constrain the height.
    dropped : int
        Hypotheses that were left out because their covariances are not positive definite.
    """

    log_scale: Array
    mean: Array
    slope: Array
    information: Array
    dropped: int = 0

    def those(self, index: NDArray[np.bool_]) -> "Likelihood":
        """Return the Gaussians that a mask picks; the others count as dropped."""
        return Likelihood(
            log_scale=self.log_scale[index],
            mean=self.mean[index],
            slope=self.slope[index],
            information=self.information[index],
            dropped=self.dropped + len(index) - int(np.count_nonzero(index)),
        )

    def log_density(self, points: Array) -> Array:
        """Natural logarithm of the likelihood at points of shape (n, 3), m; shape (n,)."""
        apart = points[:, None, :] - self.mean
        square = np.einsum("nhi,hij,nhj->nh", apart, self.information, apart)
        logs = self.log_scale + np.einsum("hi,nhi->nh", self.slope, apart) - 0.5 * square
        return np.asarray(np.logaddexp.reduce(logs, axis=1))


def likelihood_of(
    hypotheses: Hypotheses,
    log_volume: float,
    *,
    height: Prior | None = None,
    height_share: float = 0.0,
    variance_factor: float = 1.0,
) -> Likelihood:
    """Turn the hypotheses of a report into a likelihood.

    Parameters
    ----------
    hypotheses : Hypotheses
        Products of the measurements' likelihoods and of a prior that is uniform.
    log_volume : float
        Natural logarithm of the prior's volume, m3.
    height : Prior, optional
        What is known of the height. All reports of a target carry the same, so that no more than one of them may count
        in full; see ``TrackingSettings.height_seconds``.
    height_share : float
        Fraction of that knowledge that counts, 0 to 1: its Gaussian is raised to this power, and is 1 at its mean.
    variance_factor : float
        By which the Gaussians are widened, since the errors are correlated with those of the report before.
    """
    information, definite = inverses(hypotheses.cov)
    information, mean, log_weight = information[definite], hypotheses.mean[definite], hypotheses.log_weight[definite]
    log_scale = log_weight + 0.5 * np.linalg.slogdet(information)[1] - 1.5 * LOG_2PI + log_volume
    if variance_factor != 1.0:
        information = information / variance_factor
        log_scale -= 1.5 * np.log(variance_factor)
    log_scale = np.append(log_scale, hypotheses.log_all_outlier)
    mean = np.concatenate([mean, np.zeros((1, 3))])
    information = np.concatenate([information, np.zeros((1, 3, 3))])
    slope = np.zeros_like(mean)
    if height is not None and height.precision > 0.0:
        kept, known = height_share * height.precision, height.eta / height.precision
        mean[-1, 2] = known
        off = mean[:, 2] - known
        log_scale -= 0.5 * kept * off**2
        slope[:, 2] = -kept * off
        information[:, 2, 2] += kept
    return Likelihood(
        log_scale=log_scale,
        mean=mean,
        slope=slope,
        information=information,
        dropped=len(definite) - int(np.count_nonzero(definite)),
    )
