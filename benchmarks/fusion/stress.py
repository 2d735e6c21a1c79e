"""Effect of wrong measurements, wrong standard deviations and a wrong twin on fixes.

1. One measurement of four is an outlier: ratio of the median error to that of the correct report, with and without the
measurement, and how often the outlier is identified: as the only measurement of its kind (angle or time) with an
outlier probability above 0.5. 2. The standard deviations in the report are half or twice the true ones. 3. The building
differs from its twin: objects by 5 cm, walls by 2 cm, stations rotated by 0.5 deg. Reports are simulated in the changed
building; the table is that of the nominal one.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import Drop, drop_positions, drops_at, solver_of
from rayfix_evaluation.drops.simulate import Noise, Timing, simulate_report
from rayfix_evaluation.drops.stress import (
    move_scene,
    with_late_time,
    with_random_angle,
    with_scaled_stdevs,
    with_turned_stations,
)
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.locator import Locator
from rayfix_service.wire import parse_report
from rayfix_tables.table import Table

Document = dict[str, Any]
Change = Callable[[Document, int, np.random.Generator], Document]
"""Takes a report, the number of its drop and a source of randomness."""

DEGREES, RANGE_STDEV = 1.0, 0.5
DELAY = 10.0  # m
OBJECTS, WALLS, TURN_DEG = 0.05, 0.02, 0.5  # m, m, deg
MARGIN = 0.12  # m; moved objects must not bury a drop


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--drops", type=int, default=200)
    options = parser.parse_args()
    with open_or_build(options.table) as table:
        stations = table.site.stations
        places = drop_positions(table, options.drops, np.random.default_rng([options.seed, 0]), margin=MARGIN)
        drops = [drop for drop in drops_at(places, solver_of(table), stations) if len(drop.paths) == len(stations)]
        print(f"{len(drops)} drops that all stations hear; angles {DEGREES:g} deg, times {RANGE_STDEV:g} m")
        bench = Bench(table, options.seed)
        bench.nonsense(drops)
        bench.wrong_deviations(drops)
        bench.wrong_twin(places)


class Bench:
    """A table's locator, and reports with the same noise whatever is done to them."""

    def __init__(self, table: Table, seed: int) -> None:
        self.table, self.seed = table, seed
        self.names = [station.id for station in table.site.stations]
        self.locator = Locator(table)
        self.locator.warm_up()

    def fixes(self, drops: list[Drop], timing: Timing, change: Change | None = None) -> list[Fix]:
        """Locate the drops' reports, after a change if there is one."""
        angle = float(np.deg2rad(DEGREES))
        noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=RANGE_STDEV)
        fixes = []
        for n, drop in enumerate(drops):
            report = simulate_report(drop.paths, noise, rng=np.random.default_rng([self.seed, 1, n]), timing=timing)
            if change is not None:
                report = change(report, n, np.random.default_rng([self.seed, 2, n]))
            fixes.append(self.locator.locate(parse_report(report)))
        return fixes

    def wrong(self, n: int) -> str:
        """Station that is wrong in the n-th report: each in turn."""
        return self.names[n % len(self.names)]

    def nonsense(self, drops: list[Drop]) -> None:
        """One measurement of four replaced."""
        spoilers: list[tuple[str, Timing, str, Change]] = [
            ("random angle, no times", "none", "aoa", lambda r, n, rng: with_random_angle(r, self.wrong(n), rng)),
            ("random angle, PT", "pt", "aoa", lambda r, n, rng: with_random_angle(r, self.wrong(n), rng)),
            ("PT + 10 m", "pt", "pt", lambda r, n, _: with_late_time(r, self.wrong(n), DELAY)),
            ("ToA + 10 m", "toa", "toa", lambda r, n, _: with_late_time(r, self.wrong(n), DELAY)),
        ]
        print("\none of four is nonsense     median error [m]: sound  spoilt  without it  growth  marked   statuses")
        for label, timing, kind, spoil in spoilers:

            def leave_out(report: Document, n: int, _: np.random.Generator, kind: str = kind) -> Document:
                rest = [m for m in report["measurements"] if (m["type"], m["station_id"]) != (kind, self.wrong(n))]
                return {**report, "measurements": rest}

            sound = np.median(errors(self.fixes(drops, timing), drops))
            left_out = np.median(errors(self.fixes(drops, timing, leave_out), drops))
            fixes = self.fixes(drops, timing, spoil)
            spoilt = np.median(errors(fixes, drops))
            # Angles come first in a simulated report, then the times, in the stations' order.
            begin = 0 if kind == "aoa" else len(self.names)
            marked = [is_marked(fix, begin, len(self.names), n % len(self.names)) for n, fix in enumerate(fixes)]
            print(
                f"{label:28} {sound:22.3f} {spoilt:7.3f} {left_out:11.3f} {spoilt / sound:7.2f} {np.mean(marked):7.0%}"
                f"   {statuses(fixes)}",
                flush=True,
            )

    def wrong_deviations(self, drops: list[Drop]) -> None:
        """Deviations half or twice the true ones."""
        print("\nstated deviations           error [m]: 50 %    90 %   statuses (angles and PT)")
        for factor in (0.5, 1.0, 2.0):
            fixes = self.fixes(drops, "pt", lambda r, _, __, factor=factor: with_scaled_stdevs(r, factor))
            print(f"{factor:3g} x the true ones {percentiles(fixes, drops):>24}   {statuses(fixes)}", flush=True)

    def wrong_twin(self, places: NDArray[np.float64]) -> None:
        """Truth in a changed building."""
        stations, scene = self.table.site.stations, self.table.scene
        where = np.array([station.position for station in stations])
        turned = float(np.deg2rad(TURN_DEG))
        print("\nbuilding                    error [m]: 50 %    90 %   statuses")
        for label, objects, walls, angle in [
            ("as its twin", 0.0, 0.0, 0.0),
            ("objects 5 cm off", OBJECTS, 0.0, 0.0),
            ("walls 2 cm off", 0.0, WALLS, 0.0),
            ("stations turned by 0.5 deg", 0.0, 0.0, turned),
            ("all three", OBJECTS, WALLS, turned),
        ]:
            rng = np.random.default_rng([self.seed, 3])
            vertices = move_scene(scene.vertices, scene.faces, where, objects=objects, walls=walls, rng=rng)
            drops = [drop for drop in drops_at(places, solver_of(self.table, vertices), stations) if drop.paths]
            timings: tuple[Timing, ...] = ("pt", "none")
            for timing in timings:
                fixes = self.fixes(drops, timing, lambda r, _, rng, angle=angle: with_turned_stations(r, angle, rng))
                name = f"{label}, {'angles and PT' if timing == 'pt' else 'angles'}"
                print(f"{name:41} {percentiles(fixes, drops)}   {statuses(fixes)}", flush=True)


def errors(fixes: list[Fix], drops: list[Drop]) -> NDArray[np.float64]:
    """Distance of each fix from the truth, inf without a position, m."""
    return np.array(
        [
            np.inf if fix.position is None else np.linalg.norm(fix.position - drop.position)
            for fix, drop in zip(fixes, drops, strict=True)
        ]
    )


def is_marked(fix: Fix, begin: int, count: int, wrong: int) -> bool:
    """Whether of measurements ``begin`` to ``begin + count`` the wrong one has the highest probability, above 0.5."""
    of_kind = fix.outcomes[begin : begin + count]
    # What no ray of the table explains is not used at all.
    probability = [1.0 if outcome.outlier_probability is None else outcome.outlier_probability for outcome in of_kind]
    return probability[wrong] > 0.5 and probability[wrong] == max(probability)


def percentiles(fixes: list[Fix], drops: list[Drop]) -> str:
    low, high = np.percentile(errors(fixes, drops), [50, 90], method="inverted_cdf")
    return f"{low:7.3f} {high:7.3f}"


def statuses(fixes: list[Fix]) -> str:
    return ", ".join(f"{n} {name}" for name, n in Counter(fix.status for fix in fixes).most_common())


if __name__ == "__main__":
    main()
