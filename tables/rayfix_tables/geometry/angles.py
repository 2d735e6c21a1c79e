"""Angles and directions, in radians; the only module that subtracts azimuths.

Conventions are those of docs/conventions.md: ``azimuth`` in (-pi, pi] from +x towards +y, ``zenith`` in [0, pi]
from +z, both of the direction from the station towards the incoming ray.
"""

import math
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def wrap(angle: ArrayLike) -> Array:
    """Wrap angles into (-pi, pi].

    Parameters
    ----------
    angle : array_like, rad

    Returns
    -------
    ndarray of the same shape, rad
    """
    angle = np.asarray(angle, dtype=np.float64)
    turned = angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi))
    # Rounding can give -pi or pi for half a turn; only pi is in the interval. Angles in the interval are unchanged.
    low, high = turned <= -np.pi, turned > np.pi
    return cast("Array", turned + 2.0 * np.pi * low - 2.0 * np.pi * high)


def wrap_one(angle: float) -> float:
    """Wrap one angle [rad] into (-pi, pi] as :func:`wrap` does, in a tenth of the time."""
    turned = math.remainder(angle, 2.0 * math.pi)
    return turned if turned > -math.pi else math.pi


def direction(azimuth: ArrayLike, zenith: ArrayLike) -> Array:
    """Turn angles into unit vectors.

    Parameters
    ----------
    azimuth, zenith : array_like of a common shape, rad

    Returns
    -------
    ndarray of shape (..., 3)
    """
    azimuth, zenith = np.broadcast_arrays(azimuth, zenith)
    ring = np.sin(zenith)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), np.cos(zenith)], axis=-1)


def angles_of(vectors: ArrayLike) -> tuple[Array, Array]:
    """Azimuth and zenith of vectors of any length.

    Parameters
    ----------
    vectors : array_like of shape (..., 3)

    Returns
    -------
    azimuth, zenith : ndarray of shape (...), rad
    """
    v = np.asarray(vectors, dtype=np.float64)
    azimuth = wrap(np.arctan2(v[..., 1], v[..., 0]))
    zenith = np.arctan2(np.hypot(v[..., 0], v[..., 1]), v[..., 2])
    return azimuth, zenith


def tangent(azimuth: ArrayLike, zenith: ArrayLike, centre_azimuth: ArrayLike, centre_zenith: ArrayLike) -> Array:
    """Tangent coordinates about a centre c: ``(sin(zenith_c) wrap(azimuth - azimuth_c), zenith - zenith_c)``.

    The chart is exact for independent noise on azimuth and zenith: an azimuth deviation only shrinks by
    ``sin(zenith_c)``.

    Returns
    -------
    ndarray of shape (..., 2), rad
    """
    horizontal = np.sin(centre_zenith) * wrap(np.subtract(azimuth, centre_azimuth))
    vertical = np.subtract(zenith, centre_zenith)
    return np.stack(np.broadcast_arrays(horizontal, vertical), axis=-1)


def local_to_scene(orientation: tuple[float, float, float]) -> Array:
    """Rotation that takes vectors of a station's local frame (LCS) into the scene frame.

    Parameters
    ----------
    orientation : tuple of 3 floats, rad
        Bearing, downtilt and slant.

    Returns
    -------
    ndarray of shape (3, 3)

    Notes
    -----
    3GPP TR 38.901, equation (7.1-2): ``R = Rz(bearing) Ry(downtilt) Rx(slant)``.
    """
    (ca, cb, cc), (sa, sb, sc) = np.cos(orientation), np.sin(orientation)
    about_z = np.array([[ca, -sa, 0.0], [sa, ca, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cc, -sc], [0.0, sc, cc]])
    return cast("Array", about_z @ about_y @ about_x)
