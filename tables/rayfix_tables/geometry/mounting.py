"""How an array is mounted: from its boresight and roll to the orientation of its local frame, and back.

The mounted board has a frame of its own: x along its boresight, y to the left when looking along it, z along its upper
edge. Vendors' local frames are this one with its axes named differently. docs/mounting.md draws them.
"""

from typing import NamedTuple

import numpy as np

from rayfix_tables.geometry.angles import Array, angles_of, local_to_scene
from rayfix_tables.site import Mounting, Station

Axis = tuple[float, float, float]

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


class ArrayFrame(NamedTuple):
    """Local directions of an array's boresight and of its upper edge, orthogonal unit vectors."""

    boresight: Axis
    up: Axis


FRAMES: dict[Mounting, ArrayFrame] = {
    "3gpp": ArrayFrame(boresight=_X, up=_Z),
    "silabs": ArrayFrame(boresight=_Z, up=_Y),
    "ublox": ArrayFrame(boresight=_X, up=_Z),
}
"""Local frames: 3GPP TR 38.901, 7.1; Silicon Labs' arrays in the local xy plane; u-blox anchors, UBX-21004616."""


class Boresight(NamedTuple):
    """Boresight of an array, rad: azimuth in the scene frame, and angle below the horizon."""

    azimuth: float
    downtilt: float


def orientation_of(mounting: Mounting, boresight: Boresight, roll: float) -> tuple[float, float, float]:
    """Orientation of the local frame of a mounted array.

    Parameters
    ----------
    mounting : {"3gpp", "silabs", "ublox"}
        Local frame of the array.
    boresight : Boresight, rad
    roll : float, rad
        Rotation about the boresight, clockwise when looking along it. At 0 the upper edge points up; for an array that
        looks straight down, towards ``boresight.azimuth``.

    Returns
    -------
    tuple of 3 floats, rad
        Bearing, downtilt and slant of 3GPP TR 38.901; see :func:`rayfix_tables.geometry.angles.local_to_scene`.
    """
    if FRAMES[mounting] == FRAMES["3gpp"]:
        return (*boresight, roll)
    return _euler(local_to_scene((*boresight, roll)) @ _board(mounting).T)


def board_to_scene(station: Station) -> Array:
    """Rotation that takes vectors of a station's board into the scene frame, shape (3, 3); its columns are the axes."""
    return np.asarray(local_to_scene(station.orientation) @ _board(station.mounting))


def boresight_of(station: Station) -> Boresight:
    """Boresight of a station's array."""
    azimuth, zenith = angles_of(board_to_scene(station)[:, 0])
    return Boresight(azimuth=float(azimuth), downtilt=float(zenith) - 0.5 * np.pi)


def _board(mounting: Mounting) -> Array:
    """Axes of the board in the local frame, as columns."""
    frame = FRAMES[mounting]
    return np.column_stack([frame.boresight, np.cross(frame.up, frame.boresight), frame.up])


def _euler(rotation: Array) -> tuple[float, float, float]:
    """Bearing, downtilt and slant of a rotation; the slant is 0 if only its sum with the bearing is determined."""
    downtilt = float(np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0)))
    if np.hypot(rotation[2, 1], rotation[2, 2]) < 1e-9:
        return float(np.arctan2(-rotation[0, 1], rotation[1, 1])), downtilt, 0.0
    bearing = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    return bearing, downtilt, float(np.arctan2(rotation[2, 1], rotation[2, 2]))
