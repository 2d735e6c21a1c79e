"""Tracks of targets whose stations' errors drift: how their errors go with the rate of reports, and what circles hold.

Targets walk through an empty box of 8 x 18 x 2.5 m with four stations, or through the bundled hall. Each station
reports azimuth and zenith of its strongest path with an error that is the sum of a drift, a stationary Gauss-Markov
process of a correlation time, and scatter; with a correlation time of 0 all of it is scatter. Reports state the
deviation of both together. Fewer reports a second are a part of the same ones. The tracker is told share and
correlation time by the site file (``site``), assumes what it does by default (``defaults``), or takes errors for
independent (``independent``).

Horizontal errors once a second: mean, RMS, and the share of truths in the circles that hold 68 and 90 % of the track's
particles; processor time of an update without the fix (median). The published results have the default seed; settings
were chosen on others.
"""

import argparse
import itertools
import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.walks import walk
from benchmarks.fusion.wide_errors import write_box
from rayfix.example.files import write_example
from rayfix_evaluation.drops.accuracy import drops_at, solver_of
from rayfix_evaluation.drops.simulate import fold_direction
from rayfix_offline.build import build_table
from rayfix_service.fusion.measurements.report import Angle, Report
from rayfix_service.locator import Locator
from rayfix_service.tracking.settings import TrackingSettings
from rayfix_service.tracking.tracker import Tracker
from rayfix_tables.site import Deviations
from rayfix_tables.table import Table

PER_SECOND = 10
START = datetime(2026, 1, 1, tzinfo=UTC)
ASSUMED = ("site", "defaults", "independent")

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Walked:
    """A walk, ten places a second.

    Attributes
    ----------
    position : ndarray of shape (n, 3), m
    direction : ndarray of shape (n, n_stations, 2), rad
        Azimuth and zenith of each station's strongest path, NaN where it hears nothing.
    """

    position: Array
    direction: Array


def walks_of(table: Table, count: int, seconds: int, seed: int) -> list[Walked]:
    """Walk at 1 m/s from place to place."""
    solver, found = solver_of(table), []
    for n in range(count):
        places = walk(
            table,
            np.random.default_rng([seed, n]),
            count=PER_SECOND * seconds + 1,
            interval=1.0 / PER_SECOND,
            speed=1.0,
        )
        direction = np.full((len(places), len(table.site.stations), 2), np.nan)
        for row, place in zip(direction, places, strict=True):
            for drop in drops_at(place[None], solver, table.site.stations):
                for j, station in enumerate(table.site.stations):
                    paths = drop.paths.get(station.id)
                    if paths is not None and len(paths):
                        k = int(np.argmax(paths.gain_db))
                        row[j] = paths.azimuth[k], paths.zenith[k]
        found.append(Walked(position=places, direction=direction))
    return found


def errors(rng: np.random.Generator, shape: tuple[int, ...], drift: float, scatter: float, correlation: float) -> Array:
    """Draw errors of shape (n, ...), ten a second."""
    if correlation == 0.0:
        return np.asarray(math.hypot(drift, scatter) * rng.standard_normal(shape))
    rho = math.exp(-1.0 / (PER_SECOND * correlation))
    process = rng.standard_normal(shape)
    for n in range(1, len(process)):
        process[n] = rho * process[n - 1] + math.sqrt(1.0 - rho**2) * process[n]
    return np.asarray(drift * process + scatter * rng.standard_normal(shape))


def told(table: Table, drift: float, scatter: float, correlation: float) -> Table:
    """Write what the errors are into the site."""
    share = 0.0 if correlation == 0.0 else drift**2 / (drift**2 + scatter**2)
    found = Deviations(correlated_share=share, correlation_time=min(max(correlation, 1e-3), 1e6))
    stations = tuple(replace(station, deviations=found) for station in table.site.stations)
    return replace(table, site=replace(table.site, stations=stations))


