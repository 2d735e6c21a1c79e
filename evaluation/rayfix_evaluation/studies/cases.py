"""A case: the state of the world, the measurements and their accuracy, and disturbances."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.drops.accuracy import Drop
from rayfix_evaluation.drops.bound import position_error_bound
from rayfix_evaluation.drops.simulate import Noise, Rule, Timing, fold_direction, select_path, simulate_report
from rayfix_evaluation.drops.stress import (
    Document,
    with_late_time,
    with_random_angle,
    with_scaled_stdevs,
    with_turned_stations,
)
from rayfix_evaluation.truth.forward import Paths
from rayfix_tables.geometry.angles import direction
from rayfix_tables.geometry.mounting import board_to_scene
from rayfix_tables.site import Station

__all__ = ["Case", "Simulated", "World", "document_key", "in_view", "simulate_case"]

# Purposes of generators; the seed comes first and the number of the drop last.
_NOISE, _TURN, _SELECT, _BLOCK, _ORDER, _BIAS, _SPOIL = 1, 2, 4, 5, 6, 7, 8

_DELAY = 10.0
"""Error of a delayed time, m."""


@dataclass(frozen=True, kw_only=True)
class World:
    """Differences between the building and its twin.

    Attributes
    ----------
    objects, walls : float, m
        Displacements of objects and outer walls from their positions in the twin.
    more_reflections : int
        Reflections of the longest paths beyond those in the table.
    """

    objects: float = 0.0
    walls: float = 0.0
    more_reflections: int = 0


@dataclass(frozen=True, kw_only=True)
class Case:
    """Settings of a run.

    Attributes
    ----------
    angle_deg : float, deg
        Standard deviation of azimuth and zenith.
    timing : {"none", "pt", "toa", "tdoa"}
        Times in addition to the angles. ``"tdoa"`` gives the paper's relative propagation times (RPT).
    range_stdev : float, m
        Standard deviation of a time as a length, or of a difference if differences are measured.
    rule : {"strongest", "first", "random"}
        Rule by which each station selects the reported path.
    world : World
    heard : int or None
        Number of stations in the report, drawn for each drop; None for all.
    without : str or None
        A station that is out of service.
    blocked : float
        Probability that the direct path of a station is blocked.
    told : float
        Ratio of the standard deviations in the report to the true ones.
    bias_deg : float, deg
        Bias of a station's azimuth and zenith, with signs that are drawn once for each station.
    turned_deg : float, deg
        Angle by which stations are rotated about axes that are drawn for each drop.
    random_angles : int
        Number of stations that report a random angle.
    late_times : int
        Number of stations that report a time 10 m too long.
    """

    angle_deg: float = 1.0
    timing: Timing = "pt"
    range_stdev: float = 0.5
    rule: Rule = "strongest"
    world: World = World()
    heard: int | None = None
    without: str | None = None
    blocked: float = 0.0
    told: float = 1.0
    bias_deg: float = 0.0
    turned_deg: float = 0.0
    random_angles: int = 0
    late_times: int = 0

    @property
    def noise(self) -> Noise:
        """True standard deviations of the measurements."""
        angle = float(np.deg2rad(self.angle_deg))
        # A difference has the noise of both of its times.
        single = self.range_stdev / np.sqrt(2.0) if self.timing == "tdoa" else self.range_stdev
        return Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=float(single))

    def document(self) -> dict[str, Any]:
        """Return the settings as JSON-compatible data."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """A report and its true properties.

    Attributes
    ----------
    report : dict
        Body of ``POST /v1/positions``; without measurements if no station is left.
    bound : float, m
        Position error bound of the measurements before disturbances.
    hidden : int
        Number of stations in the report with a reflected path.
    """

    report: Document
    bound: float
    hidden: int


def document_key(document: Mapping[str, Any]) -> str:
    """Return a hash of settings."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def simulate_case(case: Case, drop: Drop, number: int, stations: Sequence[Station], seed: int) -> Simulated:
    """Simulate the report of a drop.

    With the same seed, a drop has the same standardised noise in all cases.

    Parameters
    ----------
    drop : Drop
        The drop with all paths of its world.
    number : int
        Number of the drop.
    stations : sequence of Station
        Stations of the site.
    """

    def generator(purpose: int) -> np.random.Generator:
        return np.random.default_rng([seed, purpose, number])

    reported = _reported(case, drop, generator(_BLOCK), generator(_SELECT))
    report = simulate_report(reported, case.noise, rng=generator(_NOISE), timing=case.timing)
    order = [list(reported)[n] for n in generator(_ORDER).permutation(len(reported))]
    silent = set(order[case.heard :] if case.heard is not None else []) | {case.without}
    if silent & set(reported):
        reported = {name: paths for name, paths in reported.items() if name not in silent}
        report["measurements"] = [m for m in report["measurements"] if m["station_id"] not in silent]
    where = {station.id: station.position for station in stations}
    bound = position_error_bound(
        np.array([where[name] for name in reported]).reshape(-1, 3),
        list(reported.values()),
        [0] * len(reported),
        drop.position,
        case.noise,
        timing=case.timing,
    )
    return Simulated(
        report=_spoil(case, report, list(reported), stations, seed, number),
        bound=bound,
        hidden=sum(int(paths.num_reflections[0] > 0) for paths in reported.values()),
    )


