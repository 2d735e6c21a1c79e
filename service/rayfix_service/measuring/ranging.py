"""Path lengths from what radios measure: times, round trips and signal strengths.

Pure functions. Their results go into a report as :class:`~rayfix_service.fusion.measurements.report.Range` or
:class:`~rayfix_service.fusion.measurements.report.LogRange`. docs/measurements.md says when to use which.
"""

import math
from dataclasses import dataclass

SPEED_OF_LIGHT = 299_792_458.0
"""m/s, exact by the definition of the metre."""

_LN10 = math.log(10.0)


@dataclass(frozen=True, kw_only=True)
class RangeEstimate:
    """A path length with additive error, m, and its standard deviation, m."""

    path_length: float
    stdev: float


@dataclass(frozen=True, kw_only=True)
class LogRangeEstimate:
    """A path length with relative error.

    Attributes
    ----------
    path_length : float, m
        Median of the measurements at this path length.
    log_stdev : float
        Standard deviation of the natural logarithm.
    """

    path_length: float
    log_stdev: float


def range_from_times(*, toa: float, tod: float, stdev: float) -> RangeEstimate:
    """Path length from times of arrival and departure on one clock.

    Parameters
    ----------
    toa, tod : float, s
    stdev : float, s
        Of their difference.
    """
    return RangeEstimate(path_length=SPEED_OF_LIGHT * (toa - tod), stdev=SPEED_OF_LIGHT * stdev)


def range_from_round_trip(*, round_trip: float, reply: float, stdev: float) -> RangeEstimate:
    """Path length from the times of a signal and its reply (two-way ranging).

    Parameters
    ----------
    round_trip : float, s
        From sending to receiving, on one side's clock.
    reply : float, s
        From receiving to sending, on the other side's clock.
    stdev : float, s
        Of their difference.
    """
    return RangeEstimate(path_length=0.5 * SPEED_OF_LIGHT * (round_trip - reply), stdev=0.5 * SPEED_OF_LIGHT * stdev)


def range_from_rssi(
    *, rssi_dbm: float, power_at_1m_dbm: float, path_loss_exponent: float, shadowing_stdev_db: float
) -> LogRangeEstimate:
    """Path length from a signal strength by the log-distance model with log-normal shadowing.

    ``rssi = power_at_1m - 10 n log10(d) + X``, X Gaussian: the error of log d is Gaussian, so that of d is relative,
    not additive. The result is the median; the mean of the distances with the same signal strength is larger.

    Parameters
    ----------
    rssi_dbm : float, dBm
    power_at_1m_dbm : float, dBm
        Mean of the strength at a distance of 1 m.
    path_loss_exponent : float
        n; 2 in free space.
    shadowing_stdev_db : float, dB
        Standard deviation of X.

    Notes
    -----
    T. S. Rappaport, "Wireless Communications", 2nd edition, equation (4.69a).
    """
    scale = _LN10 / (10.0 * path_loss_exponent)
    return LogRangeEstimate(
        path_length=math.exp(scale * (power_at_1m_dbm - rssi_dbm)), log_stdev=scale * shadowing_stdev_db
    )
