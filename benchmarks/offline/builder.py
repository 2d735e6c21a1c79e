"""The builder's speed, as ratios: the ray stage relative to Embree alone, the fit by tubes relative to the fit by em.

Both sides run on one thread; results are medians of five runs of processor time. The sums of wide cells run once.
``--build`` also builds the whole hall on all cores: once with nothing compiled yet, and once again. The machine's load
is printed too.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from benchmarks.common.held_out import COMPONENT_BYTES
from rayfix.example.files import write_example
from rayfix_offline.fit.cells import assemble_level, fit_cells, widen_cells
from rayfix_offline.fit.em import fit_em
from rayfix_offline.fit.moments import gather_groups, gathered_rays, new_rows
from rayfix_offline.fit.settings import CoarseFit, ExpectationMaximisation, RayFit, TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.rays.launch import launch
from rayfix_offline.rays.pathprior import fill_path_prior
from rayfix_offline.rays.pieces import cut_pieces
from rayfix_offline.rays.rays import RaySet, sample_rays
from rayfix_offline.rays.segments import Segments
from rayfix_offline.rays.settings import RaySettings
from rayfix_offline.rays.trace import LevelRays, StationTrace, level_grid, scene_walls, trace_station
from rayfix_offline.scene.engine import RayEngine
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import Twin, prepare_twin

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
        seconds = measure_rays(site, twin)
        traced = trace_station(site.stations[0], site, twin)
        gather = measure_fits(traced, options.cells, options.em_cells, np.random.default_rng(options.seed))
        seconds |= measure_levels(traced, site, gather)
        print_stages(seconds)
        if options.build:
            measure_build(site_path)


class RecordingEngine:
    """Passes rays on to an engine and keeps them."""

    def __init__(self, engine: RayEngine) -> None:
        self.engine = engine
        self.queries: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []

    def first_hit(self, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> NDArray[np.int32]:
        """See :meth:`RayEngine.first_hit`."""
        self.queries.append((np.array(origins, np.float32), np.array(directions, np.float32)))
        return self.engine.first_hit(origins, directions)


def measure_rays(site: SiteFile, twin: Twin) -> dict[str, float]:
    """Time the ray stage of one station, and Embree alone on the very rays of that launch.

    The stage is all between the station's position and its segments: directions are drawn, rays intersected, hits
    refined, mirrored and booked by sequence and gain. Embree alone gets the same rays in arrays of its own precision,
    one batch for each number of reflections, and looks for the triangle that each hits first. Every segment, the
    reflected ones too, counts as a ray.
    """
    propagation = site.propagation
    spacing = float(np.deg2rad(site.table.windows_deg[0])) / RaySettings.rays_per_window
    exponent = propagation.path_prior_exponent

    def run_stage(engine: RayEngine = twin.engine) -> tuple[RaySet, Segments]:
        rays = sample_rays(spacing, np.random.default_rng(1))
        segments = launch(
            np.array(site.stations[0].position_m),
            rays.directions,
            engine=engine,
            planes=twin.planes,
            walls=scene_walls(site, twin),
            bounds=twin.scene.bounds,
            max_reflections=propagation.max_reflections,
            max_path_length=propagation.max_path_length_m,
        )
        return rays, segments

    recorder = RecordingEngine(twin.engine)
    rays, segments = run_stage(recorder)
    num_segments = sum(len(origins) for origins, _ in recorder.queries)
    scene = EmbreeScene()
    mesh = TriangleMesh(scene, twin.scene.triangles.astype(np.float32))
    bare = median_seconds(lambda: [scene.run(*query) for query in recorder.queries])
    del mesh
    stage = median_seconds(run_stage)
    prior = fill_path_prior(
        rays,
        segments,
        twin.free_space,
        exponent=exponent,
        refinement=RaySettings.prior_refinement,
    )
    print(
        f"rays: {len(rays)} with up to {propagation.max_reflections} reflections, {num_segments} segments\n"
        f"  ray stage          {num_segments / stage / 1e6:6.2f} million rays/s\n"
        f"  Embree alone       {num_segments / bare / 1e6:6.2f} million rays/s\n"
        f"  stage / Embree     {bare / stage:6.2f}"
    )
    return {
        "rays": stage,
        "path prior": median_seconds(
            lambda: fill_path_prior(
                rays,
                segments,
                twin.free_space,
                exponent=exponent,
                refinement=RaySettings.prior_refinement,
            )
        ),
        "pieces": median_seconds(
            lambda: cut_pieces(
                rays,
                segments,
                prior,
                exponent=exponent,
                kind=propagation.path_prior,
                slice_ratio=RaySettings.slice_ratio,
            )
        ),
    }


def measure_fits(traced: StationTrace, num_cells: int, num_em_cells: int, rng: np.random.Generator) -> float:
    """Time both fits of the finest window, and return the seconds in which tubes' groups are gathered in all cells."""
    level = traced.finest
    em = ExpectationMaximisation(num_components=(16,))
    numbers = scattered_blocks(level.grid.num_cells, num_cells, rng)
    centres = level.grid.centres[numbers]
    counts, _, _, _ = fit_tubes(centres, level, TubeFit())
    tubes = median_seconds(lambda: fit_tubes(centres, level, TubeFit())) / len(numbers)
    some = rng.permutation(len(numbers))[:num_em_cells]
    slow = median_seconds(lambda: fit_em(centres[some], numbers[some], level, em)) / len(some)
    print(
        f"fits of {np.rad2deg(level.window):g} deg cells:\n"
        f"  tubes              {1.0 / tubes:6.0f} cells/s, {counts.mean():.1f} components, "
        f"{counts.mean() * COMPONENT_BYTES:.0f} bytes per cell\n"
        f"  em, 16 components  {1.0 / slow:6.1f} cells/s\n"
        f"  tubes / em         {slow / tubes:6.0f}"
    )
    return median_seconds(lambda: gather_cells(centres, level)) / len(numbers) * level.grid.num_cells


