"""Angles as measured, turned into directions of the scene."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.calibrated import local_bias
from rayfix_service.fusion.measurements.report import Angle
from rayfix_tables.geometry.angles import angles_of, direction, local_to_scene
from rayfix_tables.geometry.mounting import board_to_scene
from rayfix_tables.site import NO_BIAS, Station


class MeasuredAngles(NamedTuple):
    """Angles as an array in a tilted frame measured them.

    Attributes
    ----------
    azimuth : float, rad
    zenith : float or None, rad
    cov : ndarray of shape (2, 2), rad2
    to_scene : ndarray of shape (3, 3)
        Takes the frame's vectors into the scene's.
    """

    azimuth: float
    zenith: float | None
    cov: NDArray[np.float64]
    to_scene: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Direction:
    """A measured direction in the scene frame.

    Attributes
    ----------
    azimuth, zenith : float or None, rad
        None when not measured.
    cov : ndarray of shape (2, 2), rad2
        Covariance of azimuth and zenith; infinite on the diagonal for what was not measured.
    local : MeasuredAngles, optional
        Of angles in a frame whose z axis is not the scene's, where their errors are what the report says: what the
        fields above say is their first-order approximation, and the azimuth, where it was measured alone, that of the
        frame.
    """

    azimuth: float | None
    zenith: float | None
    cov: NDArray[np.float64]
    local: MeasuredAngles | None = None


NO_DIRECTION = Direction(azimuth=None, zenith=None, cov=np.diag([np.inf, np.inf]))
"""What a station without an angle has measured."""


def without_bias(angle: Angle, station: Station) -> Angle:
    """Take the station's bias off an angle, and add its uncertainty.

    The bias is that of the angles as the station reports them, in whatever frame it does.
    """
    bias = station.bias
    if bias == NO_BIAS:
        return angle
    azimuth, zenith, zenith_stdev = angle.azimuth - bias.azimuth, angle.zenith, angle.zenith_stdev
    azimuth_stdev, correlation, local = angle.azimuth_stdev, angle.correlation, None
    if bias.angles is not None:
        local = local_bias(bias.angles, azimuth, 0.5 * np.pi if zenith is None else zenith - bias.zenith)
        azimuth -= local.azimuth
        azimuth_stdev = math.hypot(azimuth_stdev, local.azimuth_stdev) / local.azimuth_slope
    azimuth_stdev = math.hypot(azimuth_stdev, bias.angle_stdev)
    if zenith is not None and zenith_stdev is not None:
        zenith -= bias.zenith
        covariance = correlation * angle.azimuth_stdev * zenith_stdev
        if local is not None:
            zenith -= local.zenith
            covariance /= local.azimuth_slope * local.zenith_slope
            zenith_stdev = math.hypot(zenith_stdev, local.zenith_stdev) / local.zenith_slope
        zenith_stdev = math.hypot(zenith_stdev, bias.angle_stdev)
        correlation = covariance / (azimuth_stdev * zenith_stdev)
        if not 0.0 <= zenith <= np.pi:
            # Beyond a pole lies the other side.
            zenith = float(np.arccos(np.cos(zenith)))
            azimuth, correlation = azimuth + np.pi, -correlation
    return replace(
        angle,
        azimuth=azimuth,
        azimuth_stdev=azimuth_stdev,
        zenith=zenith,
        zenith_stdev=zenith_stdev,
        correlation=correlation,
    )


def to_scene(angle: Angle, station: Station, north: float) -> Direction:
    """Turn a measured angle into the scene frame, its covariance included.

    Parameters
    ----------
    north : float, rad
        Azimuth of geographic north in the scene frame; in the frame "north" azimuths count from there.
    """
    azimuth_variance = angle.azimuth_stdev**2
    if angle.zenith is None or angle.zenith_stdev is None:
        bearing, *tilts = station.orientation
        cov = np.diag([azimuth_variance, np.inf])
        if angle.frame == "lcs" and any(tilts):
            local = MeasuredAngles(angle.azimuth, None, cov, local_to_scene(station.orientation))
            return Direction(azimuth=angle.azimuth, zenith=None, cov=cov, local=local)
        turn = {"scene": 0.0, "north": north, "lcs": bearing}[angle.frame]
        return Direction(azimuth=angle.azimuth + turn, zenith=None, cov=cov)
    covariance = angle.correlation * angle.azimuth_stdev * angle.zenith_stdev
    cov = np.array([[azimuth_variance, covariance], [covariance, angle.zenith_stdev**2]])
    if angle.frame == "scene":
        return Direction(azimuth=angle.azimuth, zenith=angle.zenith, cov=cov)
    if angle.frame == "north":
        return Direction(azimuth=angle.azimuth + north, zenith=angle.zenith, cov=cov)
    rotation = local_to_scene(station.orientation)
    azimuth, zenith = (float(v) for v in angles_of(rotation @ direction(angle.azimuth, angle.zenith)))
    turned = _basis(azimuth, zenith).T @ rotation @ _basis(angle.azimuth, angle.zenith)
    local_sine, sine = np.sin(angle.zenith), max(np.sin(zenith), 1e-9)
    jacobian = np.diag([1.0 / sine, 1.0]) @ turned @ np.diag([local_sine, 1.0])
    local = MeasuredAngles(angle.azimuth, angle.zenith, cov, rotation)
    return Direction(azimuth=azimuth, zenith=zenith, cov=jacobian @ cov @ jacobian.T, local=local)


def in_field_of_view(station: Station, measured: Direction) -> bool:
    """Whether a direction lies within the station's cone; one without zenith always counts as inside."""
    if station.field_of_view >= 2.0 * np.pi or measured.azimuth is None or measured.zenith is None:
        return True
    axis = board_to_scene(station)[:, 0]
    cosine = float(axis @ direction(measured.azimuth, measured.zenith))
    return bool(np.arccos(np.clip(cosine, -1.0, 1.0)) <= 0.5 * station.field_of_view)


def _basis(azimuth: float, zenith: float) -> NDArray[np.float64]:
    """Give the unit vectors of growing azimuth and zenith, as columns, shape (3, 2)."""
    return np.array(
        [
            [-np.sin(azimuth), np.cos(zenith) * np.cos(azimuth)],
            [np.cos(azimuth), np.cos(zenith) * np.sin(azimuth)],
            [0.0, -np.sin(zenith)],
        ]
    )
