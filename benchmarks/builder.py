"""The builder's speed, as ratios: the ray stage against bare Embree, the fit by tubes against the fit by em.

Everything runs on one thread and is given as the median of five runs of processor time; ``--build`` builds the whole
hall as well, with all cores.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from rayfix.example.files import write_example
from rayfix_offline import trace
from rayfix_offline.em import ExpectationMaximisation, fit_em
from rayfix_offline.engine import RayEngine
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.trace import StationTrace, trace_station
from rayfix_offline.tubes import TubeFit, fit_tubes
from rayfix_offline.twin import Twin, prepare_twin
from rayfix_tables.mixture import FIELD_DTYPES, FIELD_SHAPES

RUNS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=256, help="cells that tubes fit in a run (default 256)")
    parser.add_argument("--em-cells", type=int, default=8, help="cells that em fits in a run (default 8)")
    parser.add_argument("--build", action="store_true", help="build the whole hall, too")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        site_path = write_example(folder)
        site = read_site(site_path)
        twin = prepare_twin(site, site_path.parent)
        print(f"the bundled hall, {len(twin.scene.faces)} triangles; medians of {RUNS} runs on one thread")
        measure_rays(site, twin)
        traced = trace_station(site.stations[0], site, twin)
        measure_fits(traced, options.cells, options.em_cells, np.random.default_rng(options.seed))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(f"peak memory so far: {peak / 1024:.0f} MiB")
        if options.build:
            measure_build(site_path)


class RecordingEngine:
    """Passes rays on to an engine and keeps them."""

    def __init__(self, engine: RayEngine) -> None:
        self.engine = engine
        self.queries: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []

    def first_hit(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.int32]:
        """See :meth:`RayEngine.first_hit`."""
        self.queries.append((np.array(origins), np.array(directions)))
        return self.engine.first_hit(origins, directions)


def measure_rays(site: SiteFile, twin: Twin) -> None:
    """Time the launch of one station as a build does it, and Embree alone on the very rays of that launch."""
    with mock.patch.object(trace, "launch", wraps=trace.launch) as called:
        trace_station(site.stations[0], site, twin)
    positional, named = called.call_args
    recorder = RecordingEngine(twin.engine)
    segments = trace.launch(*positional, **{**named, "engine": recorder})
    num_rays = len(segments.sequence)
    num_segments = int(np.count_nonzero(segments.sequence >= 0))
    stage = median_seconds(lambda: trace.launch(*positional, **named))
    bare = median_seconds(lambda: [twin.engine.first_hit(*query) for query in recorder.queries])
    direct = median_seconds(lambda: twin.engine.first_hit(*recorder.queries[0]))
    whole = median_seconds(lambda: trace_station(site.stations[0], site, twin))
    print(
        f"rays: {num_rays} with up to {site.propagation.max_reflections} reflections, {num_segments} segments\n"
        f"  ray stage            {num_segments / stage / 1e6:6.2f} million segments/s, "
        f"{num_rays / stage / 1e6:.2f} million rays/s\n"
        f"  Embree, same rays    {num_segments / bare / 1e6:6.2f} million first hits/s\n"
        f"  Embree, direct rays  {num_rays / direct / 1e6:6.2f} million first hits/s\n"
        f"  ray stage / Embree   {bare / stage:6.2f} of its rate on the same rays, "
        f"{num_segments / stage * direct / num_rays:.2f} of that on direct rays\n"
        f"  the launch takes {stage / whole:.0%} of the {whole:.2f} s in which a station is traced and cut into pieces"
    )


def measure_fits(traced: StationTrace, num_cells: int, num_em_cells: int, rng: np.random.Generator) -> None:
    """Time both fits on the same kind of cells, window by window."""
    component = sum(
        int(np.prod(shape, dtype=int)) * np.dtype(FIELD_DTYPES[name]).itemsize for name, shape in FIELD_SHAPES.items()
    )
    em = ExpectationMaximisation(num_components=(16,))
    print("fits:   window   tubes [cells/s]   em, K = 16 [cells/s]   ratio   components   bytes per cell, tubes")
    for level in traced.levels:
        numbers = rng.choice(level.grid.num_cells, min(num_cells, level.grid.num_cells), replace=False)
        centres = level.grid.centres[numbers]
        counts, _, _ = fit_tubes(centres, level, TubeFit())
        tubes = median_seconds(lambda lv=level, c=centres: fit_tubes(c, lv, TubeFit())) / len(numbers)
        some, chosen = centres[:num_em_cells], numbers[:num_em_cells]
        slow = median_seconds(lambda lv=level, c=some, n=chosen: fit_em(c, n, lv, em)) / len(some)
        print(
            f"  {np.rad2deg(level.window):8.2f} deg {1.0 / tubes:15.0f} {1.0 / slow:22.1f} {slow / tubes:7.0f} "
            f"{counts.mean():12.1f} {counts.mean() * component:14.0f}"
        )


def measure_build(site_path: Path) -> None:
    """Build the hall in a process of its own."""
    table = site_path.with_name("hall.h5")
    command = [sys.executable, "-m", "rayfix", "build", str(site_path), "-o", str(table), "--no-progress", "--json"]
    begin = time.perf_counter()
    summary = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    seconds = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    cells = sum(station["num_cells"] for station in summary["stations"])
    print(
        f"build: {seconds:.0f} s for {cells} cells of {len(summary['stations'])} stations on all cores, "
        f"{cells / seconds:.0f} cells/s; {table.stat().st_size / 1e6:.0f} MB, "
        f"{table.stat().st_size / cells:.0f} bytes per cell; peak memory {peak / 1024:.0f} MiB"
    )


def median_seconds(run: Callable[[], object]) -> float:
    """Median processor time of a call, once it is warm."""
    run()
    times = []
    for _ in range(RUNS):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return float(np.median(times))


if __name__ == "__main__":
    main()
