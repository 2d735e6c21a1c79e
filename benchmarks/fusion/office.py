"""The bundled office with walls that let signals through, beside a table that takes them for opaque: costs and errors.

Processor seconds and size of both tables; then uniform drops in a world whose walls let signals through, by the image
method, and the time of a fix where both tables hear the same stations. Run with ``python -m benchmarks.fusion.office``.
"""

import argparse
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np

from rayfix.example.files import write_example
from rayfix_evaluation.drops.accuracy import Drop, drop_uniformly, drops_at, locate_drop, solver_of
from rayfix_evaluation.drops.calibration import ellipsoid_holds
from rayfix_evaluation.drops.simulate import Noise, Timing
from rayfix_offline.build import build_table
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

WITHIN_DB = 40.0
"""Stations within this of the strongest report."""

REGION = 0.9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drops", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        opaque, passed = build_both(Path(folder))
        for timing in ("pt", "none", "tdoa"):
            compare_errors({"opaque": opaque, "passed": passed}, passed, timing, options.drops, options.seed)
        for timing in ("pt", "none"):
            compare_times(opaque, passed, timing, options.drops, options.seed)


def build_both(folder: Path) -> tuple[Table, Table]:
    """Build the office's table with opaque walls and with walls that let signals through."""
    tables = []
    for name in ("opaque", "passed"):
        site = write_example(folder / name, example="office")
        if name == "opaque":
            text = site.read_text(encoding="utf-8").replace("transmission = true ", "transmission = false")
            site.write_text(text, encoding="utf-8")
            build_table(site, folder / "kernels.h5")  # compiles them
        begin = process_time()
        summary = build_table(site, folder / f"{name}.h5")
        print(f"{name}: {process_time() - begin:.0f} processor seconds, {summary.num_bytes / 1e6:.1f} MB", flush=True)
        tables.append(Table.open(summary.path))
    return tables[0], tables[1]


def one_degree() -> Noise:
    """Angles of 1 deg, and times of 0.5 m."""
    return Noise(azimuth_stdev=np.deg2rad(1.0), zenith_stdev=np.deg2rad(1.0), range_stdev=0.5)


def compare_errors(tables: dict[str, Table], world: Table, timing: Timing, count: int, seed: int) -> None:
    """Print the errors of both tables on the same reports."""
    drops = [heard(drop) for drop in drop_uniformly(world, count, np.random.default_rng([seed, 0]), max_height=2.0)]
    for name, table in tables.items():
        locator, rng = Locator(table), np.random.default_rng([seed, 1])
        located = [locate_drop(locator, drop, one_degree(), timing=timing, rng=rng) for drop in drops]
        error = np.array([each.error for each in located])
        held = np.mean([ellipsoid_holds(each.fix, REGION, each.drop.position) for each in located])
        statuses = Counter(each.fix.status for each in located)
        print(
            f"1 deg, {timing:5} {name}: 50 % {np.percentile(error, 50):.3f} m, 90 % {np.percentile(error, 90):.3f} m, "
            f"{np.mean(error > 1.0):.1%} above 1 m, 90 % regions hold {held:.1%}, {dict(statuses)}",
            flush=True,
        )


def heard(drop: Drop) -> Drop:
    """Return a drop with the stations that hear it well enough."""
    best = max(paths.gain_db.max() for paths in drop.paths.values())
    return replace(drop, paths={n: p for n, p in drop.paths.items() if p.gain_db.max() >= best - WITHIN_DB})


def compare_times(opaque: Table, passed: Table, timing: Timing, count: int, seed: int) -> None:
    """Print the time of fixes of the same stations, each table in its own world."""
    drops = [d for d in drop_uniformly(opaque, count, np.random.default_rng([seed, 2]), max_height=2.0) if d.paths]
    others = drops_at(np.array([drop.position for drop in drops]), solver_of(passed), passed.site.stations)
    locators, rng = (Locator(opaque), Locator(passed)), np.random.default_rng([seed, 3])
    seconds = []
    for drop, other in zip(drops, others, strict=True):
        same = replace(other, paths={name: other.paths[name] for name in drop.paths})
        pair = [
            locate_drop(locator, each, one_degree(), timing=timing, rng=rng)
            for locator, each in zip(locators, (drop, same), strict=True)
        ]
        if all(each.fix.status == "ok" for each in pair):
            seconds.append([each.seconds for each in pair])
    medians = 1e3 * np.median(seconds, axis=0)
    print(f"fix of the same stations, {timing}: {medians[0]:.2f} ms opaque, {medians[1]:.2f} ms passed")


if __name__ == "__main__":
    main()
