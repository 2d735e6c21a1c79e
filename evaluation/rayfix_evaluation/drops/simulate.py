"""Simulated reports: measurements of the paths of the forward solver.

A report is a ``dict`` as ``POST /v1/positions`` takes it (degrees and metres), and can be used with the Python API, the
service and files.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rayfix_evaluation.truth.forward import Paths

__all__ = ["Noise", "Rule", "Timing", "select_path", "simulate_report", "uniform_drops"]

Rule = Literal["strongest", "first", "random"]
"""Path that a station reports: the strongest, the shortest, or a random one."""

Timing = Literal["none", "pt", "toa", "tdoa"]
"""Measured times: none, propagation times, times of arrival with an unknown clock, or time differences."""

_CLOCK_RANGE = 300.0  # m, one microsecond


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Standard deviations of the measurements' Gaussian noise.

    Attributes
    ----------
    azimuth_stdev : float, rad
        Standard deviation of the azimuth angle itself, at any zenith.
    zenith_stdev : float, rad
        Of the zenith angle.
    range_stdev : float or None, m
        Standard deviation of one time of arrival times the speed of light; None if no time is measured.

    Raises
    ------
    ValueError
        If a deviation is not positive and finite.
    """

    azimuth_stdev: float
    zenith_stdev: float
    range_stdev: float | None

    def __post_init__(self) -> None:
        """Refuse invalid standard deviations."""
        for name in ("azimuth_stdev", "zenith_stdev", "range_stdev"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}; it must be positive and finite")


def select_path(paths: Paths, rule: Rule, rng: np.random.Generator) -> int:
    """Choose the path that a station reports.

    Parameters
    ----------
    paths : Paths
        At least one path.
    rule : {"strongest", "first", "random"}
        Largest gain, smallest length, or each path with the same probability.
    rng : numpy.random.Generator
        Used once with the rule ``"random"``, otherwise not at all.

    Returns
    -------
    int
        Index into the paths.

    Raises
    ------
    ValueError
        If there is no path, or no such rule.
    """
    if len(paths) == 0:
        raise ValueError("there is no path to select from; leave the station out")
    if rule == "strongest":
        return int(np.argmax(paths.gain_db))
    if rule == "first":
        return int(np.argmin(paths.path_length))
    if rule == "random":
        return int(rng.integers(len(paths)))
    raise ValueError(f"the rule is {rule!r}; use 'strongest', 'first' or 'random'")