def row(
    locator: Locator,
    assumed: str,
    walks: Sequence[Walked],
    noise: tuple[float, float, float],
    rate: int,
    seed: int,
) -> str:
    """Follow all walks, and sum up."""
    drift, scatter, correlation = noise
    stdev = math.radians(math.hypot(drift, scatter))
    table = told(locator.table, *noise) if assumed == "site" else locator.table
    tracker = Tracker(table, replace(TrackingSettings(), drift=None) if assumed == "independent" else None)
    tracker.warm_up()
    off, held, spent = [], [], []
    for number, walked in enumerate(walks):
        rng = np.random.default_rng([seed, number, 1])
        measured = walked.direction + np.radians(errors(rng, walked.direction.shape, drift, scatter, correlation))
        for n in range(0, len(measured), PER_SECOND // rate):
            angles = []
            for station, (azimuth, zenith) in zip(locator.table.site.stations, measured[n], strict=True):
                if not math.isnan(azimuth):
                    azimuth, zenith = fold_direction(float(azimuth), float(zenith))
                    angles.append(
                        Angle(
                            station_id=station.id,
                            azimuth=azimuth,
                            zenith=zenith,
                            azimuth_stdev=stdev,
                            zenith_stdev=stdev,
                        )
                    )
            if not angles:
                continue
            moment = (START + timedelta(seconds=n / PER_SECOND)).isoformat()
            fused = locator.fuse(Report(measurements=tuple(angles), target_id=str(number), timestamp=moment))
            begin = time.thread_time()
            track = tracker.follow(fused)
            spent.append(time.thread_time() - begin)
            if track is not None and n % PER_SECOND == 0:
                centre = track.estimate.position[:2]
                apart = float(np.linalg.norm(centre - walked.position[n, :2]))
                around = np.linalg.norm(track.regions.points.position[:, :2] - centre, axis=1)
                off.append(apart)
                held.append(apart <= np.quantile(around, (0.68, 0.9)))
    low, high = 100.0 * np.mean(held, axis=0)
    return (
        f"mean {np.mean(off):.3f} m  RMS {np.sqrt(np.mean(np.square(off))):.3f} m  68 %: {low:5.1f}  90 %: {high:5.1f}"
        f"  {1e3 * np.median(spent):5.2f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=("box", "hall"), action="append")
    parser.add_argument("--table", type=Path, help="of the scene, which must be one; built when left out")
    parser.add_argument("--assumed", choices=ASSUMED, action="append")
    parser.add_argument("--drift", type=float, default=6.0, help="deviation, degrees")
    parser.add_argument("--scatter", type=float, default=1.0, help="deviation, degrees")
    parser.add_argument("--correlation", type=float, action="append", help="seconds; inf for ever")
    parser.add_argument("--rate", type=int, choices=(1, 2, 5, 10), action="append", help="reports a second")
    parser.add_argument("--walks", type=int, default=24)
    parser.add_argument("--seconds", type=int, default=30, help="of each walk")
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    rows = list(
        itertools.product(
            options.assumed or ASSUMED, options.correlation or (0.0, 1.0, 5.0, math.inf), options.rate or (1, 2, 10)
        )
    )
    for scene in options.scene or ("box", "hall"):
        with tempfile.TemporaryDirectory() as folder:
            path = options.table
            if path is None:
                path = Path(folder) / "table.h5"
                build_table(write_box(Path(folder)) if scene == "box" else write_example(folder), path)
            table = Table.open(path)
            walks = walks_of(table, options.walks, options.seconds, options.seed)
            locator = Locator(table)
            locator.warm_up()
            print(
                f"{scene}: drift {options.drift:g} deg, scatter {options.scatter:g} deg, {len(walks)} walks", flush=True
            )
            for assumed, correlation, rate in rows:
                noise = options.drift, options.scatter, correlation
                found = row(locator, assumed, walks, noise, rate, options.seed)
                print(f"{scene} {assumed:11s} {correlation:4g} s  {rate:2d} a second: {found}", flush=True)


if __name__ == "__main__":
    main()
