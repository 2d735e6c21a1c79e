"""Accuracy in the bundled hall: 300 uniform drops, the strongest path to each station, compared with the error bound.

Run with ``make accuracy``, or with ``--table`` on any table.
"""

from collections import Counter

import numpy as np

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import drop_uniformly, locate_drops
from rayfix_evaluation.drops.simulate import Noise, Timing
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

CASES: list[tuple[float, Timing]] = [
    (0.25, "pt"),
    (1.0, "pt"),
    (0.25, "none"),
    (1.0, "none"),
    (1.0, "toa"),
    (3.0, "pt"),
    (10.0, "pt"),
]
"""Deviation of the angles [deg] and what else is measured, with 0.5 m."""


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--drops", type=int, default=300)
    options = parser.parse_args()
    with open_or_build(options.table) as table:
        measure(table, options.drops, options.seed)


def measure(table: Table, count: int, seed: int) -> None:
    drops = drop_uniformly(table, count, np.random.default_rng([seed, 0]))
    heard = Counter(len(drop.paths) for drop in drops)
    direct = sum(int(p.line_of_sight.any()) for drop in drops for p in drop.paths.values())
    pairs = len(drops) * len(table.site.stations)
    print(f"{count} drops, seed {seed}; stations that hear a drop: {dict(sorted(heard.items()))}")
    print(f"line of sight in {direct / pairs:.0%} of the pairs of drop and station")
    print("                    error [m]              bound [m]        RMS error / bound  gross     fix")
    print("angles  times     50 %   90 %   95 %     50 %   90 %    below 5 x bound   failures   [ms]   statuses")
    locator = Locator(table)
    locator.warm_up()
    for degrees, timing in CASES:
        angle = float(np.deg2rad(degrees))
        noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=0.5 if timing != "none" else None)
        found = locate_drops(locator, drops, noise, timing=timing, rng=np.random.default_rng([seed, 1]))
        error, bound = found.error, found.bound
        fair = np.isfinite(bound) & (bound < 10.0) & (error < 5.0 * bound)
        ratio = np.sqrt(np.mean(error[fair] ** 2) / np.mean(bound[fair] ** 2))
        gross = np.mean((error > 5.0 * bound) & (error > 1.0))
        e50, e90, e95 = np.percentile(error, [50, 90, 95], method="inverted_cdf")
        b50, b90 = np.percentile(bound, [50, 90], method="inverted_cdf")
        statuses = ", ".join(f"{n} {name}" for name, n in Counter(found.status).most_common())
        print(
            f"{degrees:5.2f}   {timing:5} {e50:8.3f} {e90:6.3f} {e95:6.3f} {b50:8.3f} {b90:6.3f} {ratio:14.2f}"
            f" {gross:13.1%} {1e3 * np.median(found.seconds):8.2f}   {statuses}",
            flush=True,
        )


if __name__ == "__main__":
    main()
