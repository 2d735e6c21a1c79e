"""What the fit's settings buy: held-out log-likelihood, time and size of random cells, for tubes and for em.

The hall is the bundled one; the warehouse is read from ``../shared/data`` and left out where that is missing. What
was measured of a site goes to ``results.json``; sites that are in it already stay, so that each can have its own run.
docs/fit-study.md discusses the results.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from rayfix.example.files import write_example
from rayfix_offline import trace
from rayfix_offline.em import ExpectationMaximisation, fit_em, sample_points
from rayfix_offline.plan import BLOCK_CELLS
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.trace import LevelRays, level_grid, trace_station
from rayfix_offline.tubes import TubeFit, fit_tubes
from rayfix_offline.twin import Twin, prepare_twin
from rayfix_tables.mixture import FIELD_DTYPES, FIELD_SHAPES, TubeMixture, unpack

WAREHOUSE_SCENE = Path(__file__).parents[2] / "shared" / "data" / "warehouse" / "warehouse_collision.ply"

WAREHOUSE_STATIONS = {
    "w1": (-4.5, -9.0, 4.5),
    "w2": (5.5, -9.5, 4.8),
    "w3": (6.0, 0.5, 4.2),
    "w4": (6.0, 9.5, 4.6),
    "w5": (-3.8, 9.3, 5.0),
    "w6": (-3.5, 0.5, 4.0),
}

REFERENCE_RATIO = 1.1
"""Slices of the rays that held-out points are drawn from: finer than those of any fit."""

HELD_OUT_POINTS = 1000

SWEPT_STATIONS = 2
"""Stations whose cells the settings are varied on."""

COMPONENT_BYTES = sum(
    int(np.prod(shape, dtype=int)) * np.dtype(FIELD_DTYPES[name]).itemsize for name, shape in FIELD_SHAPES.items()
)


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
    "slice_ratio": (1.2, 1.35, 1.5, 2.0),
    "max_divergence": (3e-4, 1e-3, 3e-3, 1e-2),
    "max_components": (16, 32, 48, 96),
    "dropped_mass": (1e-3, 1e-4, 1e-5),
}

FINE_RATIO = 1.2
"""Slices for which the divergence is varied too."""

FINE_FAMILY = f"max_divergence at slice_ratio {FINE_RATIO:g}"

PROPOSED = Setting(
    name=f"tubes, slice_ratio {FINE_RATIO:g}, max_divergence 0.01",
    family="proposed",
    fit=TubeFit(max_divergence=1e-2),
    slice_ratio=FINE_RATIO,
    cells="all",
)

CAREFUL = Setting(
    name=f"tubes, slice_ratio {FINE_RATIO:g}, max_divergence 0.01, dropped_mass 1e-05",
    family="proposed",
    fit=TubeFit(max_divergence=1e-2, dropped_mass=1e-5),
    slice_ratio=FINE_RATIO,
    cells="all",
)

DEFAULT = Setting(name="tubes, default", family="default", fit=TubeFit(), cells="all")


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
    *(
        Setting(
            name=f"slice_ratio {FINE_RATIO:g} and max_divergence {cost:g}",
            family=FINE_FAMILY,
            value=cost,
            fit=TubeFit(max_divergence=cost),
            slice_ratio=FINE_RATIO,
        )
        for cost in (3e-3, 3e-2)
    ),
    PROPOSED,
    CAREFUL,
    Setting(name="em, K = 16", family="em", fit=ExpectationMaximisation(num_components=(16,)), cells="all"),
    Setting(name="em, BIC", family="em", fit=ExpectationMaximisation(), cells="few"),
    Setting(name="em, K = 32", family="em", fit=ExpectationMaximisation(num_components=(32,)), cells="few"),
)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A chosen cell.

    Attributes
    ----------
    rank : int
        Its place in the draw; cells that were added for the sake of the wide windows have -1.
    """

    station: int
    level: int
    number: int
    rank: int


