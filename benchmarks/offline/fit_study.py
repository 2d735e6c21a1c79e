"""Effect of the fit's settings at the finest window: held-out log-likelihood, time and size, for tubes and for em.

The hall is the bundled one; the warehouse is read from ``../shared/data`` and left out if that is missing. Results of a
site are added to ``results.json``; other sites in it are kept, which permits one run per site. docs/fit-study.md
discusses the results; ``wide_study.py`` is for the wide windows.
"""

import argparse
import json
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.held_out import REFERENCE_RATIO, log_densities, processor_seconds, trace_sliced
from benchmarks.common.warehouse import WAREHOUSE_SCENE, write_warehouse
from benchmarks.offline.fit_report import plot, tables, verdict
from benchmarks.offline.fit_settings import SETTINGS, Setting
from rayfix.example.files import write_example
from rayfix_offline.fit.em import fit_em, sample_points
from rayfix_offline.fit.settings import TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.job.plan import BLOCK_CELLS
from rayfix_offline.rays.trace import LevelRays, level_grid
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import Twin, prepare_twin
from rayfix_tables.compact.tubes import compacted

HELD_OUT_POINTS = 1000

SWEPT_STATIONS = 2
"""Stations whose cells the settings are varied on."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A chosen cell of the finest level."""

    station: int
    number: int


@dataclass(frozen=True, kw_only=True)
class Score:
    """What came of one cell under one setting.

    Attributes
    ----------
    joint : float, nats
        Mean held-out log density of (length [m], angles [rad], position [m]).
    position : float, nats
        The same of the position given length and angles.
    seconds : float
        Processor time of the fit; the mean over the cells that were fitted together.
    """

    setting: str
    cell: Cell
    joint: float
    position: float
    seconds: float
    components: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sites", nargs="+", choices=["hall", "warehouse"], default=["hall", "warehouse"])
    parser.add_argument("--cells", type=int, default=200, help="random cells of each site (default 200)")
    parser.add_argument("--some", type=int, default=60, help="of these, cells for the tubes' settings (default 60)")
    parser.add_argument("--few", type=int, default=20, help="of these, cells for the slower kinds of em (default 20)")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--output", type=Path, default=Path("fit-study"), metavar="DIR")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    stored = options.output / "results.json"
    results: dict[str, Any] = json.loads(stored.read_text(encoding="utf-8")) if stored.exists() else {}
    for name in options.sites:
        with tempfile.TemporaryDirectory() as folder:
            site_path = write_example(folder) if name == "hall" else write_warehouse(Path(folder))
            if site_path is None:
                print(f"{name}: skipped, {WAREHOUSE_SCENE.name} is not under ../shared/data/warehouse", flush=True)
                continue
            site = read_site(site_path)
            twin = prepare_twin(site, site_path.parent)
        cells = draw_cells(site, options.cells, np.random.default_rng(options.seed))
        print(f"{name}: {len(cells)} cells of {len(site.stations)} stations, seed {options.seed}", flush=True)
        scores = study(site, twin, cells, some=options.some, few=options.few, seed=options.seed)
        results[name] = [asdict(score) for score in scores]
        stored.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    if not results:
        return
    markdown = "\n".join(table for name in results for table in (f"### {name}\n", *tables(results[name]), ""))
    (options.output / "results.md").write_text(markdown, encoding="utf-8")
    print(markdown)
    for name in results:
        print(verdict(name, results[name]))
    for suffix in ("svg", "png"):
        plot(results, options.output, suffix)


def draw_cells(site: SiteFile, count: int, rng: np.random.Generator) -> list[Cell]:
    """Draw cells of the finest level of all stations."""
    size = level_grid(float(np.deg2rad(site.table.windows_deg[0]))).num_cells
    chosen = rng.choice(len(site.stations) * size, count, replace=False)
    return [Cell(station=int(n // size), number=int(n % size)) for n in chosen]


def study(site: SiteFile, twin: Twin, cells: list[Cell], *, some: int, few: int, seed: int) -> list[Score]:
    """Fit the cells; those for the settings come from the first two stations, which saves tracing the others again."""
    subset = [cell for cell in cells if cell.station < SWEPT_STATIONS]
    fitted = {"all": set(cells), "some": set(subset[:some]), "few": set(subset[:few])}
    scores: list[Score] = []
    for s, station in enumerate(site.stations):
        reference = trace_sliced(s, site, twin, REFERENCE_RATIO)
        held_out = {}
        for cell in cells:
            if cell.station == s:
                rng = np.random.default_rng([seed, s, cell.number])
                points, _, _ = sample_points(reference.grid.centres[cell.number], reference, HELD_OUT_POINTS, rng)
                if len(points):
                    held_out[cell] = points
        traces: dict[float, LevelRays] = {}
        for setting in SETTINGS:
            chosen = {cell: points for cell, points in held_out.items() if cell in fitted[setting.cells]}
            if not chosen:
                continue
            if setting.slice_ratio not in traces:
                traces[setting.slice_ratio] = trace_sliced(s, site, twin, setting.slice_ratio)
            scores += score_block(setting, traces[setting.slice_ratio], chosen)
        print(f"  {station.id} done", flush=True)
    return scores


def score_block(setting: Setting, level: LevelRays, held_out: dict[Cell, NDArray[np.float64]]) -> list[Score]:
    """Fit cells of one station together, as a build does, and judge each."""
    numbers = np.array([cell.number for cell in held_out])
    centres = level.grid.centres[numbers]
    fit = setting.fit
    if isinstance(fit, TubeFit):
        counts, _, mixture, _ = fit_tubes(centres, level, fit)
        # A call has a fixed cost, which a build spreads over a block.
        fixed = processor_seconds(lambda: fit_tubes(centres[:0], level, fit))
        varying = processor_seconds(lambda: fit_tubes(centres, level, fit)) - fixed
        seconds = varying / len(numbers) + fixed / BLOCK_CELLS
    else:
        begin = time.thread_time()
        counts, _, mixture, _ = fit_em(centres, numbers, level, fit)
        seconds = (time.thread_time() - begin) / len(numbers)
    ends, stored = np.cumsum(counts), compacted(mixture, level.window)
    scores = []
    for (cell, points), count, end in zip(held_out.items(), counts, ends, strict=True):
        joint, position = log_densities(stored[int(end - count) : int(end)], points)
        scores.append(
            Score(
                setting=setting.name,
                cell=cell,
                joint=float(joint.mean()),
                position=float(position.mean()),
                seconds=seconds,
                components=int(count),
            )
        )
    return scores


if __name__ == "__main__":
    main()
