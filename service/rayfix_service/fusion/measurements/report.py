"""What goes into a fix, in SI units and radians.

The JSON of the HTTP interface is read into these by :mod:`rayfix_service.wire`.
"""

from dataclasses import dataclass, field
from typing import Literal

from rayfix_tables.site import Selection

CONFIDENCE = 0.68
"""Probability with which accuracies hold where a report gives none."""

Frame = Literal["scene", "lcs", "north"]
"""Frame of an angle: the scene's, the station's local one, or the scene's turned to geographic north."""


@dataclass(frozen=True, kw_only=True, order=True)
class ErrorModel:
    """How the error of a measurement is spread: a Gaussian, or two of them about one middle (contaminated Gaussian).

    Attributes
    ----------
    tail_share : float
        Probability that the error is of the wider one, from 0 to below 1.
    tail_scale : float
        Standard deviation of the wider one, in standard deviations of the measurement; at least 1.

    Notes
    -----
    J. W. Tukey, "A survey of sampling from contaminated distributions", 1960. A measurement that has nothing to do with
    the position at all is another matter: see ``FusionSettings.outlier_probability``.
    """

    tail_share: float = 0.0
    tail_scale: float = 1.0


GAUSSIAN = ErrorModel()

HEAVY_TAILED = ErrorModel(tail_share=0.1, tail_scale=3.0)
"""One error in ten has three times the standard deviation."""


@dataclass(frozen=True, kw_only=True)
class Height:
    """What is known beforehand of the UE's height: a Gaussian on z in the scene frame, m."""

    z: float
    stdev: float


@dataclass(frozen=True, kw_only=True)
class Angle:
    """An angle of arrival (AoA) at one station.

    Attributes
    ----------
    station_id : str
        Station that measured.
    azimuth, zenith : float
        Direction from the station towards the incoming ray, rad, in ``frame``; ``zenith`` is None for a sensor that
        measures the azimuth only.
    azimuth_stdev, zenith_stdev : float
        Standard deviations of these two angles, rad (None as for the angle itself).
    correlation : float
        Of the two errors, between -1 and 1.
    frame : {"scene", "lcs", "north"}
        Frame in which the angles are given.
    error_model : ErrorModel
    los_probability : float, optional
        Probability, between 0 and 1, that the path is direct, in the receiver's judgement of the signal's shape. Two
        measurements that differ in nothing else are the same one.
    """

    station_id: str
    azimuth: float
    azimuth_stdev: float
    zenith: float | None = None
    zenith_stdev: float | None = None
    correlation: float = 0.0
    frame: Frame = "scene"
    error_model: ErrorModel = GAUSSIAN
    los_probability: float | None = field(default=None, compare=False)


@dataclass(frozen=True, kw_only=True)
class Range:
    """A propagation time (PT) as a length: the path length from the UE to one station, m."""

    station_id: str
    path_length: float
    stdev: float
    error_model: ErrorModel = GAUSSIAN
    los_probability: float | None = field(default=None, compare=False)


@dataclass(frozen=True, kw_only=True)
class LogRange:
    """A path length whose relative error is Gaussian, as one from a signal strength is.

    Attributes
    ----------
    path_length : float, m
        Exponential of the measured logarithm; the median of what is measured of a path of this length. Positive.
    log_stdev : float
        Standard deviation of the natural logarithm.
    """

    station_id: str
    path_length: float
    log_stdev: float


@dataclass(frozen=True, kw_only=True)
class TimeOfArrival:
    """A time of arrival (ToA) as a length, m: path length plus an offset common to the UE's times of arrival."""

    station_id: str
    path_length: float
    stdev: float
    error_model: ErrorModel = GAUSSIAN
    los_probability: float | None = field(default=None, compare=False)


@dataclass(frozen=True, kw_only=True)
class TimeDifference:
    """A time difference of arrival (TDoA) as a length, m: t(station) - t(reference station)."""

    station_id: str
    reference_station_id: str
    length_difference: float
    stdev: float
    error_model: ErrorModel = GAUSSIAN


PathClock = Literal["known", "ue", "station"]
"""Clock of a measured path's length: a known one, the UE's of unknown offset, or from the station's first path on."""


@dataclass(frozen=True, kw_only=True)
class MeasuredPath:
    """One of several paths that a station reports: its direction, its length, or both.

    Attributes
    ----------
    station_id : str
    azimuth, azimuth_stdev, zenith, zenith_stdev, frame
        As of :class:`Angle`; None where the direction, or its zenith, was not measured.
    length, stdev : float, m
        Path length, with the offset of the clock; None where it was not measured.
    clock : {"known", "ue", "station"}
        Clock of the length. The paths of a station are on one.
    power_db : float, optional
        Power relative to anything that is common to the station's paths.
    """

    station_id: str
    azimuth: float | None = None
    azimuth_stdev: float | None = None
    zenith: float | None = None
    zenith_stdev: float | None = None
    frame: Frame = "scene"
    length: float | None = None
    stdev: float | None = None
    clock: PathClock = "known"
    power_db: float | None = None

    @property
    def angle(self) -> Angle | None:
        """The direction as an angle of arrival."""
        if self.azimuth is None or self.azimuth_stdev is None:
            return None
        return Angle(
            station_id=self.station_id,
            azimuth=self.azimuth,
            azimuth_stdev=self.azimuth_stdev,
            zenith=self.zenith,
            zenith_stdev=self.zenith_stdev,
            frame=self.frame,
        )


Measurement = Angle | Range | LogRange | TimeOfArrival | TimeDifference | MeasuredPath


@dataclass(frozen=True, kw_only=True)
class Report:
    """The measurements of one transmission, and what is known of the UE's height besides.

    Attributes
    ----------
    confidence : float
        Probability, between 0 and 1, with which the accuracies in other systems' formats hold.
    selection : Selection, optional
        Rule by which the stations selected what they report; that of each station by default.
    """

    measurements: tuple[Measurement, ...]
    height: Height | None = None
    confidence: float = CONFIDENCE
    target_id: str | None = None
    timestamp: str | None = None
    selection: Selection | None = None
