"""A uniform planar array, and the signals of a station's paths at its antennas.

The array lies in the y-z plane of the mounted board (docs/mounting.md) and looks along its x axis. A plane wave from
the board's direction d meets antenna (n, m), which is n columns along y and m rows along z from the middle, with the
phase 2 pi spacing (n d_y + m d_z): the array measures the direction cosines (d_y, d_z).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.truth.forward import Paths
from rayfix_service.measuring.ranging import SPEED_OF_LIGHT
from rayfix_tables.geometry.angles import direction
from rayfix_tables.geometry.mounting import board_to_scene
from rayfix_tables.site import Station

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BEAM_WIDTH = 0.886
"""Half-power beam width of a uniform aperture, in wavelengths per aperture (H. L. Van Trees, "Optimum Array
Processing", 2002, table 3.1)."""


@dataclass(frozen=True, kw_only=True)
class PlanarArray:
    """Antennas on a rectangular grid.

    Attributes
    ----------
    columns, rows : int
        Antennas along the board's y and z axis.
    spacing : float
        Between neighbours, in wavelengths.
    """

    columns: int = 8
    rows: int = 8
    spacing: float = 0.5

    def __len__(self) -> int:
        """Return the number of antennas."""
        return self.columns * self.rows

    @cached_property
    def places(self) -> Array:
        """Column and row of each antenna from the middle, shape (n_antennas, 2); rows run fastest."""
        column, row = np.indices((self.columns, self.rows)).reshape(2, -1)
        return np.stack([column - 0.5 * (self.columns - 1), row - 0.5 * (self.rows - 1)], axis=-1)

    @property
    def beam_width(self) -> float:
        """Half-power width of the narrower axis' beam, in direction cosines; rad straight ahead."""
        return _BEAM_WIDTH / (self.spacing * max(self.columns, self.rows))

    def steering(self, cosines: Array) -> Complex:
        """Phases at the antennas of waves of the given direction cosines.

        Parameters
        ----------
        cosines : ndarray of shape (n, 2)
            Along the board's y and z axis.

        Returns
        -------
        ndarray of complex of shape (n_antennas, n)
        """
        return np.asarray(np.exp(2j * np.pi * self.spacing * (self.places @ cosines.T)))


def to_cosines(station: Station, azimuth: Array, zenith: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Direction cosines of directions in the scene, and whether they are in front of the array.

    Parameters
    ----------
    azimuth, zenith : ndarray of shape (n,), rad

    Returns
    -------
    cosines : ndarray of shape (n, 2)
    before : ndarray of bool of shape (n,)
    """
    local = direction(azimuth, zenith) @ board_to_scene(station)
    return local[:, 1:], local[:, 0] > 0.0


def to_scene_direction(station: Station, cosines: Array) -> Array:
    """Convert direction cosines of waves from the front into unit vectors in the scene frame, shape (n, 3)."""
    ahead = np.sqrt(np.maximum(1.0 - np.square(cosines).sum(axis=1), 0.0))
    return np.asarray(np.column_stack([ahead, cosines]) @ board_to_scene(station).T)


@dataclass(frozen=True, kw_only=True)
class Signal:
    """The signal of a UE.

    Attributes
    ----------
    bandwidth : float, Hz
        Bandwidth that the subcarriers divide uniformly.
    subcarriers : int
        Number of subcarriers; each is a snapshot of the array.
    snr_db : float, dB
        Signal-to-noise ratio of all paths together, at one antenna and subcarrier.
    """

    bandwidth: float = 100e6
    subcarriers: int = 64
    snr_db: float = 20.0


def receive(
    array: PlanarArray, station: Station, paths: Paths, signal: Signal, rng: np.random.Generator
) -> Complex | None:
    """Simulate the snapshots of an array, one for each subcarrier: the sum of all paths, and noise.

    A path has its gain, a phase by its length at each subcarrier, and a random phase, because a twin is not accurate to
    a fraction of a wavelength. The array receives nothing from behind.

    Returns
    -------
    ndarray of complex of shape (n_antennas, subcarriers), or None
        With noise power 1; None if no path arrives from the front.
    """
    cosines, before = to_cosines(station, paths.azimuth, paths.zenith)
    if not before.any():
        return None
    gain = 10.0 ** (paths.gain_db[before] / 20.0)
    gain *= 10.0 ** (signal.snr_db / 20.0) / np.sqrt(np.square(gain).sum())
    phase = rng.uniform(0.0, 2.0 * np.pi, len(gain))
    frequency = signal.bandwidth * (np.arange(signal.subcarriers) / signal.subcarriers - 0.5)
    delay = paths.path_length[before] / SPEED_OF_LIGHT
    waves = (gain * np.exp(1j * phase))[:, None] * np.exp(-2j * np.pi * np.outer(delay, frequency))
    noise = rng.standard_normal((2, len(array), signal.subcarriers)) * np.sqrt(0.5)
    return np.asarray(array.steering(cosines[before]) @ waves + noise[0] + 1j * noise[1])
