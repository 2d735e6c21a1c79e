"""A search for reports that take long: random valid reports of all kinds, changed step by step to increase the cost."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from time import monotonic

import numpy as np

from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    HEAVY_TAILED,
    Angle,
    ErrorModel,
    Height,
    LogRange,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_tables.errors import ReportError

MOST_MEASUREMENTS = 256
"""As a report of the HTTP interface has at most."""

_MODELS = (GAUSSIAN, GAUSSIAN, HEAVY_TAILED, ErrorModel(tail_share=0.5, tail_scale=20.0))


def random_measurement(rng: np.random.Generator, stations: Sequence[str]) -> Measurement:
    """Draw a measurement of any kind, with deviations from narrow to wide."""
    station = str(rng.choice(stations))
    model = _MODELS[int(rng.integers(len(_MODELS)))]
    stdev = float(np.exp(rng.uniform(math.log(0.05), math.log(50.0))))
    spread = math.radians(float(np.exp(rng.uniform(math.log(0.1), math.log(180.0)))))
    length, azimuth = float(rng.uniform(0.5, 40.0)), float(rng.uniform(-math.pi, math.pi))
    match rng.integers(6):
        case 0:
            return Range(station_id=station, path_length=length, stdev=stdev, error_model=model)
        case 1:
            return LogRange(station_id=station, path_length=length, log_stdev=float(rng.uniform(0.03, 1.5)))
        case 2:
            return TimeOfArrival(station_id=station, path_length=length + 100.0, stdev=stdev, error_model=model)
        case 3 if len(stations) > 1:
            first, second = (str(name) for name in rng.choice(stations, 2, replace=False))
            difference = float(rng.uniform(-15.0, 15.0))
            return TimeDifference(
                station_id=first,
                reference_station_id=second,
                length_difference=difference,
                stdev=stdev,
                error_model=model,
            )
        case 4:
            return Angle(station_id=station, azimuth=azimuth, azimuth_stdev=spread, error_model=model)
        case _:
            return Angle(
                station_id=station,
                azimuth=azimuth,
                azimuth_stdev=spread,
                zenith=float(rng.uniform(0.0, math.pi)),
                zenith_stdev=spread * float(rng.uniform(0.5, 2.0)),
                correlation=float(rng.choice([0.0, 0.0, 0.7])),
                frame=("scene", "lcs", "north")[int(rng.integers(3))],
                error_model=model,
                los_probability=float(rng.random()) if rng.random() < 0.1 else None,
            )


def random_report(rng: np.random.Generator, stations: Sequence[str], *, most: int = 12) -> Report:
    """Draw a report of a few measurements, mostly of some stations each in the same way."""
    some = [str(name) for name in rng.choice(stations, int(rng.integers(1, len(stations) + 1)), replace=False)]
    pattern = [random_measurement(rng, stations) for _ in range(int(rng.integers(1, 4)))]
    height = Height(z=float(rng.uniform(-1.0, 4.0)), stdev=float(rng.uniform(0.1, 2.0))) if rng.random() < 0.3 else None
    if rng.random() < 0.5:
        measurements = [random_measurement(rng, some) for _ in range(int(rng.integers(1, most + 1)))]
    else:
        measurements = [_at(m, name, some, rng) for name in some for m in pattern][:most]
    return Report(measurements=tuple(measurements), height=height)


def changed_report(report: Report, rng: np.random.Generator, stations: Sequence[str]) -> Report:
    """Change a report: more of the same, other deviations, heavier tails, other stations, fewer measurements."""
    old = list(report.measurements)
    match rng.integers(6):
        case 0:  # the same once more, of all stations
            like = old[int(rng.integers(len(old)))]
            new = old + [_at(like, str(name), stations, rng) for name in stations]
        case 1:  # each once more
            new = old + [_at(m, m.station_id, stations, rng) for m in old]
        case 2:
            new = [_widened(m, float(rng.choice([0.3, 3.0]))) for m in old]
        case 3:
            model = _MODELS[int(rng.integers(1, len(_MODELS)))]
            new = [m if isinstance(m, LogRange) else replace(m, error_model=model) for m in old]
        case 4:
            new = [*old, *(random_measurement(rng, stations) for _ in range(int(rng.integers(1, 20))))]
        case _:
            kept = rng.random(len(old)) < 0.8
            new = [m for m, keep in zip(old, kept, strict=True) if keep] or old
    return replace(report, measurements=tuple(new[:MOST_MEASUREMENTS]))


def climb(
    cost: Callable[[Report], float],
    stations: Sequence[str],
    rng: np.random.Generator,
    *,
    steps: int,
    seconds: float = math.inf,
    restart: int = 25,
) -> Iterator[tuple[Report, float]]:
    """Look for costly reports: change the costliest since the last new start, and keep what costs more.

    Parameters
    ----------
    cost : callable
        What a report costs; may raise ``ReportError`` for one that cannot be used, which counts as no step upwards.
    steps : int
        Reports to try.
    seconds : float
        When to end earlier.
    restart : int
        Steps after which to begin anew from a random report.

    Yields
    ------
    report : Report
    cost : float
        Of each that could be used.
    """
    until = monotonic() + seconds
    best, most = random_report(rng, stations), -math.inf
    for step in range(steps):
        if monotonic() > until:
            return
        if step % restart == 0:
            report, most = random_report(rng, stations), -math.inf
        else:
            report = changed_report(best, rng, stations)
        try:
            found = cost(report)
        except ReportError:
            continue
        if found >= most:
            best, most = report, found
        yield report, found


def _at(m: Measurement, station: str, stations: Sequence[str], rng: np.random.Generator) -> Measurement:
    """Measure much the same at a station; no two measurements of a report may be equal."""
    apart = float(rng.normal())
    match m:
        case Angle():
            return replace(m, station_id=station, azimuth=math.remainder(m.azimuth + 0.05 * apart, 2.0 * math.pi))
        case TimeDifference():
            others = [name for name in stations if name != station]
            if not others:
                return m
            reference = m.reference_station_id if m.reference_station_id != station else str(rng.choice(others))
            return replace(m, station_id=station, reference_station_id=reference)
        case _:
            return replace(m, station_id=station, path_length=abs(m.path_length + apart) + 0.01)


def _widened(m: Measurement, factor: float) -> Measurement:
    """Scale the deviation, within what the HTTP interface takes."""
    match m:
        case Angle(zenith_stdev=zenith_stdev):
            return replace(
                m,
                azimuth_stdev=min(factor * m.azimuth_stdev, 6.0),
                zenith_stdev=None if zenith_stdev is None else min(factor * zenith_stdev, 6.0),
            )
        case LogRange():
            return replace(m, log_stdev=min(factor * m.log_stdev, 1.5))
        case _:
            return replace(m, stdev=min(factor * m.stdev, 1e3))
