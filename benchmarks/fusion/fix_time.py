"""Time of a fix on one thread, compared with the paper's method run online on the same reports.

Both locate the same reports of drops that are audible to every station of the table; each station reports its strongest
path. The paper's method launches its rays, selects, fits and multiplies for each report (docs/paper-method.md). It is
slow and gets only the first few reports; errors are given for these, for both methods. Times are processor time, which
on an idle machine equals wall time. Fixes per second are by wall time, for twenty times all reports in one call, in one
and in two processes.
"""

from collections.abc import Callable
from time import perf_counter, process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_evaluation.drops.accuracy import Drop, drop_uniformly
from rayfix_evaluation.drops.simulate import Noise, Timing, simulate_report
from rayfix_evaluation.paper.locate import PaperLocator
from rayfix_service.batch import locate_batch
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.locator import Locator
from rayfix_service.wire import parse_report

CASES: list[tuple[str, Timing, bool]] = [
    ("AoA + PT", "pt", True),
    ("AoA + ToA", "toa", True),
    ("AoA + TDoA", "tdoa", True),
    ("AoA", "none", True),
    ("PT", "pt", False),
    ("TDoA", "tdoa", False),
]
"""What is measured: label, times, and whether angles are."""

DEGREES, RANGE_STDEV = 1.0, 0.5


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--reports", type=int, default=200, help="of each kind")
    parser.add_argument("--paper-reports", type=int, default=20, help="of each kind, for the paper's method")
    options = parser.parse_args()
    with open_or_build(options.table) as table, threadpool_limits(limits=1):
        drops = heard_by_all(table, options.reports, options.seed)
        locator, paper = Locator(table), PaperLocator.of_table(table)
        locator.warm_up()
        print(f"{len(drops)} reports of {len(table.site.stations)} stations; {DEGREES:g} deg, {RANGE_STDEV:g} m")
        print("             rayfix: time [ms]  error [m]         paper: time [ms]  error [m]      ratio  fixes/s, jobs")
        print("measured        50 %    90 %     50 %    90 %        50 %     50 %    90 %   of times       1       2")
        for label, timing, angles in CASES:
            reports = [report_of(drop, timing, angles, n, options.seed) for n, drop in enumerate(drops)]
            ours, our_errors = measure(locator.locate, reports, drops, lambda fix: fix.position)
            few = reports[: options.paper_reports]
            rng = np.random.default_rng(options.seed)
            theirs, their_errors = measure(lambda r, rng=rng: paper.locate(r, rng), few, drops, lambda place: place)
            errors = columns(our_errors[: len(few)], 3), columns(their_errors, 3)
            ratio = np.median(theirs) / np.median(ours)
            rayfix_columns = f"{columns(1e3 * ours)} {errors[0]}"
            paper_columns = f"{1e3 * np.median(theirs):9.0f}  {errors[1]}  {ratio:8.1f}"
            batches = f"{throughput(locator, reports, 1):7.0f} {throughput(locator, reports, 2):7.0f}"
            print(f"{label:12} {rayfix_columns}  {paper_columns}  {batches}", flush=True)


def heard_by_all(table: Any, count: int, seed: int) -> list[Drop]:
    """Up to ``count`` drops that all stations hear."""
    drops = drop_uniformly(table, 3 * count, np.random.default_rng([seed, 0]))
    return [drop for drop in drops if len(drop.paths) == len(table.site.stations)][:count]


def report_of(drop: Drop, timing: Timing, angles: bool, n: int, seed: int) -> Report:
    angle = float(np.deg2rad(DEGREES))
    noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=RANGE_STDEV)
    report = simulate_report(drop.paths, noise, rng=np.random.default_rng([seed, 1, n]), timing=timing)
    report["measurements"] = [m for m in report["measurements"] if angles or m["type"] != "aoa"]
    return parse_report(report)


def measure(
    locate: Callable[[Report], Any],
    reports: list[Report],
    drops: list[Drop],
    position_of: Callable[[Any], NDArray[np.float64] | None],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure the processor time of each report [s], and the error of what comes back [m], inf for nothing."""
    locate(reports[0])
    seconds, errors = [], []
    for report, drop in zip(reports, drops, strict=False):
        begin = process_time()
        answer = locate(report)
        seconds.append(process_time() - begin)
        position = position_of(answer)
        errors.append(np.inf if position is None else float(np.linalg.norm(position - drop.position)))
    return np.array(seconds), np.array(errors)


def throughput(locator: Locator, reports: list[Report], jobs: int) -> float:
    """Measure the fixes per second of many reports in one call."""
    many = 20 * reports
    locate_batch(locator, many[:1000], jobs=jobs)
    begin = perf_counter()
    locate_batch(locator, many, jobs=jobs)
    return len(many) / (perf_counter() - begin)


def columns(values: NDArray[np.float64], digits: int = 2) -> str:
    low, high = np.percentile(values, [50, 90], method="inverted_cdf")
    return f"{low:7.{digits}f} {high:7.{digits}f}"


if __name__ == "__main__":
    main()
