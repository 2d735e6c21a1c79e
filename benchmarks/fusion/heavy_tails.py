"""Benefit of stating heavy-tailed errors when errors have heavy tails, loss when they do not, and computing time.

The same drops, paths and draws each time: errors of angles and ranges are Gaussian, contaminated (one in ten of three
standard deviations) or Student's with three degrees of freedom, scaled to the same interquartile range; reports state
them as Gaussian, as heavy-tailed, or as Gaussian of the whole error's standard deviation. Accuracy in metres, time in
milliseconds; ``share`` is the fraction of true positions within the stated 68 % ellipsoid.
"""

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import Drop, drop_positions, drops_at, solver_of
from rayfix_evaluation.drops.simulate import fold_direction, select_path
from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    HEAVY_TAILED,
    Angle,
    ErrorModel,
    Measurement,
    Range,
    Report,
)
from rayfix_service.locator import Locator

RANGE_STDEV = 0.5  # m
CHI2_68 = 3.506  # of three degrees of freedom
QUARTILE = {"gaussian": 0.6745, "student": 0.7649}  # upper quartiles: of the normal, and of Student's t_3

Draw = Callable[[np.random.Generator, int], NDArray[np.float64]]


def gaussian(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    return rng.standard_normal(count)


def contaminated(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    # The two angles of a direction go astray together, as a time does on its own.
    wide = rng.random(2) < HEAVY_TAILED.tail_share
    scale = np.where(wide, HEAVY_TAILED.tail_scale, 1.0)[[0, 0, 1]]
    return np.asarray(scale * rng.standard_normal(count))


def student(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    divisor = np.sqrt(rng.chisquare(3.0, 2) / 3.0)[[0, 0, 1]]
    return np.asarray(rng.standard_normal(count) / divisor * QUARTILE["gaussian"] / QUARTILE["student"])


def report_of(
    drop: Drop, draw: Draw, degrees: float, model: ErrorModel, widen: float, rng: np.random.Generator, timed: bool
) -> Report:
    measurements: list[Measurement] = []
    stdev = np.deg2rad(degrees)
    for name, paths in drop.paths.items():
        n = select_path(paths, "strongest", rng)
        errors = draw(rng, 3)
        azimuth, zenith = fold_direction(paths.azimuth[n] + stdev * errors[0], paths.zenith[n] + stdev * errors[1])
        angle = Angle(
            station_id=name, azimuth=azimuth, zenith=zenith, azimuth_stdev=widen * stdev, zenith_stdev=widen * stdev
        )
        measurements.append(replace(angle, error_model=model))
        if timed:
            length = float(paths.path_length[n] + RANGE_STDEV * errors[2])
            measurements.append(
                Range(station_id=name, path_length=length, stdev=widen * RANGE_STDEV, error_model=model)
            )
    return Report(measurements=tuple(measurements))


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--drops", type=int, default=150)
    options = parser.parse_args()
    whole = float(np.sqrt(1.0 + HEAVY_TAILED.tail_share * (HEAVY_TAILED.tail_scale**2 - 1.0)))
    stated = {"gaussian": (GAUSSIAN, 1.0), "heavy": (HEAVY_TAILED, 1.0), "widened": (GAUSSIAN, whole)}
    with open_or_build(options.table) as table:
        places = drop_positions(table, options.drops, np.random.default_rng([options.seed, 0]))
        drops = [drop for drop in drops_at(places, solver_of(table), table.site.stations) if len(drop.paths) > 1]
        locator = Locator(table)
        locator.warm_up()
        for degrees, timed in ((1.0, True), (4.0, True), (4.0, False)):
            for draw in (gaussian, contaminated, student):
                for label, (model, widen) in stated.items():
                    errors, seconds, inside = [], [], []
                    for n, drop in enumerate(drops):
                        rng = np.random.default_rng([options.seed, 1, n])
                        report = report_of(drop, draw, degrees, model, widen, rng, timed)
                        begin = perf_counter()
                        fix = locator.locate(report)
                        seconds.append(perf_counter() - begin)
                        if fix.position is None or fix.covariance is None:
                            errors.append(np.inf)
                            continue
                        apart = drop.position - fix.position
                        errors.append(float(np.linalg.norm(apart)))
                        inside.append(apart @ np.linalg.solve(fix.covariance, apart) < CHI2_68)
                    half, most = np.percentile(errors, [50, 90])
                    print(
                        f"{degrees:g} deg{' + PT' if timed else '':5s} errors {draw.__name__:12s} stated {label:8s} "
                        f"50 % {half:.2f}  90 % {most:.2f}  share {np.mean(inside):.2f}  "
                        f"{1e3 * float(np.median(seconds)):.2f} ms",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
