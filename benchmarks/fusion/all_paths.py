"""Reports of several paths of a station, and of stations that select one path by a rule, in a site's scene.

Each row is of uniform places and of noise with the stated deviations. ``50`` and ``90`` are quantiles of the error, m;
``bound`` those of the position error bound of the same paths; ``full`` is the row of the places where each station has
as many paths as it may report; ``held`` is how many true positions the 90 % regions hold, per cent; ``ms`` is the
processor time of a fix, its median and 90 %. ``--stress`` prints curves over the number of paths that a station
reports, of spurious and of missing ones, and one path of each station given as a path and as an angle and a range.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import Drop, drop_uniformly
from rayfix_evaluation.drops.bound import position_error_bound
from rayfix_evaluation.drops.several import PathClock, simulate_paths
from rayfix_evaluation.drops.simulate import Noise, Rule, Timing, select_path, simulate_report
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

RULES: tuple[tuple[Rule, str | None, float, Timing], ...] = (
    ("random", None, 1.0, "pt"),
    ("random", "any", 1.0, "pt"),
    ("random", "any", 1.0, "none"),
    ("first", "first", 1.0, "pt"),
    ("strongest", "strongest", 1.0, "pt"),
    ("random", "any", 0.25, "pt"),
)
"""How stations select, what the report says of it, deviation of angles, deg, and times."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row of several paths: stations, paths of each, spurious ones of these, share of missing ones, clock."""

    stations: int = 1
    most: int = 5
    spurious: int = 0
    missing: float = 0.0
    clock: PathClock = "ue"


ROWS = (
    Row(),
    Row(most=10),
    Row(clock="station"),
    Row(clock="known"),
    Row(spurious=2),
    Row(clock="known", spurious=2),
    Row(clock="known", missing=0.2),
    Row(stations=4, most=1),
    Row(stations=4),
    Row(stations=4, spurious=2),
)

STRESS = (
    *(Row(stations=stations, most=most) for stations in (1, 4) for most in range(1, 7)),
    *(Row(stations=4, spurious=spurious) for spurious in (1, 2, 3)),
    *(Row(stations=4, missing=missing) for missing in (0.2, 0.4, 0.6)),
    *(Row(clock="known", spurious=spurious) for spurious in (1, 2, 3)),
)
"""Curves over the number of paths reported, spurious ones among five, and missing ones."""


def deviations(degrees: float, metres: float) -> Noise:
    angle = float(np.deg2rad(degrees))
    return Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=metres)


class Errors:
    """Errors, regions and times of the fixes of a row."""

    def __init__(self) -> None:
        self.error: list[float] = []
        self.held: list[bool] = []
        self.seconds: list[float] = []

    def locate(self, locator: Locator, report: dict[str, Any], place: NDArray[np.float64]) -> None:
        """Locate a report of a place."""
        begin = time.thread_time()
        fix = locator.locate(report)
        self.seconds.append(time.thread_time() - begin)
        self.error.append(np.inf if fix.position is None else float(np.linalg.norm(fix.position - place)))
        self.held.append(fix.regions is not None and bool(fix.regions.ellipsoid(0.9).holds(place)))

    def line(self, which: NDArray[np.bool_] | None = None) -> str:
        """Write the figures of the fixes, or of some of them."""
        chosen = np.ones(len(self.error), bool) if which is None else which
        if not chosen.any():
            return "none"
        error, held = np.array(self.error)[chosen], np.array(self.held)[chosen]
        ms = 1e3 * np.quantile(np.array(self.seconds)[chosen], (0.5, 0.9))
        half, most = np.quantile(error, (0.5, 0.9), method="inverted_cdf")
        return f"50 {half:6.3f}  90 {most:6.3f}  held {100 * held.mean():5.1f}  ms {ms[0]:5.1f} {ms[1]:5.1f}"


