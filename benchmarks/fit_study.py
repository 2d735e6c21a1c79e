"""What the fit's settings buy at the finest window: held-out log-likelihood, time and size, for tubes and for em.

The hall is the bundled one; the warehouse is read from ``../shared/data`` and left out where that is missing. What
was measured of a site goes to ``results.json``; sites that are in it already stay, so that each can have its own run.
docs/fit-study.md discusses the results; ``wide_study.py`` judges the wide windows.
"""

import argparse
import json
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from held_out import COMPONENT_BYTES, REFERENCE_RATIO, log_densities, processor_seconds, trace_sliced
from numpy.typing import NDArray

from rayfix.example.files import write_example
from rayfix_offline import trace
from rayfix_offline.em import ExpectationMaximisation, fit_em, sample_points
from rayfix_offline.plan import BLOCK_CELLS
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.trace import LevelRays, level_grid
from rayfix_offline.tubes import TubeFit, fit_tubes
from rayfix_offline.twin import Twin, prepare_twin

WAREHOUSE_SCENE = Path(__file__).parents[2] / "shared" / "data" / "warehouse" / "warehouse_collision.ply"

WAREHOUSE_STATIONS = {
    "w1": (-4.5, -9.0, 4.5),
    "w2": (5.5, -9.5, 4.8),
    "w3": (6.0, 0.5, 4.2),
    "w4": (6.0, 9.5, 4.6),
    "w5": (-3.8, 9.3, 5.0),
    "w6": (-3.5, 0.5, 4.0),
}

HELD_OUT_POINTS = 1000

SWEPT_STATIONS = 2
"""Stations whose cells the settings are varied on."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One way to fit a cell.

    Attributes
    ----------
    family : str
        What is varied.
    value : float
        Its value.
    cells : {"all", "some", "few"}
        Which cells are fitted: all of them, those of ``--some`` or those of ``--few``.
    """

    name: str
    family: str
    fit: TubeFit | ExpectationMaximisation
    value: float = 0.0
    slice_ratio: float = trace.SLICE_RATIO
    cells: str = "some"


SWEEPS: dict[str, tuple[float, ...]] = {
    "slice_ratio": (1.15, 1.2, 1.35, 1.5, 2.0),
    "max_divergence": (1e-3, 3e-3, 1e-2, 3e-2),
    "max_components": (16, 32, 48, 96),
    "dropped_mass": (1e-3, 1e-4, 1e-5),
}

DEFAULT = Setting(name="tubes, default", family="default", fit=TubeFit(), cells="all")

CAREFUL = TubeFit(dropped_mass=1e-5)

CANDIDATES = (
    Setting(name="tubes, dropped_mass 1e-05", family="candidate", fit=CAREFUL, cells="all"),
    Setting(
        name="tubes, dropped_mass 1e-05, slice_ratio 1.15",
        family="candidate",
        fit=CAREFUL,
        slice_ratio=1.15,
        cells="all",
    ),
)


def default_of(family: str) -> float:
    """Value of a swept setting in the default fit."""
    return trace.SLICE_RATIO if family == "slice_ratio" else float(getattr(DEFAULT.fit, family))


def swept(family: str, value: float) -> Setting:
    """Return the default with one setting changed."""
    name = f"{family} {value:g}"
    if family == "slice_ratio":
        return Setting(name=name, family=family, value=value, fit=TubeFit(), slice_ratio=value)
    changed = {family: int(value) if family == "max_components" else value}
    return Setting(name=name, family=family, value=value, fit=TubeFit(**changed))


SETTINGS: tuple[Setting, ...] = (
    DEFAULT,
    *(
        swept(family, value)
        for family, values in SWEEPS.items()
        for value in values
        if value != default_of(family)  # the default itself is measured once
    ),
    *CANDIDATES,
    Setting(name="em, K = 16", family="em", fit=ExpectationMaximisation(num_components=(16,)), cells="all"),
    Setting(name="em, BIC", family="em", fit=ExpectationMaximisation(), cells="few"),
    Setting(name="em, K = 32", family="em", fit=ExpectationMaximisation(num_components=(32,)), cells="few"),
)


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


