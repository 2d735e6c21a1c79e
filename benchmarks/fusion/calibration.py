"""Calibration of the stated uncertainty: credible ellipsoids, gross failures and rivals over uniform drops.

The published results have the default seed. Use another seed (such as ``--seed 1``) to choose settings of the fusion;
otherwise the published results would not be a test.
"""

from collections import Counter
from typing import get_args

import numpy as np

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import Drop, drop_uniformly, locate_drop
from rayfix_evaluation.drops.calibration import calibrate, wilson_interval
from rayfix_evaluation.drops.simulate import Noise, Rule, Timing
from rayfix_service.locator import Locator

TIMINGS: tuple[Timing, ...] = ("none", "pt", "tdoa")
DEVIATIONS_DEG = (0.25, 1.0, 5.0)
RANGE_STDEV = 0.5  # m
PROBABILITIES = (0.5, 0.68, 0.9, 0.99)


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--drops", type=int, default=300)
    parser.add_argument("--select", choices=get_args(Rule), default="strongest", help="path that a station reports")
    options = parser.parse_args()
    with open_or_build(options.table) as table:
        drops = drop_uniformly(table, options.drops, np.random.default_rng([options.seed, 0]))
        drops = [drop for drop in drops if drop.paths]
        print(f"{len(drops)} drops that a station hears, seed {options.seed}; reported is the {options.select} path")
        print("                share of drops [%] in the ellipsoid of            gross      truth in  RMS error")
        print(
            "angles  times  50 %          68 %          90 %          99 %     failures   a rival   / bound   statuses"
        )
        locator = Locator(table)
        locator.warm_up()
        for timing in TIMINGS:
            for degrees in DEVIATIONS_DEG:
                print(row(locator, drops, degrees, timing, options.select, options.seed), flush=True)


def row(locator: Locator, drops: list[Drop], degrees: float, timing: Timing, rule: Rule, seed: int) -> str:
    """One line of the table: shares with the half width of their 95 % interval."""
    angle = float(np.deg2rad(degrees))
    noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=None if timing == "none" else RANGE_STDEV)
    rng = np.random.default_rng([seed, 1])
    located = [locate_drop(locator, drop, noise, timing=timing, rng=rng, rule=rule) for drop in drops]
    found = calibrate(located, PROBABILITIES)
    shares = []
    for hits in found.covered.values():
        low, high = wilson_interval(hits, found.count)
        shares.append(f"{100 * hits / max(found.count, 1):5.1f} +- {50 * (high - low):3.1f}")
    rival = f"{found.rival_right} of {found.gross}"
    gross = f"{found.gross / max(found.count, 1):.1%}"
    statuses = ", ".join(f"{n} {name}" for name, n in Counter(item.fix.status for item in located).most_common())
    return (
        f"{degrees:5.2f}   {timing:4} {'  '.join(shares)} {gross:>8} {rival:>11} {found.rms_ratio:8.2f}     {statuses}"
    )


if __name__ == "__main__":
    main()