def in_view(station: Station, paths: Paths) -> Paths:
    """Paths from within a station's field of view."""
    axis = board_to_scene(station)[:, 0]
    cosine = np.clip(direction(paths.azimuth, paths.zenith) @ axis, -1.0, 1.0)
    return paths.chosen(np.arccos(cosine) <= 0.5 * station.field_of_view)


def _reported(
    case: Case, drop: Drop, block_rng: np.random.Generator, select_rng: np.random.Generator
) -> dict[str, Paths]:
    """Path that each station reports, of the paths that are not blocked."""
    reported = {}
    for name, paths in drop.paths.items():
        blocked = bool(block_rng.random() < case.blocked)
        left = np.flatnonzero(paths.num_reflections > 0) if blocked else np.arange(len(paths))
        if len(left):
            usable = paths.chosen(left)
            reported[name] = usable.only(select_path(usable, case.rule, select_rng))
    return reported


def _spoil(
    case: Case, report: Document, names: Sequence[str], stations: Sequence[Station], seed: int, number: int
) -> Document:
    rng = np.random.default_rng([seed, _SPOIL, number])
    order = [names[n] for n in rng.permutation(len(names))]
    for name in order[: case.random_angles]:
        report = with_random_angle(report, name, rng)
    for name in order[: case.late_times]:
        report = with_late_time(report, name, _DELAY)
    if case.turned_deg:
        turn = np.random.default_rng([seed, _TURN, number])
        report = with_turned_stations(report, float(np.deg2rad(case.turned_deg)), turn)
    # Add the biases of the site file, which the fusion subtracts.
    offsets = {s.id: np.degrees([s.bias.azimuth, s.bias.zenith]) for s in stations}
    if case.bias_deg:
        signs = np.random.default_rng([seed, _BIAS]).choice([-1.0, 1.0], (len(stations), 2))
        offsets = {name: off + case.bias_deg * sign for (name, off), sign in zip(offsets.items(), signs, strict=True)}
    if any(off.any() for off in offsets.values()):
        report = _with_bias(report, offsets)
    for station in stations:
        if station.bias.range:
            report = with_late_time(report, station.id, station.bias.range)
    return with_scaled_stdevs(report, case.told) if case.told != 1.0 else report


def _with_bias(report: Document, offsets: Mapping[str, NDArray[np.float64]]) -> Document:
    """Copy a report with a bias [deg] of each station's azimuths and zeniths."""
    measurements = []
    for m in report["measurements"]:
        if m["type"] == "aoa":
            off = offsets[m["station_id"]]
            azimuth, zenith = fold_direction(*np.deg2rad([m["azimuth_deg"] + off[0], m["zenith_deg"] + off[1]]))
            m = {**m, "azimuth_deg": float(np.degrees(azimuth)), "zenith_deg": float(np.degrees(zenith))}
        measurements.append(m)
    return {**report, "measurements": measurements}