def several(locator: Locator, drops: list[Drop], row: Row, seed: int) -> None:
    """Print a row of several paths."""
    rng, found, bounds, full = np.random.default_rng([seed, 1]), Errors(), [], []
    noise, positions = deviations(1.0, 0.3), {s.id: s.position for s in locator.table.site.stations}
    for number, drop in enumerate(drops):
        names = rng.permutation(list(drop.paths))[: row.stations].tolist()
        heard = {name: drop.paths[name] for name in names}
        report = simulate_paths(
            heard, noise, rng=rng, most=row.most, clock=row.clock, spurious=row.spurious, missing=row.missing
        )
        if not report["measurements"]:
            continue
        if number == 0:
            locator.locate(report)
        found.locate(locator, report, drop.position)
        counts = {name: min(row.most, len(paths)) - row.spurious for name, paths in heard.items()}
        chosen = [(name, n) for name, count in counts.items() for n in range(count)]
        full.append(len(names) == row.stations and all(len(heard[name]) >= row.most for name in names))
        bounds.append(
            position_error_bound(
                np.array([positions[name] for name, _ in chosen]).reshape(-1, 3),
                [heard[name] for name, _ in chosen],
                [n for _, n in chosen],
                drop.position,
                noise,
                timing="pt" if row.clock == "known" else "toa",
            )
            if chosen and (row.clock != "station" or row.stations == 1)
            else np.nan
        )
    known = np.array(bounds)[~np.isnan(bounds)]
    bound = np.quantile(known, (0.5, 0.9), method="inverted_cdf") if len(known) else (np.nan, np.nan)
    print(f"{row}\n    {found.line()}  bound {bound[0]:.3f} {bound[1]:.3f}  of {len(found.error)}", flush=True)
    print(f"    full: {found.line(np.array(full))}  of {np.count_nonzero(full)}", flush=True)


def rules(locator: Locator, drops: list[Drop], seed: int) -> None:
    """Print the rows of stations that select one path."""
    for rule, stated, degrees, timing in RULES:
        rng, found = np.random.default_rng([seed, 2]), Errors()
        for number, drop in enumerate(drops):
            reported = {name: paths.only(select_path(paths, rule, rng)) for name, paths in drop.paths.items()}
            report = simulate_report(reported, deviations(degrees, 0.5), rng=rng, timing=timing)
            report |= {} if stated is None else {"selection": {"rule": stated}}
            if number == 0:
                locator.locate(report)
            found.locate(locator, report, drop.position)
        print(f"select {rule}, stated {stated}, {degrees:g} deg, {timing}: {found.line()}", flush=True)


def one_path(locator: Locator, drops: list[Drop], seed: int) -> None:
    """Print the row of one path of each of four stations, given as a set of one, and as an angle and a range."""
    noise = deviations(1.0, 0.3)
    for title in ("as path", "as aoa and pt"):
        rng, found = np.random.default_rng([seed, 3]), Errors()
        for number, drop in enumerate(drops):
            names = rng.permutation(list(drop.paths))[:4].tolist()
            strongest = {name: drop.paths[name].only(0) for name in names}
            # Both draw the same errors, or they could not be compared.
            errors = np.random.default_rng([seed, 4, number])
            report = simulate_paths(strongest, noise, rng=errors, most=1, clock="known")
            if title != "as path":
                report = {"measurements": [each for row in report["measurements"] for each in angle_and_range(row)]}
            if number == 0:
                locator.locate(report)
            found.locate(locator, report, drop.position)
        print(f"4 stations, one path each, known clock, {title}: {found.line()}", flush=True)


def angle_and_range(path: dict[str, Any]) -> list[dict[str, Any]]:
    """Give a measured path as an angle of arrival and a propagation time."""
    angle = {key: value for key, value in path.items() if key not in ("range_m", "stdev_m")}
    length = {key: path[key] for key in ("station_id", "range_m", "stdev_m")}
    return [angle | {"type": "aoa"}, length | {"type": "pt"}]


def run(table: Table, count: int, seed: int, *, stress: bool) -> None:
    locator = Locator(table)
    drops = [drop for drop in drop_uniformly(table, count, np.random.default_rng(seed)) if drop.paths]
    if stress:
        one_path(locator, drops, seed)
        for row in STRESS:
            several(locator, drops, row, seed)
        return
    rules(locator, drops, seed)
    for row in ROWS:
        several(locator, drops, row, seed)


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--places", type=int, default=200)
    parser.add_argument("--stress", action="store_true", help="curves over numbers of reported and spurious paths")
    options = parser.parse_args()
    with open_or_build(options.table) as table:
        run(table, options.places, options.seed, stress=options.stress)


if __name__ == "__main__":
    main()
