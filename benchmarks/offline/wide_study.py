"""Effect of the settings of the sums at the wide windows: held-out log-likelihood, size, time, and errors of fixes.

All cells of the bundled hall's wide windows are made with each setting, level by level, from the finest level of one
table. They are compared with cells fitted directly to rays at the wide window: by tubes, and by em for the evaluated
cells. Held-out points have the smallest measurement noise for which the window is looked up. docs/fit-study.md
discusses the results.
"""

import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from benchmarks.common.example_table import open_or_build, table_parser
from benchmarks.common.held_out import (
    COMPONENT_BYTES,
    REFERENCE_RATIO,
    log_density_as_measured,
    trace_sliced,
    trace_window,
)
from rayfix.example.files import write_example
from rayfix_evaluation.drops.accuracy import Drop, drop_uniformly, locate_drops
from rayfix_evaluation.drops.simulate import Noise
from rayfix_offline.fit.em import fit_em, sample_points
from rayfix_offline.fit.settings import CoarseFit, ExpectationMaximisation, TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.fit.wide_windows import sum_cells
from rayfix_offline.rays.trace import LevelRays, level_grid
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_service.locator import Locator
from rayfix_tables.compact.tubes import compacted
from rayfix_tables.level import COMPACT_UNBALANCED, WINDOW_RATIO, Level
from rayfix_tables.mixture import TubeMixture
from rayfix_tables.table import Table

HELD_OUT_POINTS = 2000

DEFAULT = "sums, default"

SUMS: dict[str, CoarseFit] = {
    DEFAULT: CoarseFit(),
    "max_divergence 0.003": CoarseFit(max_divergence=3e-3),
    "max_divergence 0.03": CoarseFit(max_divergence=3e-2),
    "noise_share 0.25": CoarseFit(noise_share=0.25),
    "noise_share 1": CoarseFit(noise_share=1.0),
}

DIRECT = "tubes, fitted directly"

EM = "em, K = 16, fitted directly"

CASES_DEG = (2.0, 5.0, 10.0)
"""Deviations of the angles of reports."""

SIZES = (2000, 5000, 10000, 20000, 50000)
"""Ticks of the plot, bytes."""

RANGE_STDEV = 0.5
"""Deviation of their propagation times, m."""


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """Chosen cells of one wide window of one station, under one setting.

    Attributes
    ----------
    cells : list of TubeMixture
    seconds : float
        Processor time of a cell, mean over the whole level.
    components : float
        Components of a cell, mean over the whole level.
    """

    cells: list[TubeMixture]
    seconds: float
    components: float


