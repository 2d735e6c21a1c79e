"""How far measurements lie from the straight path between their station and a position."""

import math
from functools import lru_cache

from rayfix_service.fusion.measurements.directions import without_bias
from rayfix_service.fusion.measurements.report import Angle, Range
from rayfix_tables.geometry.angles import local_to_scene
from rayfix_tables.site import Station

Vector = tuple[float, float, float]


def angle_residual(angle: Angle, station: Station, north: float, position: Vector) -> float | None:
    """Angle between a measured direction and the straight one from the station to a position.

    The station's bias is taken off. Of an azimuth alone it is the difference of the azimuths, in the frame of the
    measurement. An angle of a reflected path has the residual of the reflection.

    Parameters
    ----------
    angle : Angle
    station : Station
        That measured it.
    north : float, rad
        Azimuth of geographic north in the scene frame.
    position : tuple of 3 floats, m
        In the scene frame.

    Returns
    -------
    float or None, rad
        From 0 to pi; None for a position at the station.
    """
    measured = without_bias(angle, station)
    x, y, z = _in_frame(angle.frame, station, north, _difference(position, station.position))
    if measured.zenith is None:
        if x == y == 0.0:
            return None
        return abs(math.remainder(measured.azimuth - math.atan2(y, x), 2.0 * math.pi))
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return None
    sine = math.sin(measured.zenith)
    u, v, w = sine * math.cos(measured.azimuth), sine * math.sin(measured.azimuth), math.cos(measured.zenith)
    # By the sine and the cosine: the arc cosine alone has no digits left at small angles.
    cross = math.sqrt((y * w - z * v) ** 2 + (z * u - x * w) ** 2 + (x * v - y * u) ** 2)
    return math.atan2(cross, x * u + y * v + z * w)


def signed_angle_residual(
    angle: Angle, station: Station, north: float, position: Vector
) -> tuple[float, float | None] | None:
    """Difference of a measured direction and the straight one, as azimuth and zenith of the measurement's frame.

    The station's bias is taken off.

    Parameters
    ----------
    angle, station, north, position
        As of :func:`angle_residual`.

    Returns
    -------
    tuple of (float, float or None), rad, or None
        The second is None of an azimuth alone; None for a position above, below or at the station.
    """
    measured = without_bias(angle, station)
    x, y, z = _in_frame(angle.frame, station, north, _difference(position, station.position))
    if x == y == 0.0:
        return None
    azimuth = math.remainder(measured.azimuth - math.atan2(y, x), 2.0 * math.pi)
    zenith = None if measured.zenith is None else measured.zenith - math.atan2(math.hypot(x, y), z)
    return azimuth, zenith


def range_residual(measured: Range, station: Station, position: Vector) -> float:
    """Difference, m, of a measured path length and the distance from the station to a position, without its sign.

    The station's bias is taken off. Positions are in the scene frame, m.
    """
    return abs(measured.path_length - station.bias.range - math.dist(position, station.position))


def _difference(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _in_frame(frame: str, station: Station, north: float, vector: Vector) -> Vector:
    """Turn a vector of the scene frame into the frame of an angle."""
    x, y, z = vector
    if frame == "scene":
        return vector
    if frame == "north":
        cosine, sine = math.cos(north), math.sin(north)
        return cosine * x + sine * y, cosine * y - sine * x, z
    a, b, c = _rotation(station.orientation)
    return (
        a[0] * x + b[0] * y + c[0] * z,
        a[1] * x + b[1] * y + c[1] * z,
        a[2] * x + b[2] * y + c[2] * z,
    )


@lru_cache(maxsize=4096)
def _rotation(orientation: Vector) -> tuple[Vector, Vector, Vector]:
    """Rows of the rotation from a station's local frame into the scene's."""
    (a, b, c), (d, e, f), (g, h, i) = local_to_scene(orientation).tolist()
    return (a, b, c), (d, e, f), (g, h, i)
