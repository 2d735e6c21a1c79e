"""Benefit of tracking: errors of fixes and of tracks from the same reports along simulated walks.

The published results have the default seed. Use another seed to choose settings of the tracking.
"""

from dataclasses import replace
from time import perf_counter

import numpy as np
from scipy.stats import chi2

from benchmarks.common.example_table import open_or_build, table_parser
from benchmarks.common.walks import Errors, follow_walks, walk
from rayfix_evaluation.drops.accuracy import drops_at, solver_of
from rayfix_evaluation.drops.simulate import Noise, Timing
from rayfix_service.locator import Locator
from rayfix_service.tracking.motion import MotionModel
from rayfix_service.tracking.settings import TrackingSettings
from rayfix_service.tracking.tracker import Tracker

HEAD = "                                                   error [m]           above   truth in the ellipsoid of   NEES"
COLUMNS = "stations  angles  times             RMS      50 %     90 %     1 m      68 %     90 %     99 %      median"


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--walks", type=int, default=24)
    parser.add_argument("--reports", type=int, default=60, help="of each walk")
    parser.add_argument("--interval", type=float, default=0.5, help="seconds between reports")
    parser.add_argument("--speed", type=float, default=1.0, help="metres a second")
    parser.add_argument("--particles", type=int, default=TrackingSettings().num_particles)
    parser.add_argument("--acceleration-density", type=float, default=MotionModel().acceleration_density)
    parser.add_argument("--independent", action="store_true", help="take errors for independent: no drift")
    options = parser.parse_args()
    settings = TrackingSettings(
        num_particles=options.particles, motion=MotionModel(acceleration_density=options.acceleration_density)
    )
    if options.independent:
        settings = replace(settings, drift=None)
    with open_or_build(options.table) as table:
        begin = perf_counter()
        solver = solver_of(table)
        walks = [
            drops_at(
                walk(
                    table,
                    np.random.default_rng([options.seed, n]),
                    count=options.reports,
                    interval=options.interval,
                    speed=options.speed,
                ),
                solver,
                table.site.stations,
            )
            for n in range(options.walks)
        ]
        print(
            f"{len(walks)} walks of {options.reports} reports, {options.interval:g} s and {options.speed:g} m/s, seed "
            f"{options.seed}; paths found in {perf_counter() - begin:.0f} s"
        )
        print(HEAD)
        print(COLUMNS)
        locator = Locator(table)
        locator.warm_up()
        names = [station.id for station in table.site.stations]
        cases: list[tuple[list[str], float, Timing]] = [
            (names, 1.0, "none"),
            (names[:2], 1.0, "none"),
            (names[::2], 1.0, "none"),
            (names[:1], 1.0, "none"),
            (names, 5.0, "none"),
            (names[:2], 1.0, "pt"),
            (names[:1], 1.0, "pt"),
        ]
        for stations, degrees, timing in cases:
            angle = float(np.deg2rad(degrees))
            found = follow_walks(
                locator,
                Tracker(table, settings),
                walks,
                Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=None if timing == "none" else 0.5),
                interval=options.interval,
                seed=options.seed,
                timing=timing,
                stations=stations,
            )
            case = f"{len(stations)} ({', '.join(stations)})" if 1 < len(stations) < len(names) else f"{len(stations)}"
            print(f"{case:14} {degrees:g} deg {timing:5} fix   {row(found.fixes)}")
            print(f"{'':27} track {row(found.tracks)}", flush=True)


def row(errors: Errors) -> str:
    """Figures of a line."""
    half, most = np.quantile(errors.distance, (0.5, 0.9))
    held = [f"{np.mean(errors.nees < chi2.ppf(p, 3)):7.1%}" for p in (0.68, 0.9, 0.99)]
    return (
        f"{errors.rmse:8.3f} {half:8.3f} {most:8.3f} {errors.gross_share:8.1%} {'  '.join(held)} "
        f"{np.median(errors.nees):8.2f}"
    )


if __name__ == "__main__":
    main()