def main() -> None:
    parser = table_parser(__doc__, seed=40961)
    parser.add_argument("--cells", type=int, default=12, help="cells of a station and window to judge (default 12)")
    parser.add_argument("--drops", type=int, default=120)
    parser.add_argument("--output", type=Path, default=Path("fit-study"), metavar="DIR")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        site_path = write_example(folder)
        site = read_site(site_path)
        twin = prepare_twin(site, site_path.parent)
    with open_or_build(options.table) as table:
        drops = drop_uniformly(table, options.drops, np.random.default_rng([options.seed, 0]))
        made: dict[str, dict[str, tuple[Level, ...]]] = {name: {} for name in (*SUMS, DIRECT)}
        fitted: dict[tuple[str, float], list[Fitted]] = {}
        scores: dict[tuple[str, float], list[float]] = {}
        for s, section in enumerate(site.stations):
            finest = table.parts[section.id].levels[0]
            direct = [trace_window(s, site, twin, degrees) for degrees in site.table.windows_deg[1:]]
            seconds: dict[str, list[float]] = {}
            for name, fit in SUMS.items():
                made[name][section.id], seconds[name] = summed_levels(finest, site, fit)
            made[DIRECT][section.id], seconds[DIRECT] = direct_levels(finest, direct)
            reference = trace_sliced(s, site, twin, REFERENCE_RATIO)
            for place, rays in enumerate(direct, start=1):
                judged = choose_cells(rays, options.cells, np.random.default_rng([options.seed, 1, s, place]))
                ours = {
                    name: Fitted(
                        cells=[levels[section.id][place].cell(int(cell)) for cell in judged],
                        seconds=seconds[name][place - 1],
                        components=levels[section.id][place].num_components / levels[section.id][place].num_cells,
                    )
                    for name, levels in made.items()
                }
                ours[EM] = fitted_by_em(rays, judged)
                finer = made[DEFAULT][section.id][place - 1].window
                found = judge(ours, judged, replace(reference, window=rays.window), finer, [options.seed, 2, s, place])
                window = round(float(np.rad2deg(rays.window)), 6)
                for name, one in ours.items():
                    fitted.setdefault((name, window), []).append(one)
                    scores.setdefault((name, window), []).extend(found[name])
            print(f"  {section.id} done", flush=True)
        lines = [*cell_table(fitted, scores), "", *fix_table(table, made, drops, options.seed)]
    (options.output / "wide.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))
    for suffix in ("svg", "png"):
        plot(fitted, scores, options.output / f"fit-study-wide.{suffix}")


def summed_levels(finest: Level, site: SiteFile, fit: CoarseFit) -> tuple[tuple[Level, ...], list[float]]:
    """Make all wide levels of a station, and time a cell of each."""
    levels, seconds = [finest], []
    for window in np.deg2rad(site.table.windows_deg[1:]).tolist():
        grid, finer = level_grid(window), levels[-1]
        unchanged = np.zeros(finer.num_cells, np.float32)
        sum_cells(grid.centres[:1], window, finer, unchanged, fit)  # compiles
        begin = time.thread_time()
        summed = sum_cells(grid.centres, window, finer, unchanged, fit)
        seconds.append((time.thread_time() - begin) / grid.num_cells)
        levels.append(
            Level(
                window=window,
                grid=grid,
                cell_offsets=np.concatenate([[0], np.cumsum(summed.counts)]),
                cell_log_mass=summed.log_mass,
                mixture=compacted(summed.mixture, window),
                log_balance=COMPACT_UNBALANCED,
            )
        )
    return tuple(levels), seconds


def direct_levels(finest: Level, direct: list[LevelRays]) -> tuple[tuple[Level, ...], list[float]]:
    """Fit all wide levels of a station to rays, and time a cell of each."""
    levels, seconds = [finest], []
    for rays in direct:
        fit_tubes(rays.grid.centres[:1], rays, TubeFit())  # compiles
        begin = time.thread_time()
        counts, log_mass, mixture, _ = fit_tubes(rays.grid.centres, rays, TubeFit())
        seconds.append((time.thread_time() - begin) / rays.grid.num_cells)
        levels.append(
            Level(
                window=rays.window,
                grid=rays.grid,
                cell_offsets=np.concatenate([[0], np.cumsum(counts)]),
                cell_log_mass=log_mass,
                mixture=compacted(mixture, rays.window),
                log_balance=COMPACT_UNBALANCED,
            )
        )
    return tuple(levels), seconds


def choose_cells(rays: LevelRays, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw cells of a level."""
    return rng.choice(rays.grid.num_cells, min(count, rays.grid.num_cells), replace=False)


def fitted_by_em(rays: LevelRays, cells: NDArray[np.int64]) -> Fitted:
    """Fit cells by em to rays at the wide window."""
    begin = time.thread_time()
    counts, _, fitted, _ = fit_em(rays.grid.centres[cells], cells, rays, ExpectationMaximisation(num_components=(16,)))
    ends, mixture = np.cumsum(counts), compacted(fitted, rays.window)
    return Fitted(
        cells=[mixture[int(end - count) : int(end)] for count, end in zip(counts, ends, strict=True)],
        seconds=(time.thread_time() - begin) / len(cells),
        components=float(counts.mean()),
    )


def judge(
    fitted: Mapping[str, Fitted], cells: NDArray[np.int64], reference: LevelRays, finer_window: float, seed: list[int]
) -> dict[str, list[float]]:
    """Mean log density of measured points of each cell, nats.

    Parameters
    ----------
    reference : LevelRays
        Rays from which points are drawn, with the wide window.
    finer_window : float, rad
        Of the level that serves angles with less noise.
    """
    angle = finer_window / WINDOW_RATIO
    noise = np.array([CoarseFit().range_stdev ** 2, angle**2, angle**2])
    centres = level_grid(reference.window).centres
    scores: dict[str, list[float]] = {name: [] for name in fitted}
    for n, cell in enumerate(cells):
        rng = np.random.default_rng([*seed, int(cell)])
        points, _, _ = sample_points(centres[cell], reference, HELD_OUT_POINTS, rng)
        points[:, :3] += rng.normal(size=(len(points), 3)) * np.sqrt(noise)
        for name, one in fitted.items():
            scores[name].append(float(log_density_as_measured(one.cells[n], points, noise).mean()))
    return scores


def gains(name: str, window: float, scores: Mapping[tuple[str, float], list[float]]) -> NDArray[np.float64]:
    """By how much a setting is better than the default on each judged cell of a window, nats."""
    return np.array(scores[name, window]) - np.array(scores[DEFAULT, window])


def cell_table(
    fitted: Mapping[tuple[str, float], list[Fitted]], scores: Mapping[tuple[str, float], list[float]]
) -> list[str]:
    """Markdown table of the cells."""
    lines = [
        "| window | cells of | judged | as measured, against default [nats] | median cell | components | bytes "
        "| ms per cell |",
        "|--:|---|--:|--:|--:|--:|--:|--:|",
    ]
    for name, window in sorted(fitted, key=lambda key: key[1]):
        stations, gain = fitted[name, window], gains(name, window, scores)
        components = float(np.mean([one.components for one in stations]))
        own = (
            f"{np.mean(scores[name, window]):.2f} in all"
            if name == DEFAULT
            else f"{gain.mean():+.3f} ± {error(gain):.3f}"
        )
        lines.append(
            f"| {window:g} deg | {name} | {len(gain)} | {own} | {np.median(gain):+.3f} "
            f"| {components:.1f} | {components * COMPONENT_BYTES:.0f} "
            f"| {1e3 * np.mean([one.seconds for one in stations]):.2f} |"
        )
    return lines


def error(values: NDArray[np.float64]) -> float:
    """Return the standard error of the mean."""
    return float(values.std() / np.sqrt(len(values)))


def fix_table(
    table: Table, made: Mapping[str, Mapping[str, tuple[Level, ...]]], drops: list[Drop], seed: int
) -> list[str]:
    """Markdown table of the errors of fixes, the same reports with each setting's levels."""
    lines = [
        "| cells of | " + " | ".join(f"{degrees:g} deg" for degrees in CASES_DEG) + " |",
        "|---|" + "--:|" * len(CASES_DEG),
    ]
    bounds: list[str] = []
    for name, levels in made.items():
        parts = {station: replace(part, levels=levels[station]) for station, part in table.parts.items()}
        locator = Locator(replace(table, parts=parts))
        row = []
        for degrees in CASES_DEG:
            angle = float(np.deg2rad(degrees))
            noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=RANGE_STDEV)
            found = locate_drops(locator, drops, noise, timing="pt", rng=np.random.default_rng([seed, 3]))
            e50, e90 = np.percentile(found.error, [50, 90], method="inverted_cdf")
            row.append(f"{e50:.2f}, {e90:.2f} m")
            if name == DEFAULT:
                b50, b90 = np.percentile(found.bound, [50, 90], method="inverted_cdf")
                bounds.append(f"{b50:.2f}, {b90:.2f} m")
        lines.append(f"| {name} | " + " | ".join(row) + " |")
        print(lines[-1], flush=True)
    return [*lines, "| bound | " + " | ".join(bounds) + " |"]


def plot(
    fitted: Mapping[tuple[str, float], list[Fitted]], scores: Mapping[tuple[str, float], list[float]], path: Path
) -> None:
    """Draw accuracy against bytes, one panel a window."""
    mpl.use("agg")
    import matplotlib.pyplot as plt  # after the backend is chosen

    mpl.rcParams["svg.hashsalt"] = "rayfix"
    windows = sorted({window for _, window in fitted})
    figure, axes = plt.subplots(1, len(windows), figsize=(2.5 + 4.5 * len(windows), 4.2), squeeze=False)
    for panel, window in zip(axes[0], windows, strict=True):
        for (name, _), mark in zip([key for key in fitted if key[1] == window], "*ov^s<D", strict=True):
            size = float(np.mean([one.components for one in fitted[name, window]])) * COMPONENT_BYTES
            gain: Any = gains(name, window, scores)
            bar = error(gain)
            panel.errorbar(size, gain.mean(), yerr=bar, marker=mark, ms=8, ls="none", capsize=2, label=name)
        panel.set(title=f"{window:g} deg", xlabel="bytes per cell", xscale="log", xlim=(1500, 70000))
        panel.set_xticks(SIZES, [f"{size}" for size in SIZES])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    axes[0, 0].set_ylabel("held-out log density of measured points\nagainst the default, mean [nats per point]")
    axes[0, -1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


if __name__ == "__main__":
    main()
