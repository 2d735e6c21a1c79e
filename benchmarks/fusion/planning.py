"""Planning maps compared with measured errors: a floor forecast from the table, and simulated with the forward solver.

Run with ``--table`` on any table; by default the bundled hall's is built.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import drops_at, locate_drops, solver_of
from rayfix_evaluation.drops.simulate import Noise, Timing
from rayfix_evaluation.planning.forecast import PlanMap, PlanSettings, draw_places, forecast
from rayfix_evaluation.planning.station_mixture import audible_paths
from rayfix_service.locator import Locator
from rayfix_tables.geometry.angles import direction
from rayfix_tables.table import Table

CASES: list[tuple[float, Timing]] = [
    (0.25, "none"),
    (1.0, "none"),
    (1.0, "pt"),
    (1.0, "toa"),
    (3.0, "none"),
    (3.0, "pt"),
]
"""Deviation of the angles [deg] and what else is measured, with 0.5 m."""


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--height", type=float, default=1.2)
    parser.add_argument("--spacing", type=float, default=1.0, help="side of the squares, m")
    parser.add_argument("--draws", type=int, default=16, help="reports from each square, forecast and measured")
    options = parser.parse_args()
    with open_or_build(options.table) as table:
        compare_paths(table, options.height, options.spacing, options.seed)
        compare_errors(table, options.height, options.spacing, options.draws, options.seed)


def compare_paths(table: Table, height: float, spacing: float, seed: int) -> None:
    """Which path is reported, by the table and by the forward solver, from places apart from those of the maps."""
    _, places = draw_places(table, height, spacing, 3, np.random.default_rng([seed, 1]))
    solver = solver_of(table)
    right, strongest, some, off, apart = [], [], [], [], []
    for station in table.site.stations:
        predicted = audible_paths(table.levels(station.id)[0], places - table.scene.origin)
        of_station = solver.station(station.position)
        for n, place in enumerate(places):
            paths = of_station.paths(place)
            right.append(bool(predicted.audible[n]) == (len(paths) > 0))
            if predicted.audible[n] and len(paths):
                cosine = direction(paths.azimuth, paths.zenith) @ direction(predicted.azimuth[n], predicted.zenith[n])
                angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
                same = (angle < 1.0) & (np.abs(paths.path_length - predicted.path_length[n]) < 0.3)
                strongest.append(same[0])
                some.append(same.any())
                if same[0]:
                    off.append(angle[0])
                    apart.append(abs(paths.path_length[0] - predicted.path_length[n]))
    print(
        f"{len(places)} places and {len(table.site.stations)} stations at {height} m: whether audibility is right for "
        f"{np.mean(right):.0%}; the reported path is the strongest for {np.mean(strongest):.0%}, one that there is for "
        f"{np.mean(some):.0%}; off by {np.median(off):.3f} deg and {1e3 * np.median(apart):.1f} mm in the median"
    )


def compare_errors(table: Table, height: float, spacing: float, draws: int, seed: int) -> None:
    solver, locator = solver_of(table), Locator(table)
    locator.warm_up()
    squares, places = draw_places(table, height, spacing, draws, np.random.default_rng([seed, 2]))
    drops = drops_at(places, solver, table.site.stations)
    print(
        "                within 1 m        median error  RMS error of squares: measured / forecast    rank    squares"
    )
    print("angles  times  forecast measured  fc.    meas.   of all   median    10 %     90 %         correlation")
    for degrees, timing in CASES:
        angle = float(np.deg2rad(degrees))
        noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=0.5 if timing != "none" else None)
        plan = forecast(
            table, PlanSettings(height=height, noise=noise, timing=timing, spacing=spacing, draws=draws, seed=seed)
        )
        found = locate_drops(locator, drops, noise, timing=timing, rng=np.random.default_rng([seed, 3]))
        error = matching(plan, squares.reshape(-1, draws, 3)[:, 0], found.error.reshape(-1, draws))
        known = np.isfinite(plan.error) & np.isfinite(error).all(axis=1)
        measured, predicted = np.sqrt(np.square(error[known]).mean(axis=1)), plan.error[known]
        tenth, middle, most = np.quantile(measured / predicted, [0.1, 0.5, 0.9])
        whole = np.sqrt(np.square(measured).mean() / np.square(predicted).mean())
        print(
            f"{degrees:5.2f}   {timing:5} {plan.within.mean():8.1%} {np.mean(error < 1.0):8.1%}"
            f" {np.median(predicted):7.3f} {np.median(measured):7.3f}"
            f" {whole:9.2f} {middle:8.2f} {tenth:8.2f} {most:8.2f}"
            f" {spearmanr(measured, predicted).statistic:12.2f} {known.sum():10} of {len(plan)}",
            flush=True,
        )


def matching(plan: PlanMap, middles: NDArray[np.float64], error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Errors measured in the squares of a map; infinite where the draws found too little of a square free."""
    places = {tuple(middle): n for n, middle in enumerate(middles.tolist())}
    rows = [places.get(tuple(middle), -1) for middle in plan.position.tolist()]
    return np.array([error[row] if row >= 0 else np.full(error.shape[1], np.inf) for row in rows])


if __name__ == "__main__":
    main()
