"""Report of the fit study: tables, conclusions, and pictures."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from benchmarks.common.held_out import COMPONENT_BYTES
from benchmarks.offline.fit_settings import CANDIDATES, DEFAULT, SETTINGS, default_of


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