@dataclass(frozen=True, kw_only=True)
class Score:
    """What came of one cell under one setting.

    Attributes
    ----------
    window_deg : float
    joint : float, nats
        Mean held-out log density of (length [m], angles [rad], position [m]).
    position : float, nats
        The same of the position given length and angles.
    seconds : float
        Processor time of the fit; the mean over the cells that were fitted together.
    """

    setting: str
    cell: Cell
    window_deg: float
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
    parser.add_argument("--wide", type=int, default=10, help="further cells of each window but the finest (default 10)")
    parser.add_argument("--only", metavar="TEXT", help="only settings with this in their name; other results stay")
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
        cells = draw_cells(site, options.cells, options.wide, np.random.default_rng(options.seed))
        print(f"{name}: {len(cells)} cells of {len(site.stations)} stations, seed {options.seed}", flush=True)
        chosen = [setting for setting in SETTINGS if not options.only or options.only in setting.name]
        scores = study(site, twin, cells, chosen, some=options.some, few=options.few, seed=options.seed)
        measured = {score.setting for score in scores}
        kept = [score for score in results.get(name, []) if options.only and score["setting"] not in measured]
        results[name] = kept + [asdict(score) for score in scores]
        stored.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    if not results:
        return
    markdown = "\n".join(table for name in results for table in (f"### {name}\n", *tables(results[name]), ""))
    (options.output / "results.md").write_text(markdown, encoding="utf-8")
    print(markdown)
    for name in results:
        print(verdict(name, results[name]))
    plot(results, options.output)


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


def draw_cells(site: SiteFile, count: int, wide: int, rng: np.random.Generator) -> list[Cell]:
    """Draw cells of all stations and windows alike, then ``wide`` more of each window but the finest."""
    sizes = [level_grid(float(window)).num_cells for window in np.deg2rad(site.table.windows_deg)]
    places = [(s, lv, n) for s in range(len(site.stations)) for lv, size in enumerate(sizes) for n in range(size)]
    order = rng.permutation(len(places))
    cells = [
        Cell(station=place[0], level=place[1], number=place[2], rank=rank)
        for rank, place in enumerate(places[i] for i in order[:count])
    ]
    for level in range(1, len(sizes)):
        more = [places[i] for i in order[count:] if places[i][1] == level][:wide]
        cells += [Cell(station=s, level=lv, number=n, rank=-1) for s, lv, n in more]
    return cells


def study(
    site: SiteFile, twin: Twin, cells: list[Cell], settings: Sequence[Setting], *, some: int, few: int, seed: int
) -> list[Score]:
    """Fit the cells; those for the settings come from the first two stations, which saves tracing the others again."""
    subset = [cell for cell in cells if cell.rank >= 0 and cell.station < SWEPT_STATIONS]
    fitted = {"all": set(cells), "some": set(subset[:some]), "few": set(subset[:few])}
    scores: list[Score] = []
    for s, station in enumerate(site.stations):
        reference = trace_with(REFERENCE_RATIO, s, site, twin)
        traces: dict[float, list[LevelRays]] = {}
        blocks = []
        for level, rays in enumerate(reference):
            block = [c for c in cells if c.station == s and c.level == level]
            held_out = [
                sample_points(
                    rays.grid.centres[c.number],
                    rays,
                    HELD_OUT_POINTS,
                    np.random.default_rng([seed, s, level, c.number]),
                )[0]
                for c in block
            ]
            reached = [(c, points) for c, points in zip(block, held_out, strict=True) if len(points)]
            blocks.append((level, reached))
        for setting in settings:
            mine = fitted[setting.cells]
            if not any(c in mine for _, reached in blocks for c, _ in reached):
                continue
            if setting.slice_ratio not in traces:
                traces[setting.slice_ratio] = trace_with(setting.slice_ratio, s, site, twin)
            for level, reached in blocks:
                chosen = [(c, points) for c, points in reached if c in mine]
                if chosen:
                    scores += score_block(setting, traces[setting.slice_ratio][level], chosen)
        print(f"  {station.id} done", flush=True)
    return scores