def simulate_report(
    paths_by_station: Mapping[str, Paths],
    noise: Noise,
    *,
    rng: np.random.Generator,
    rule: Rule = "strongest",
    timing: Timing = "pt",
    target_id: str = "ue",
    timestamp: str = "2026-01-01T00:00:00Z",
) -> dict[str, Any]:
    """Measure one path per station, with noise.

    The draws from the generator depend neither on the deviations nor on the timing: with the same seed, reports of
    different settings have the same standardised noise, which reduces the scatter of comparisons.

    Parameters
    ----------
    paths_by_station : mapping of str to Paths
        Paths of each station to the transmitter; stations without any are left out of the report.
    noise : Noise
        Standard deviations.
    rng : numpy.random.Generator
        Source of the noise, the clock offset and the random selection.
    rule : {"strongest", "first", "random"}
        Which path each station reports.
    timing : {"none", "pt", "toa", "tdoa"}
        ``"pt"`` adds the length of each path; ``"toa"`` the same plus a common clock offset of 0 to 300 m; ``"tdoa"``
        the length differences to the first station with a path, which all contain that station's noise.
    target_id : str
        Name of the transmitter in the report.
    timestamp : str
        Time of the report, ISO 8601.

    Returns
    -------
    dict
        Body of ``POST /v1/positions``. Noise may make a short range negative.

    Raises
    ------
    ValueError
        If times are measured and ``noise.range_stdev`` is None, or timing or rule is unknown.
    """
    if timing not in ("none", "pt", "toa", "tdoa"):
        raise ValueError(f"the timing is {timing!r}; use 'none', 'pt', 'toa' or 'tdoa'")
    if timing != "none" and noise.range_stdev is None:
        raise ValueError(f"the timing is {timing!r}, but noise.range_stdev is None; give it in metres")
    range_stdev = noise.range_stdev or 0.0
    clock_offset = float(rng.uniform(0.0, _CLOCK_RANGE))
    measurements: list[dict[str, Any]] = []
    heard: list[tuple[str, float]] = []
    for station_id, paths in paths_by_station.items():
        if len(paths) == 0:
            continue
        index = select_path(paths, rule, rng)
        errors = rng.standard_normal(3)
        azimuth, zenith = fold_direction(
            paths.azimuth[index] + noise.azimuth_stdev * errors[0],
            paths.zenith[index] + noise.zenith_stdev * errors[1],
        )
        measurements.append(
            {
                "type": "aoa",
                "station_id": station_id,
                "azimuth_deg": float(np.degrees(azimuth)),
                "zenith_deg": float(np.degrees(zenith)),
                "azimuth_stdev_deg": float(np.degrees(noise.azimuth_stdev)),
                "zenith_stdev_deg": float(np.degrees(noise.zenith_stdev)),
                "frame": "scene",
            }
        )
        heard.append((station_id, float(paths.path_length[index] + range_stdev * errors[2])))
    if timing == "tdoa" and heard:
        reference, reference_range = heard[0]
        measurements.extend(
            {
                "type": "tdoa",
                "station_id": station_id,
                "reference_station_id": reference,
                "range_difference_m": measured - reference_range,
                "stdev_m": float(np.sqrt(2.0)) * range_stdev,
            }
            for station_id, measured in heard[1:]
        )
    elif timing in ("pt", "toa"):
        offset = clock_offset if timing == "toa" else 0.0
        measurements.extend(
            {
                "type": timing,
                "station_id": station_id,
                "range_m": measured + offset,
                "stdev_m": range_stdev,
            }
            for station_id, measured in heard
        )
    return {"target_id": target_id, "timestamp": timestamp, "measurements": measurements}


def fold_direction(azimuth: float, zenith: float) -> tuple[float, float]:
    """Convert angles that noise has moved out of range to the equivalent angles in range.

    Parameters
    ----------
    azimuth, zenith : float, rad
        Any angles; a zenith beyond a pole is a direction on the other side of it.

    Returns
    -------
    azimuth : float, rad
        In (-pi, pi].
    zenith : float, rad
        In [0, pi].
    """
    turn = 2.0 * np.pi
    zenith = float(np.mod(zenith, turn))
    if zenith > np.pi:
        azimuth, zenith = azimuth + np.pi, turn - zenith
    wrapped = np.pi - float(np.mod(np.pi - azimuth, turn))
    # The remainder of a tiny negative number rounds to a full turn.
    return (np.pi if wrapped <= -np.pi else wrapped), zenith


def uniform_drops(
    is_free: Callable[[NDArray[np.float64]], NDArray[np.bool_]],
    low: ArrayLike,
    high: ArrayLike,
    count: int,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Draw positions uniformly from the free part of a box, by rejection.

    Parameters
    ----------
    is_free : callable
        Takes positions of shape (n, 3), m, and returns an array of bool of shape (n,).
    low, high : ndarray of shape (3,), m
        Opposite corners of the box.
    count : int
        Number of positions.
    rng : numpy.random.Generator
        Source of the positions.

    Returns
    -------
    ndarray of shape (count, 3), m
        Free positions.

    Raises
    ------
    ValueError
        If less than about a thousandth of the box is free.
    """
    lowest, highest = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    kept = [np.empty((0, 3))]
    missing = count
    for _ in range(1000):
        if missing <= 0:
            break
        points = rng.uniform(lowest, highest, (count, 3))
        kept.append(points[np.asarray(is_free(points), dtype=np.bool_)][:missing])
        missing -= len(kept[-1])
    if missing > 0:
        raise ValueError(
            f"only {count - missing} of {1000 * count} positions between {lowest} and {highest} are free; "
            "check the box and the scene"
        )
    return np.concatenate(kept)
