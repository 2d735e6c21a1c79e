"""Taking a station's calibration into account: biases that depend on the direction, and deviations that were found."""

import math
from bisect import bisect_right
from dataclasses import replace
from typing import NamedTuple

from rayfix_service.fusion.measurements.report import (
    Angle,
    ErrorModel,
    MeasuredPath,
    Measurement,
    Range,
    Report,
    TimeOfArrival,
)
from rayfix_tables.site import AngleBias, Deviations, Rows, SiteInfo

_STEPS = 60
"""Steps of the search for the true direction; each halves what is left of a constant bias."""

_ENOUGH = 1e-7
"""Radians at which it ends."""

_LEAST_SLOPE = 0.2
"""Least change of the measured angle with the true one that is believed."""


class LocalBias(NamedTuple):
    """Bias of a measured direction, rad.

    Attributes
    ----------
    azimuth, zenith : float
        Measured minus true.
    azimuth_stdev, zenith_stdev : float
        How well they are known.
    azimuth_slope, zenith_slope : float
        Change of the measured angle with the true one.
    """

    azimuth: float
    zenith: float
    azimuth_stdev: float
    zenith_stdev: float
    azimuth_slope: float
    zenith_slope: float


def local_bias(bias: AngleBias, azimuth: float, zenith: float) -> LocalBias:
    """Find the bias of a measured direction, which is that of the true direction that would be measured so.

    Parameters
    ----------
    bias : AngleBias
    azimuth, zenith : float, rad
        As measured, other biases taken off; for an azimuth alone, any zenith.
    """
    true_azimuth, true_zenith = azimuth, zenith
    at = _Place(bias, true_azimuth, true_zenith)
    for _ in range(_STEPS):
        at = _Place(bias, true_azimuth, true_zenith)
        step_azimuth = math.remainder(azimuth - at.value(bias.azimuth) - true_azimuth, 2.0 * math.pi)
        step_zenith = zenith - at.value(bias.zenith) - true_zenith
        if abs(step_azimuth) + abs(step_zenith) < _ENOUGH:
            break
        # Half steps also end where the bias grows with the angle as fast as the angle itself.
        true_azimuth += 0.5 * step_azimuth
        true_zenith = min(max(true_zenith + 0.5 * step_zenith, 0.0), math.pi)
    return LocalBias(
        azimuth=at.value(bias.azimuth),
        zenith=at.value(bias.zenith),
        azimuth_stdev=at.value(bias.azimuth_stdev),
        zenith_stdev=at.value(bias.zenith_stdev),
        azimuth_slope=max(1.0 + at.azimuth_slope(bias.azimuth), _LEAST_SLOPE),
        zenith_slope=max(1.0 + at.zenith_slope(bias.zenith), _LEAST_SLOPE),
    )


class _Place:
    """A direction in the grid of a bias: the cell and where in it."""

    def __init__(self, bias: AngleBias, azimuth: float, zenith: float) -> None:
        middle = 0.5 * (bias.azimuths[0] + bias.azimuths[-1])
        self._i, self._s, self._width = _cell(bias.azimuths, middle + math.remainder(azimuth - middle, 2.0 * math.pi))
        self._j, self._t, self._height = _cell(bias.zeniths, zenith)

    def value(self, rows: Rows) -> float:
        """Interpolate."""
        low, high = self._in_row(rows[self._j]), self._in_row(rows[min(self._j + 1, len(rows) - 1)])
        return low + self._t * (high - low)

    def azimuth_slope(self, rows: Rows) -> float:
        """Change with the azimuth; 0 beyond the grid."""
        if self._width == 0.0:
            return 0.0
        low, high = rows[self._j], rows[min(self._j + 1, len(rows) - 1)]
        i = self._i
        return ((1.0 - self._t) * (low[i + 1] - low[i]) + self._t * (high[i + 1] - high[i])) / self._width

    def zenith_slope(self, rows: Rows) -> float:
        """Change with the zenith; 0 beyond the grid."""
        if self._height == 0.0:
            return 0.0
        return (self._in_row(rows[self._j + 1]) - self._in_row(rows[self._j])) / self._height

    def _in_row(self, row: tuple[float, ...]) -> float:
        low, high = row[self._i], row[min(self._i + 1, len(row) - 1)]
        return low + self._s * (high - low)


def _cell(axis: tuple[float, ...], value: float) -> tuple[int, float, float]:
    """Cell of an axis: its index, where in it, from 0 to 1, and its width, 0 beyond the axis."""
    if len(axis) == 1:
        return 0, 0.0, 0.0
    i = min(max(bisect_right(axis, value) - 1, 0), len(axis) - 2)
    width = axis[i + 1] - axis[i]
    beyond = not axis[0] <= value <= axis[-1]
    return i, min(max((value - axis[i]) / width, 0.0), 1.0), 0.0 if beyond else width


def with_deviations(report: Report, site: SiteInfo) -> Report:
    """Give measurements the deviations that their stations' calibrations found, in place of the stated ones."""
    if not site.has_deviations:
        return report
    stations = site.station_by_id
    measured = tuple(
        _calibrated(m, station.deviations)
        if (station := stations.get(m.station_id)) is not None and station.deviations is not None
        else m
        for m in report.measurements
    )
    return replace(report, measurements=measured)


def _calibrated(measurement: Measurement, found: Deviations) -> Measurement:
    errors = ErrorModel(tail_share=found.tail_share, tail_scale=found.tail_scale)
    match measurement:
        case Angle() if found.azimuth is not None:
            zenith = measurement.zenith_stdev if found.zenith is None else found.zenith
            return replace(
                measurement,
                azimuth_stdev=found.azimuth,
                zenith_stdev=None if measurement.zenith is None else zenith,
                correlation=0.0,
                error_model=errors,
            )
        case MeasuredPath():
            angle = None if measurement.angle is None else _calibrated(measurement.angle, found)
            if isinstance(angle, Angle):
                measurement = replace(measurement, azimuth_stdev=angle.azimuth_stdev, zenith_stdev=angle.zenith_stdev)
            if measurement.length is not None and found.range is not None:
                measurement = replace(measurement, stdev=found.range)
        case Range() | TimeOfArrival() if found.range is not None:
            return replace(measurement, stdev=found.range, error_model=errors)
    return measurement