def measure_levels(traced: StationTrace, site: SiteFile, gather: float) -> dict[str, float]:
    """Make all cells of a station once, level by level; the wide ones are sums of finer ones."""
    window = traced.finest.window
    begin = time.thread_time()
    parts = [
        fit_cells(cells, traced.finest, TubeFit())
        for cells in np.array_split(np.arange(traced.finest.grid.num_cells), traced.finest.grid.num_cells // 256)
    ]
    finer = assemble_level(window, traced.finest.grid, parts)
    name = f"{np.rad2deg(window):g} deg"
    seconds = {f"{name}: gather": gather, f"{name}: merge, the rest": time.thread_time() - begin - gather}
    print("sums of cells:")
    for window in np.deg2rad(site.table.windows_deg[1:]).tolist():
        grid = level_grid(window)
        widen_cells(np.arange(1), window, grid, finer, np.zeros(finer.grid.num_cells, np.float32), CoarseFit())
        begin = time.thread_time()
        wide = widen_cells(
            np.arange(grid.num_cells), window, grid, finer, np.zeros(finer.grid.num_cells, np.float32), CoarseFit()
        )
        taken = time.thread_time() - begin
        name = f"{np.rad2deg(window):g} deg"
        seconds[f"{name}: sums of cells"] = taken
        components = wide.counts.mean()
        print(
            f"  {name:18} {grid.num_cells / taken:6.0f} cells/s, {components:.1f} components, "
            f"{components * COMPONENT_BYTES:.0f} bytes per cell"
        )
        finer = assemble_level(window, grid, [wide])
    return seconds


def scattered_blocks(num_cells: int, most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose cells from all over a level, in rows of 16 neighbours, which share rays as in a build."""
    rows = np.arange(0, num_cells - 15, 16)
    chosen = rng.permutation(len(rows))[: max(1, most // 16)]
    return (np.sort(rows[chosen])[:, None] + np.arange(16)).reshape(-1)


def gather_cells(centres: NDArray[np.float64], level: LevelRays) -> None:
    """Gather the groups of cells, and no more."""
    gathered = gathered_rays(level.rays, level.pieces, level.sequences)
    num_slices, rows = level.pieces.num_slices, new_rows(len(level.sequences.images))
    for centre in centres:
        gather_groups(*centre, level.window, RayFit.cutoff, gathered, num_slices, rows)


def print_stages(seconds: dict[str, float]) -> None:
    """Print what the stages of one station take."""
    total = sum(seconds.values())
    print(f"stages of one station, {total:.2f} s of one thread:")
    for name, value in seconds.items():
        print(f"  {name:28} {value:6.2f} s {value / total:6.1%}")


def measure_build(site_path: Path) -> None:
    """Build the hall in processes of their own, the first of which compiles all kernels."""
    with tempfile.TemporaryDirectory() as cache:
        for name in ("nothing compiled", "compiled"):
            table = site_path.with_name("hall.h5")
            table.unlink(missing_ok=True)
            command = [sys.executable, "-m", "rayfix", "build", str(site_path), "-o", str(table), "--no-progress"]
            load = os.getloadavg()[0]
            before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            done = subprocess.run(
                [*command, "--json"],
                check=True,
                capture_output=True,
                text=True,
                env={**os.environ, "NUMBA_CACHE_DIR": cache},
            )
            seconds = time.perf_counter() - begin
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            worked = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            summary = json.loads(done.stdout)
            cells = sum(station["num_cells"] for station in summary["stations"])
            size = table.stat().st_size
            print(
                f"build, {name}: {seconds:.1f} s on {os.cpu_count()} cores (load {load:.1f} before), "
                f"{worked:.1f} s of processor time; "
                f"{cells} cells of {len(summary['stations'])} stations, {cells / seconds:.0f} cells/s; "
                f"{size / 1e6:.0f} MB, {size / cells:.0f} bytes per cell; "
                f"peak memory {summary['peak_bytes'] / 1e6:.0f} MB"
            )


def median_seconds(run: Callable[[], object]) -> float:
    """Median processor time of a call, once it is warm."""
    run()
    times = []
    for _ in range(RUNS):
        begin = time.thread_time()
        run()
        times.append(time.thread_time() - begin)
    return float(np.median(times))


if __name__ == "__main__":
    main()