def trace_with(slice_ratio: float, station: int, site: SiteFile, twin: Twin) -> list[LevelRays]:
    """Trace a station for each window as a build whose finest it is, but with other slices."""
    sites = [
        site.model_copy(update={"table": site.table.model_copy(update={"windows_deg": (window,)})})
        for window in site.table.windows_deg
    ]
    other: AbstractContextManager[Any] = mock.patch.object(trace, "SLICE_RATIO", slice_ratio)
    with other:
        return [trace_station(alone.stations[station], alone, twin).finest for alone in sites]


def score_block(setting: Setting, level: LevelRays, chosen: Sequence[tuple[Cell, NDArray[np.float64]]]) -> list[Score]:
    """Fit cells of one level together, as a build does, and judge each."""
    numbers = np.array([cell.number for cell, _ in chosen])
    centres = level.grid.centres[numbers]
    fit = setting.fit
    if isinstance(fit, TubeFit):
        counts, _, mixture = fit_tubes(centres, level, fit)
        # A call has a fixed cost, which a build spreads over a block.
        fixed = processor_seconds(lambda: fit_tubes(centres[:0], level, fit))
        varying = processor_seconds(lambda: fit_tubes(centres, level, fit)) - fixed
        seconds = varying / len(chosen) + fixed / BLOCK_CELLS
    else:
        begin = time.process_time()
        counts, _, mixture = fit_em(centres, numbers, level, fit)
        seconds = (time.process_time() - begin) / len(chosen)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    scores = []
    for n, (cell, points) in enumerate(chosen):
        joint, position = log_densities(mixture[int(offsets[n]) : int(offsets[n + 1])], points)
        scores.append(
            Score(
                setting=setting.name,
                cell=cell,
                window_deg=round(float(np.rad2deg(level.window)), 6),
                joint=float(joint.mean()),
                position=float(position.mean()),
                seconds=seconds,
                components=int(counts[n]),
            )
        )
    return scores


def processor_seconds(run: Callable[[], object]) -> float:
    """Median of three runs."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return float(np.median(times))


def log_densities(mixture: TubeMixture, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Log density of points under a cell's stored numbers, in double precision.

    Parameters
    ----------
    points : ndarray of shape (n, 6)
        (path length, horizontal and vertical angle, x, y, z).

    Returns
    -------
    joint : ndarray of shape (n,)
        ``log sum_k w_k N(u) N(x | u)``.
    position : ndarray of shape (n,)
        ``log p(x | u)``.
    """
    u_offset = points[:, :3] - mixture.u_mean.astype(np.float64)[:, None]
    predicted = mixture.x_mean[:, None] + u_offset @ np.swapaxes(mixture.jacobian.astype(np.float64), 1, 2)
    log_u = mixture.log_weight[:, None] + _log_normal(u_offset, unpack(mixture.u_cov.astype(np.float64)))
    log_x = _log_normal(points[:, 3:] - predicted, unpack(mixture.x_cov.astype(np.float64)))
    joint = np.logaddexp.reduce(log_u + log_x, axis=0)
    return joint, joint - np.logaddexp.reduce(log_u, axis=0)


