"""Simulated reports of several paths of each station: the strongest ones with noise, spurious and missing ones."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from rayfix_evaluation.drops.simulate import Noise, fold_direction
from rayfix_evaluation.truth.forward import Paths

__all__ = ["PathClock", "simulate_paths"]

PathClock = Literal["none", "known", "ue", "station"]
"""Clock of the lengths: none is measured, a known one, the UE's, or one that begins with the station's first path."""

_CLOCK_RANGE = 300.0  # m, one microsecond
_METRES_PER_NANOSECOND = 0.299792458


def simulate_paths(
    paths_by_station: Mapping[str, Paths],
    noise: Noise,
    *,
    rng: np.random.Generator,
    most: int,
    clock: PathClock = "ue",
    spurious: int = 0,
    missing: float = 0.0,
    max_path_length: float = 60.0,
) -> dict[str, Any]:
    """Measure the strongest paths of each station.

    Parameters
    ----------
    paths_by_station : mapping of str to Paths
        Paths of each station to the transmitter; stations without any are left out.
    noise : Noise
    rng : numpy.random.Generator
    most : int
        Paths of a station that are reported at most, spurious ones included.
    clock : {"none", "known", "ue", "station"}
    spurious : int
        Reported paths of each station, of those the weakest, that are replaced by ones of any direction and length.
    missing : float
        Probability that a path is not reported; a weaker one is then.
    max_path_length : float, m
        Longest spurious path.

    Returns
    -------
    dict
        Body of ``POST /v1/positions``, with measurements of type ``path``.
    """
    offset = float(rng.uniform(0.0, _CLOCK_RANGE))
    stdev = 0.0 if noise.range_stdev is None else noise.range_stdev
    measurements: list[dict[str, Any]] = []
    for name, paths in paths_by_station.items():
        kept = np.flatnonzero(rng.random(len(paths)) >= missing)[:most]
        first = float(paths.path_length.min()) if len(paths) else 0.0
        for rank, n in enumerate(kept):
            azimuth, zenith, length = paths.azimuth[n], paths.zenith[n], paths.path_length[n]
            if rank >= len(kept) - spurious:
                x, y, z = rng.normal(size=3)
                azimuth, zenith = np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)
                length = rng.uniform(1.0, max_path_length)
            errors = rng.standard_normal(3)
            azimuth, zenith = fold_direction(
                azimuth + noise.azimuth_stdev * errors[0], zenith + noise.zenith_stdev * errors[1]
            )
            measurements.append(
                {
                    "type": "path",
                    "station_id": name,
                    "azimuth_deg": float(np.degrees(azimuth)),
                    "zenith_deg": float(np.degrees(zenith)),
                    "azimuth_stdev_deg": float(np.degrees(noise.azimuth_stdev)),
                    "zenith_stdev_deg": float(np.degrees(noise.zenith_stdev)),
                    **_length(clock, float(length + stdev * errors[2]), first, offset, stdev),
                }
            )
    return {"measurements": measurements}


def _length(clock: PathClock, length: float, first: float, offset: float, stdev: float) -> dict[str, float]:
    if clock == "none":
        return {}
    if clock == "known":
        return {"range_m": length, "stdev_m": stdev}
    if clock == "ue":
        return {"toa_m": length + offset, "stdev_m": stdev}
    return {"delay_ns": (length - first) / _METRES_PER_NANOSECOND, "stdev_ns": stdev / _METRES_PER_NANOSECOND}
