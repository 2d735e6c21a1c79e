"""The strongest paths from a station to each place, according to the table's path map."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.errors import RayfixError
from rayfix_tables.geometry.angles import angles_of
from rayfix_tables.paths import PathMap
from rayfix_tables.site import REACH_DB

__all__ = ["StrongestPaths", "strongest_paths"]

Array = NDArray[np.float64]

_LIT = 0.5
"""Share of a voxel that a path must reach to be one of each place in it."""

_AXIS = 1e-9
"""Sine of the zenith below which a direction has no azimuth to speak of."""


class StrongestPaths(NamedTuple):
    """Paths to one place, the strongest first; k of them.

    Attributes
    ----------
    azimuth, zenith : ndarray of shape (k,), rad
        At the station.
    length : ndarray of shape (k,), m
        With what walls add to it.
    gradients : ndarray of shape (k, 3, 3), 1, rad and rad per m
        d(length, tangent azimuth, zenith) / dx.
    """

    azimuth: Array
    zenith: Array
    length: Array
    gradients: Array


def strongest_paths(paths: PathMap, places: Array, most: int) -> Sequence[StrongestPaths]:
    """Find the strongest paths to places.

    Paths that are weaker than all together by more than 20 dB are no path that a station would report.

    Parameters
    ----------
    paths : PathMap
    places : ndarray of shape (n, 3), m
        In the table's frame.
    most : int
        Of each place.

    Raises
    ------
    RayfixError
        When the map has no gains.
    """
    if len(paths.log_gain) != len(paths):
        raise RayfixError(
            "the table has no gains of single paths, as those of format 3 and older; build it again to plan"
        )
    index = np.floor((places - paths.origin) / paths.voxel_size).astype(np.int64)
    index = np.clip(index, 0, np.array(paths.shape) - 1)
    voxels = np.ravel_multi_index(tuple(index.T), paths.shape)
    return [_of_place(paths, int(voxel), place, most) for voxel, place in zip(voxels, places, strict=True)]


def _of_place(paths: PathMap, voxel: int, place: Array, most: int) -> StrongestPaths:
    rows = np.arange(paths.offsets[voxel], paths.offsets[voxel + 1])
    rows = rows[paths.lit[rows] >= _LIT]
    sequence = paths.sequence[rows]
    apart = place - paths.images[sequence]
    length = np.linalg.norm(apart, axis=1)
    power = np.exp(paths.log_gain[rows].astype(np.float64)) / np.square(length)
    audible = power > 10.0 ** (-REACH_DB["all"] / 10.0) * power.sum()
    chosen = np.flatnonzero(audible)[np.argsort(-power[audible], kind="stable")[:most]]
    # In the frame of the station, the path is a straight one to the unfolded place.
    mirrors = paths.mirrors[sequence[chosen]]
    unfolded = np.einsum("kji,kj->ki", mirrors, apart[chosen])
    distance = length[chosen]
    azimuth, zenith = angles_of(unfolded)
    x, y, z = unfolded.T
    horizontal = np.maximum(np.hypot(x, y), _AXIS * distance)
    gradients = np.zeros((len(chosen), 3, 3))
    gradients[:, 0] = unfolded / distance[:, None]
    gradients[:, 1] = np.stack([-y, x, np.zeros_like(x)], axis=-1) / (horizontal * distance)[:, None]
    gradients[:, 2] = np.stack([x * z, y * z, -(horizontal**2)], axis=-1) / (horizontal * distance**2)[:, None]
    excess = paths.excess[rows[chosen]].astype(np.float64) if len(paths.excess) else 0.0
    return StrongestPaths(
        azimuth=np.asarray(azimuth),
        zenith=np.asarray(zenith),
        length=distance + excess,
        gradients=np.einsum("kab,kcb->kac", gradients, mirrors),
    )
