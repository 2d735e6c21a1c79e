"""Searches for reports that take long, and checks the bounds: the cost estimate, the work, the time limit.

A seeded search over reports of all kinds maximises processor time. Printed are the costliest reports, how often and by
which factor the estimate that separates quick from slow reports was below the time, and how long fixes ran beyond their
limit. Exits with an error if a bound does not hold.
"""

import math
import sys
import threading
from collections import Counter
from time import perf_counter, thread_time

import numpy as np

from benchmarks.common.costly_reports import climb
from benchmarks.common.example_table import open_or_build, table_parser
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.stopping import FixStoppedError, Stop
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.locator import Locator


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--steps", type=int, default=2000, help="reports to try")
    parser.add_argument("--seconds", type=float, default=600.0, help="when to end earlier")
    parser.add_argument("--limit", type=float, default=1.0, help="time limit of a fix, s")
    parser.add_argument("--slack", type=float, default=0.25, help="how long after its limit a fix may go on, s")
    parser.add_argument("--factor", type=float, default=4.0, help="by which an estimate may be below the time")
    options = parser.parse_args()
    quick = ServiceSettings.quick_fix_seconds
    with open_or_build(options.table) as table:
        locator = Locator(table)
        locator.warm_up()
        late: list[float] = []
        below: list[float] = []
        stopped = 0

        def cost(report: Report) -> float:
            """Processor time of a report, that until the limit for one that is stopped."""
            nonlocal stopped
            estimate = locator.seconds(report)
            stop = Stop()
            timer = threading.Timer(options.limit, stop.set)
            timer.start()
            begin, clock = thread_time(), perf_counter()
            try:
                locator.locate(report, stop=stop)
            except FixStoppedError:
                stopped += 1
                late.append(perf_counter() - clock - options.limit)
            finally:
                timer.cancel()
            seconds = thread_time() - begin
            if math.isfinite(estimate):
                # What is slow by its estimate is told apart well enough, whatever it takes.
                below.append(seconds / estimate if estimate <= quick else min(seconds / estimate, 1.0))
            return seconds

        stations = [station.id for station in table.site.stations]
        rng = np.random.default_rng(options.seed)
        tried = list(climb(cost, stations, rng, steps=options.steps, seconds=options.seconds))
    print(f"{len(tried)} reports of {len(stations)} stations, {stopped} stopped at {options.limit:g} s")
    for report, seconds in sorted(tried, key=lambda one: -one[1])[:5]:
        kinds = Counter(type(measurement).__name__ for measurement in report.measurements)
        print(f"{seconds:8.3f} s  {', '.join(f'{count} {kind}' for kind, count in kinds.items())}")
    factor, latest = max(below, default=0.0), max(late, default=0.0)
    print(f"quick by its estimate: at most {factor:.2f} times the estimate; after its limit: at most {latest:.3f} s")
    if factor > options.factor or latest > options.slack:
        sys.exit("a bound does not hold")


if __name__ == "__main__":
    main()