def _log_normal(offset: NDArray[np.float64], cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log densities, shape (k, n), of offsets of shape (k, n, 3) under k covariances."""
    lower = np.linalg.cholesky(cov)
    white = offset @ np.swapaxes(np.linalg.inv(lower), 1, 2)
    log_det = np.log(np.einsum("kii->ki", lower)).sum(axis=1)
    return -0.5 * (white**2).sum(axis=2) - log_det[:, None] - 1.5 * np.log(2.0 * np.pi)


def tables(scores: list[dict[str, Any]]) -> list[str]:
    """Markdown tables of one site: fits of all random cells, settings against the default, windows one by one."""
    names = list(dict.fromkeys(score["setting"] for score in scores))
    drawn = [score for score in scores if score["cell"]["rank"] >= 0]
    default = [s for s in drawn if s["setting"] == DEFAULT.name]
    lines = [
        "| fit | cells | joint [nats] | position given length and angles [nats] | ms per cell | components | bytes |",
        "|---|--:|--:|--:|--:|--:|--:|",
    ]
    for name in names:
        some = [s for s in drawn if s["setting"] == name]
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
        some, same = paired(name, drawn)
        gain, error, median = gain_over_default(name, drawn)
        lines.append(
            f"| {name} | {len(some)} | {gain:+.2f} ± {error:.2f} | {median:+.2f} "
            f"| {mean_of(some, 'seconds') / mean_of(same, 'seconds'):.2f} "
            f"| {mean_of(some, 'components') / mean_of(same, 'components'):.2f} |"
        )
    lines += [
        "",
        "| window | fit | cells | joint [nats] | ms per cell | components |",
        "|--:|---|--:|--:|--:|--:|",
    ]
    for window in sorted({score["window_deg"] for score in scores}):
        here = [s for s in scores if s["window_deg"] == window]
        for name in names:
            some = [s for s in here if s["setting"] == name]
            if len(some) == sum(s["setting"] == DEFAULT.name for s in here):
                lines.append(
                    f"| {window:g} deg | {name} | {len(some)} | {mean_of(some, 'joint'):.2f} "
                    f"| {1e3 * mean_of(some, 'seconds'):.2f} | {mean_of(some, 'components'):.1f} |"
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
    """Say how tubes and em compare on the random cells."""
    drawn = [score for score in scores if score["cell"]["rank"] >= 0]
    lines = []
    for rival in dict.fromkeys(s["setting"] for s in drawn if s["setting"].startswith("em")):
        some, tubes = paired(rival, drawn)
        better = np.mean([t["joint"] >= e["joint"] for t, e in zip(tubes, some, strict=True)])
        gain, error, median = gain_over_default(rival, drawn)
        ratio = mean_of(some, "seconds") / mean_of(tubes, "seconds")
        lines.append(
            f"{name}, {len(some)} cells: tubes are {ratio:.0f} times as fast as {rival}; joint log-likelihood "
            f"{-gain:+.2f} ± {error:.2f} nats (median cell {-median:+.2f}), not lower in {better:.0%} of the cells"
        )
    return "\n".join(lines)


COLOURS = {
    "slice_ratio": "tab:blue",
    "max_divergence": "tab:orange",
    "max_components": "tab:green",
    "dropped_mass": "tab:purple",
    FINE_FAMILY: "tab:cyan",
}


def plot(results: dict[str, Any], folder: Path, suffix: str = "svg") -> None:
    """Draw accuracy against bytes and against seconds, one panel a site."""
    mpl.use("agg")
    import matplotlib.pyplot as plt  # after the backend is chosen

    mpl.rcParams["svg.hashsalt"] = "rayfix"
    for key, label in (("bytes", "bytes per cell"), ("seconds", "processor seconds per cell")):
        figure, axes = plt.subplots(1, len(results), figsize=(2.5 + 4.5 * len(results), 4.2), squeeze=False)
        for panel, (site, scores) in zip(axes[0], results.items(), strict=True):
            draw_panel(panel, [s for s in scores if s["cell"]["rank"] >= 0], key)
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
        members.append(
            (PROPOSED.fit.max_divergence, PROPOSED.name)
            if family == FINE_FAMILY
            else (default_of(family), DEFAULT.name)
        )
        members.sort()
        points = np.array([place(name) for _, name in members])
        panel.plot(points[:, 0], points[:, 1], "o-", ms=3.5, lw=1, color=colour, label=f"tubes, {family}")
        for (value, name), (x, y) in zip(members, points, strict=True):
            if name != DEFAULT.name and (key == "bytes" or family == "slice_ratio"):
                panel.annotate(
                    f"{value:g}", (x, y), xytext=(3, -8), textcoords="offset points", fontsize=6, color=colour
                )
    panel.plot(*place(DEFAULT.name), "k*", ms=11, label="tubes, default", zorder=3)
    panel.plot(*place(PROPOSED.name), "b*", ms=11, mfc="none", label="tubes, proposed", zorder=3)
    marks = iter("sD^vPX")
    for name in dict.fromkeys(s["setting"] for s in scores if s["setting"].startswith("em")):
        face = "none" if name.endswith("tube") else "tab:red"
        panel.plot(*place(name), next(marks), ms=6, ls="none", color="tab:red", mfc=face, label=name)


if __name__ == "__main__":
    main()
