"""Statistics of angle errors, in the form of reports and site files."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.report import GAUSSIAN, ErrorModel

Array = NDArray[np.float64]

LEAST_TAIL = 1e-3
"""Smallest fraction of wide errors; smaller ones are not allowed in a report and are neglected."""

_STEPS = 500
_MOST_TAIL = 0.5
_SCALES = (1.5, 20.0)  # range in a report
_TOLERANCE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class AngleErrors:
    """Errors of n reported angles, estimated minus true.

    Attributes
    ----------
    azimuth, zenith : ndarray of shape (n,), rad
        Errors of the angles themselves.
    apart : ndarray of shape (n,), rad
        Angle between the estimated direction and the true one.
    other_path : ndarray of bool of shape (n,)
        Whether the estimate is nearer to another path than to the strongest.
    """

    azimuth: Array
    zenith: Array
    apart: Array
    other_path: NDArray[np.bool_]

    def __len__(self) -> int:
        """Return the number of angles."""
        return len(self.azimuth)


@dataclass(frozen=True, kw_only=True)
class AngleStatistics:
    """Error statistics of one kind of station.

    Attributes
    ----------
    num_angles : int
    outlier_share : float
        Fraction of the angles with errors above a limit; they are excluded from the other statistics.
    other_path_share : float
        Fraction of all angles that are nearer to another path than to the strongest.
    azimuth_bias, zenith_bias : float, rad
        Medians of the errors.
    azimuth_stdev, zenith_stdev : float, rad
        Standard deviations about the bias; of the narrower Gaussian if the errors have heavy tails.
    bias_stdev : float, rad
        Uncertainty of the larger bias.
    error_model : ErrorModel
        Probability and width of the tails.
    """

    num_angles: int
    outlier_share: float
    other_path_share: float
    azimuth_bias: float
    zenith_bias: float
    azimuth_stdev: float
    zenith_stdev: float
    bias_stdev: float
    error_model: ErrorModel

    def report_fields(self) -> dict[str, Any]:
        """Fields of an ``aoa`` measurement in a report."""
        fields: dict[str, Any] = {
            "azimuth_stdev_deg": float(np.degrees(self.azimuth_stdev)),
            "zenith_stdev_deg": float(np.degrees(self.zenith_stdev)),
        }
        if self.error_model != GAUSSIAN:
            fields |= {
                "error_model": "heavy_tailed",
                "tail_share": self.error_model.tail_share,
                "tail_scale": self.error_model.tail_scale,
            }
        return fields

    def site_bias(self) -> dict[str, float]:
        """Table ``bias`` of a station in a site file."""
        return {
            "azimuth_deg": float(np.degrees(self.azimuth_bias)),
            "zenith_deg": float(np.degrees(self.zenith_bias)),
            "angle_stdev_deg": float(np.degrees(self.bias_stdev)),
        }


def angle_statistics(errors: AngleErrors, *, limit: float) -> AngleStatistics:
    """Compute the statistics of errors.

    Parameters
    ----------
    limit : float, rad
        Angles with larger errors are outliers.

    Raises
    ------
    ValueError
        If fewer than ten angles are inliers.
    """
    kept = errors.apart <= limit
    if kept.sum() < 10:
        raise ValueError(
            f"only {int(kept.sum())} of {len(errors)} angles are within {np.degrees(limit):.3g} deg; give more"
        )
    both = np.stack([errors.azimuth[kept], errors.zenith[kept]], axis=-1)
    bias = np.median(both, axis=0)
    stdev, model = fit_tails(both - bias)
    # The median's standard deviation is sqrt(pi / 2) times the mean's.
    bias_stdev = float(np.sqrt(0.5 * np.pi / kept.sum()) * stdev.max())
    return AngleStatistics(
        num_angles=len(errors),
        outlier_share=float(1.0 - kept.mean()),
        other_path_share=float(errors.other_path.mean()),
        azimuth_bias=float(bias[0]),
        zenith_bias=float(bias[1]),
        azimuth_stdev=float(stdev[0]),
        zenith_stdev=float(stdev[1]),
        bias_stdev=bias_stdev,
        error_model=model,
    )


def fit_tails(errors: Array) -> tuple[Array, ErrorModel]:
    """Fit a contaminated Gaussian to errors by expectation-maximisation.

    Parameters
    ----------
    errors : ndarray of shape (n, d)
        Errors with zero mean.

    Returns
    -------
    stdev : ndarray of shape (d,)
        Standard deviations of the narrower Gaussian.
    error_model : ErrorModel
        Gaussian if the tails are negligible.

    Notes
    -----
    The wider Gaussian has the same shape: its probability and its scale are one number each, as in reports. A. P.
    Dempster, N. M. Laird, D. B. Rubin, Journal of the Royal Statistical Society B 39 (1977).
    """
    squares = np.square(errors)
    dimension = errors.shape[1]
    # The median of a squared standard normal is 0.455.
    variance = np.maximum(np.median(squares, axis=0) / 0.455, 1e-30)
    share, scale = 0.1, 3.0
    log_likelihood = -np.inf
    for _ in range(_STEPS):
        distance = (squares / variance).sum(axis=1)
        narrow = np.log1p(-share) - 0.5 * distance
        wide = np.log(share) - 0.5 * distance / scale**2 - dimension * np.log(scale)
        total = np.logaddexp(narrow, wide)
        is_wide = np.exp(wide - total)
        share = float(np.clip(is_wide.mean(), 1e-9, _MOST_TAIL))
        weight = 1.0 - is_wide + is_wide / scale**2
        variance = np.maximum((weight[:, None] * squares).mean(axis=0), 1e-30)
        distance = (squares / variance).sum(axis=1)
        scale = float(np.sqrt((is_wide @ distance) / (dimension * max(is_wide.sum(), 1e-9))))
        scale = float(np.clip(scale, 1.0, _SCALES[1]))
        reached = float(total.mean() - 0.5 * np.log(variance).sum())
        if abs(reached - log_likelihood) < _TOLERANCE:
            break
        log_likelihood = reached
    if share < LEAST_TAIL or scale < _SCALES[0]:
        return np.sqrt(squares.mean(axis=0)), GAUSSIAN
    return np.sqrt(variance), ErrorModel(tail_share=share, tail_scale=scale)