def write_warehouse(folder: Path) -> Path | None:
    """Write the warehouse's site file; None where its scene is missing."""
    if not WAREHOUSE_SCENE.exists():
        return None
    stations = "".join(
        f'[[stations]]\nid = "{name}"\nposition_m = {list(position)}\n' for name, position in WAREHOUSE_STATIONS.items()
    )
    path = folder / "site.toml"
    path.write_text(
        f'[site]\nname = "warehouse"\nscene = "{WAREHOUSE_SCENE.resolve()}"\n{stations}',
        encoding="utf-8",
    )
    return path


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
        counts, _, mixture = fit_tubes(centres, level, fit)
        # A call has a fixed cost, which a build spreads over a block.
        fixed = processor_seconds(lambda: fit_tubes(centres[:0], level, fit))
        varying = processor_seconds(lambda: fit_tubes(centres, level, fit)) - fixed
        seconds = varying / len(numbers) + fixed / BLOCK_CELLS
    else:
        begin = time.thread_time()
        counts, _, mixture = fit_em(centres, numbers, level, fit)
        seconds = (time.thread_time() - begin) / len(numbers)
    ends = np.cumsum(counts)
    scores = []
    for (cell, points), count, end in zip(held_out.items(), counts, ends, strict=True):
        joint, position = log_densities(mixture[int(end - count) : int(end)], points)
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


