"""Report mappings of 3GPP TS 38.133, clause 13: from integers to times and angles.

A reported integer stands for an interval of the measured quantity. The quantity is taken to be the middle of the
interval. The variance of a uniform distribution over it, width^2 / 12, is added to that of the measurement.
"""

import math
from dataclasses import dataclass

from rayfix_service.wire import METRES_PER_NANOSECOND

TC_NANOSECONDS = 1e9 / (480e3 * 4096)
"""Basic time unit of NR, Tc = 1 / (480 kHz x 4096) (TS 38.211, clause 4.1), ns: 0.5086."""

TC_METRES = TC_NANOSECONDS * METRES_PER_NANOSECOND
"""Length that a signal travels in Tc, m: 0.1525."""

RANGE_TC = 985024
"""UL-RTOA and Rx-Tx time differences are reported from minus to plus this many Tc (TS 38.133, 13.1.1, 13.2.1)."""

PATH_TC = 8175
"""Times of additional paths are reported from minus to plus this many Tc (TS 38.133, 13.1.2), relative to the first."""

ANGLE_STEP = math.radians(0.1)
"""Resolution of angles of arrival (TS 38.133, 13.4.1), rad."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """What a reported integer stands for, in the unit of the quantity."""

    middle: float
    width: float

    @property
    def variance(self) -> float:
        """Variance of a uniform distribution over the interval."""
        return self.width**2 / 12.0


def largest_time_value(k: int, reach: int = RANGE_TC) -> int:
    """Return the largest integer of a time report with steps of Tc 2^k, from minus to plus ``reach`` Tc.

    There are 2 x 985024 / 2^k intervals between the ends of the range, one below and one above, counted from 0:
    1970049 for k = 0 and 61565 for k = 5, as in the ASN.1 of TS 38.455.
    """
    return int(2 * reach / 2.0**k) + 1


def time_interval(value: int, k: int, reach: int = RANGE_TC) -> Interval | None:
    """Decode UL-RTOA or an Rx-Tx time difference (TS 38.133, tables 13.1.1-1 to -12 and 13.2.1-1 to -12).

    Value v stands for ``-985024 + (v - 1) 2^k <= time / Tc < -985024 + v 2^k``.

    Parameters
    ----------
    value : int
        From 0 to :func:`largest_time_value`.
    k : int
        Exponent of the step, -6 to 5.
    reach : int
        What the range ends at, Tc.

    Returns
    -------
    Interval or None
        As a length, m; None for the first and the last value, which stand for everything beyond the range.
    """
    if not 0 < value < largest_time_value(k, reach):
        return None
    step = 2.0**k
    return Interval(middle=(-reach + (value - 0.5) * step) * TC_METRES, width=step * TC_METRES)


def angle_interval(value: int, *, zero: float = 0.0) -> Interval:
    """Decode an azimuth or zenith angle of arrival in steps of 0.1 deg (TS 38.133, clause 13.4.1), rad.

    Parameters
    ----------
    value : int
        0 to 3599 for an azimuth, 0 to 1799 for a zenith angle.
    zero : float, rad
        Angle at which value 0 begins.
    """
    return Interval(middle=zero + (value + 0.5) * ANGLE_STEP, width=ANGLE_STEP)
