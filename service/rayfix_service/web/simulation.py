"""Simulated reports of a UE at a given position, from the table alone.

The component of a station's finest level with the highest density at the position represents the path that the station
reports. Its E[u | x] is the noise-free measurement. This is as accurate as the table: only a forward solver finds exact
paths, and the service has none.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.errors import ReportError
from rayfix_tables.gaussians.definite import is_definite
from rayfix_tables.geometry.angles import wrap
from rayfix_tables.mixture import joint_cov
from rayfix_tables.part import StationPart
from rayfix_tables.table import Table

Kind = Literal["aoa", "pt", "toa", "tdoa"]

_NEAREST = 4096
"""Number of components that are considered, those with the means nearest to the position."""

_REACH = 5.0
"""Components are left out if the position is more than this many standard deviations from the mean."""

_CLOCK_RANGE = 300.0  # m, one microsecond


@dataclass(frozen=True, kw_only=True)
class SimulatedPath:
    """The path from a position to a station.

    Attributes
    ----------
    azimuth, zenith : float, rad
        From the station towards the incoming ray, in the scene frame.
    path_length : float, m
    num_reflections, num_walls : int
    dropped : int
        Number of components near the position that were left out because rounding made their covariances singular.
    """

    station_id: str
    azimuth: float
    zenith: float
    path_length: float
    num_reflections: int
    num_walls: int
    dropped: int = 0


def find_path(part: StationPart, position: NDArray[np.float64]) -> SimulatedPath | None:
    """Most probable path from a position to a station; None if there is none.

    Parameters
    ----------
    part : StationPart
    position : ndarray of shape (3,), m
        In the table's frame.
    """
    level = part.levels[0]
    mixture = level.mixture
    if not len(mixture):
        return None
    apart = ((mixture.x_mean - position.astype(np.float32)) ** 2).sum(axis=1)
    near = np.arange(len(apart)) if len(apart) <= _NEAREST else np.argpartition(apart, _NEAREST)[:_NEAREST]
    tubes = mixture[near]
    cov = joint_cov(tubes)
    definite = is_definite(cov[:, 3:, 3:])
    dropped = len(near) - int(np.count_nonzero(definite))
    if dropped:
        near, tubes, cov = near[definite], tubes[definite], cov[definite]
        if not len(near):
            return None
    cross, x_cov = cov[:, :3, 3:], cov[:, 3:, 3:]
    from_mean = position - tubes.x_mean
    gain = np.linalg.solve(x_cov, from_mean[:, :, None])[:, :, 0]
    square = np.einsum("ni,ni->n", from_mean, gain)
    cell = np.searchsorted(level.cell_offsets, near, side="right") - 1
    log_density = level.cell_log_mass[cell] + tubes.log_weight
    log_density = log_density - 0.5 * (square + np.linalg.slogdet(x_cov)[1])
    log_density[square > _REACH**2] = -np.inf
    best = int(np.argmax(log_density))
    if log_density[best] == -np.inf:
        return None
    length, horizontal, vertical = tubes.u_mean[best] + cross[best] @ gain[best]
    azimuth, zenith = level.grid.centres[cell[best]]
    return SimulatedPath(
        station_id=part.station.id,
        azimuth=float(wrap(azimuth + horizontal / np.sin(zenith))),
        zenith=float(np.clip(zenith + vertical, 0.0, np.pi)),
        path_length=float(length),
        num_reflections=int(tubes.num_reflections[best]),
        num_walls=int(tubes.num_walls[best]),
        dropped=dropped,
    )


def simulate(
    table: Table,
    position: Sequence[float],
    *,
    kinds: Sequence[Kind],
    angle_stdev: float,
    range_stdev: float,
    rng: np.random.Generator,
) -> tuple[list[SimulatedPath], list[dict[str, Any]]]:
    """Simulate the measurement of one path per station, with noise and the stations' biases.

    Parameters
    ----------
    position : sequence of 3 floats, m
    kinds : sequence of str
        Kinds of measurements of each path.
    angle_stdev : float, rad
        Standard deviation of azimuth and zenith.
    range_stdev : float, m
        Standard deviation of each time of arrival times the speed of light.
    rng : numpy.random.Generator

    Returns
    -------
    paths : list of SimulatedPath
        Paths to the stations that have one.
    measurements : list of dict
        In the form of ``POST /v1/positions``.

    Raises
    ------
    ReportError
        When the position is not in the free space or no path reaches a station.
    """
    point = np.asarray(position, dtype=np.float64)
    x, y, z = point
    if not table.scene.free_space.contains(point):
        raise ReportError(
            f"position ({x:.2f}, {y:.2f}, {z:.2f}) is in a solid or outdoors; give one in the free space",
            path=("position",),
        )
    local = point - table.scene.origin
    paths = [path for part in table.parts.values() if (path := find_path(part, local)) is not None]
    if not paths:
        raise ReportError(
            f"no path reaches a station from position ({x:.2f}, {y:.2f}, {z:.2f}); give one that rays reach",
            path=("position",),
        )
    clock = float(rng.uniform(0.0, _CLOCK_RANGE))
    measurements: list[dict[str, Any]] = []
    lengths = []
    for path in paths:
        # The draws do not depend on the kinds: with the same seed, reports of different kinds have the same noise.
        noise = rng.standard_normal(3)
        bias = table.parts[path.station_id].station.bias
        lengths.append(path.path_length + bias.range + range_stdev * float(noise[2]))
        if "aoa" in kinds:
            azimuth = float(wrap(path.azimuth + bias.azimuth + angle_stdev * noise[0]))
            zenith = float(np.clip(path.zenith + bias.zenith + angle_stdev * noise[1], 0.0, np.pi))
            measurements.append(_angle(path.station_id, azimuth, zenith, angle_stdev))
    for n, (path, length) in enumerate(zip(paths, lengths, strict=True)):
        common = {"station_id": path.station_id, "stdev_m": range_stdev}
        if "pt" in kinds:
            measurements.append({"type": "pt", "range_m": round(length, 4), **common})
        if "toa" in kinds:
            measurements.append({"type": "toa", "range_m": round(length + clock, 4), **common})
        if "tdoa" in kinds and n > 0:
            measurements.append(
                {
                    "type": "tdoa",
                    "station_id": path.station_id,
                    "reference_station_id": paths[0].station_id,
                    "range_difference_m": round(length - lengths[0], 4),
                    "stdev_m": round(range_stdev * 2.0**0.5, 4),
                }
            )
    return paths, measurements


def _angle(station_id: str, azimuth: float, zenith: float, stdev: float) -> dict[str, Any]:
    deviation = round(float(np.rad2deg(stdev)), 6)
    return {
        "type": "aoa",
        "station_id": station_id,
        "azimuth_deg": round(float(np.rad2deg(azimuth)), 4),
        "zenith_deg": round(float(np.rad2deg(zenith)), 4),
        "azimuth_stdev_deg": deviation,
        "zenith_stdev_deg": deviation,
        "frame": "scene",
    }