def tables(scores: list[dict[str, Any]]) -> list[str]:
    """Markdown tables of one site: fits of all cells, and settings against the default."""
    names = list(dict.fromkeys(score["setting"] for score in scores))
    default = [s for s in scores if s["setting"] == DEFAULT.name]
    lines = [
        "| fit | cells | joint [nats] | position given length and angles [nats] | ms per cell | components | bytes |",
        "|---|--:|--:|--:|--:|--:|--:|",
    ]
    for name in names:
        some = [s for s in scores if s["setting"] == name]
        if len(some) == len(default):
            components = mean_of(some, "components")
            lines.append(
                f"| {name} | {len(some)} | {mean_of(some, 'joint'):.2f} | {mean_of(some, 'position'):.2f} "
                f"| {1e3 * mean_of(some, 'seconds'):.2f} | {components:.1f} | {components * COMPONENT_BYTES:.0f} |"
            )
    lines += [
        "",
        "| setting | cells | joint, against default [nats] | median cell | time / default | bytes / default |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    for name in names:
        if name == DEFAULT.name:
            continue
        some, same = paired(name, scores)
        gain, error, median = gain_over_default(name, scores)
        lines.append(
            f"| {name} | {len(some)} | {gain:+.2f} ± {error:.2f} | {median:+.2f} "
            f"| {mean_of(some, 'seconds') / mean_of(same, 'seconds'):.2f} "
            f"| {mean_of(some, 'components') / mean_of(same, 'components'):.2f} |"
        )
    return lines


def mean_of(scores: list[dict[str, Any]], key: str) -> float:
    """Mean of one of the scores' numbers."""
    return float(np.mean([score[key] for score in scores]))


def paired(name: str, scores: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Scores of a setting, and the default's on the same cells."""
    some = [s for s in scores if s["setting"] == name]
    default = {tuple(s["cell"].values()): s for s in scores if s["setting"] == DEFAULT.name}
    return some, [default[tuple(s["cell"].values())] for s in some]


def gain_over_default(name: str, scores: list[dict[str, Any]]) -> tuple[float, float, float]:
    """Difference of the joint log density to the default's on the same cells, nats: mean, its error, median."""
    gain = np.array([s["joint"] - d["joint"] for s, d in zip(*paired(name, scores), strict=True)])
    return float(gain.mean()), float(gain.std() / np.sqrt(len(gain))), float(np.median(gain))


def verdict(name: str, scores: list[dict[str, Any]]) -> str:
    """Say how tubes and em compare, each pair on the cells that em fitted."""
    by_cell = {
        setting: {tuple(s["cell"].values()): s for s in scores if s["setting"] == setting}
        for setting in dict.fromkeys(s["setting"] for s in scores)
    }
    lines = []
    for rival in [setting for setting in by_cell if setting.startswith("em")]:
        for ours in [setting for setting in by_cell if setting.startswith("tubes")]:
            pairs = [(by_cell[ours][cell], em) for cell, em in by_cell[rival].items()]
            gain = np.array([tubes["joint"] - em["joint"] for tubes, em in pairs])
            ratio = np.mean([em["seconds"] for _, em in pairs]) / np.mean([tubes["seconds"] for tubes, _ in pairs])
            lines.append(
                f"{name}, {len(pairs)} cells: {ours} are {ratio:.0f} times as fast as {rival}; joint log-likelihood "
                f"{gain.mean():+.2f} ± {gain.std() / np.sqrt(len(gain)):.2f} nats (median cell "
                f"{np.median(gain):+.2f}), not lower in {np.mean(gain >= 0.0):.0%} of the cells"
            )
    return "\n".join(lines)


COLOURS = {
    "slice_ratio": "tab:blue",
    "max_divergence": "tab:orange",
    "max_components": "tab:green",
    "dropped_mass": "tab:purple",
}


def plot(results: dict[str, Any], folder: Path, suffix: str) -> None:
    """Draw accuracy against bytes and against seconds, one panel a site."""
    mpl.use("agg")
    import matplotlib.pyplot as plt  # after the backend is chosen

    mpl.rcParams["svg.hashsalt"] = "rayfix"
    for key, label in (("bytes", "bytes per cell"), ("seconds", "processor seconds per cell")):
        figure, axes = plt.subplots(1, len(results), figsize=(2.5 + 4.5 * len(results), 4.2), squeeze=False)
        for panel, (site, scores) in zip(axes[0], results.items(), strict=True):
            draw_panel(panel, scores, key)
            panel.set(title=site, xlabel=label, xscale="linear" if key == "bytes" else "log")
            panel.grid(alpha=0.3)
        axes[0, 0].set_ylabel("held-out log density against the default,\nmedian cell [nats per point]")
        axes[0, -1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.02, 1.0))
        figure.tight_layout()
        figure.savefig(folder / f"fit-study-{key}.{suffix}", metadata={"Date": None} if suffix == "svg" else None)
        plt.close(figure)


def draw_panel(panel: Any, scores: list[dict[str, Any]], key: str) -> None:
    """Draw one panel; em has marks of its own, the tubes' settings are lines through the default."""
    default = [s for s in scores if s["setting"] == DEFAULT.name]

    def place(name: str) -> tuple[float, float]:
        # A setting that was measured on some cells is placed by its ratio to the default on them.
        some, same = paired(name, scores)
        field, unit = ("components", COMPONENT_BYTES) if key == "bytes" else ("seconds", 1)
        across = mean_of(default, field) * unit * mean_of(some, field) / mean_of(same, field)
        # The median: one cell in which held-out points hit nothing would decide the mean.
        return across, gain_over_default(name, scores)[2]

    for family, colour in COLOURS.items():
        members = [(setting.value, setting.name) for setting in SETTINGS if setting.family == family]
        members.append((default_of(family), DEFAULT.name))
        members.sort()
        points = np.array([place(name) for _, name in members])
        panel.plot(points[:, 0], points[:, 1], "o-", ms=3.5, lw=1, color=colour, label=f"tubes, {family}")
        for (value, name), (x, y) in zip(members, points, strict=True):
            if name != DEFAULT.name and (key == "bytes" or family == "slice_ratio"):
                panel.annotate(
                    f"{value:g}", (x, y), xytext=(3, -8), textcoords="offset points", fontsize=6, color=colour
                )
    panel.plot(*place(DEFAULT.name), "k*", ms=11, label="tubes, default", zorder=3)
    for setting, mark in zip(CANDIDATES, "PX", strict=True):
        panel.plot(*place(setting.name), mark, ms=7, ls="none", color="tab:blue", label=setting.name)
    marks = iter("sD^v")
    for name in dict.fromkeys(s["setting"] for s in scores if s["setting"].startswith("em")):
        panel.plot(*place(name), next(marks), ms=6, ls="none", color="tab:red", label=name)


if __name__ == "__main__":
    main()
