"""Heat maps over the floor plan."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter
from numpy.typing import NDArray

from rayfix_evaluation.pictures.files import set_plan_limits
from rayfix_evaluation.report.geometry import Backdrop
from rayfix_evaluation.report.style import INK, MUTED, new_figure

__all__ = ["planning_chart"]

Document = Mapping[str, Any]

_TICKS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


def planning_chart(scene: Backdrop, planning: Document) -> Figure:
    """Draw expected error and probability of a useful fix over the floor, a column for each set of measurements."""
    maps = planning["maps"]
    extent = scene.high - scene.low
    tall = extent[1] > extent[0]
    along = 1 if tall else 0
    height = 4.6 * extent[1 - along] / extent[along]
    figure = new_figure(10.8, 2.0 * height + 1.6)
    known = np.array([e for plan in maps for e in plan["error_m"] if e is not None])
    low, high = np.quantile(known, [0.02, 0.98]) if len(known) else (0.1, 1.0)
    scales = {"error_m": LogNorm(low, max(high, 1.5 * low)), "within": Normalize(0.0, 1.0)}
    titles = {"error_m": "error to expect (RMS)", "within": f"probability of less than {maps[0]['threshold_m']:g} m"}
    panels = figure.subplots(2, len(maps), sharex=True, sharey=True, squeeze=False)
    for row, (name, scale) in zip(panels, scales.items(), strict=True):
        for axes, plan in zip(row, maps, strict=True):
            image = _draw(axes, planning, plan, name, scale, along)
            _furnish(axes, scene, planning, along)
            axes.set_title(f"{plan['label']}: {titles[name]}")
        bar = figure.colorbar(image, ax=list(row), pad=0.01, aspect=14, shrink=0.8)
        bar.outline.set_visible(False)
        if name == "error_m":
            bar.locator = FixedLocator([t for t in _TICKS if low <= t <= high])
            bar.formatter = FuncFormatter(lambda v, _: f"{100 * v:g} cm" if v < 1.0 else f"{v:g} m")
            bar.ax.yaxis.set_minor_formatter(NullFormatter())
            bar.update_ticks()
    for axes in panels[-1]:
        axes.set_xlabel(f"{'xy'[along]} [m]")
    for axes in panels[:, 0]:
        axes.set_ylabel(f"{'xy'[1 - along]} [m]")
    return figure


def _draw(axes: Axes, planning: Document, plan: Document, name: str, scale: Normalize, along: int) -> Any:
    """Draw squares as an image; positions outside of the map remain empty."""
    spots, values = np.array(plan["position_m"]), np.array([np.nan if v is None else v for v in plan[name]])
    size = planning["spacing_m"]
    low = spots.min(axis=0)
    cells = np.rint((spots - low) / size).astype(np.int64)
    grid: NDArray[np.float64] = np.full(cells.max(axis=0) + 1, np.nan)
    grid[cells[:, 0], cells[:, 1]] = values
    picture = grid if along == 1 else grid.T
    first, last = low - 0.5 * size, low + (np.array(grid.shape) - 0.5) * size
    extent = (first[along], last[along], first[1 - along], last[1 - along])
    colours = "viridis_r" if name == "error_m" else "cividis"
    return axes.imshow(picture, origin="lower", extent=extent, norm=scale, cmap=colours, interpolation="nearest")


def _furnish(axes: Axes, scene: Backdrop, planning: Document, along: int) -> None:
    pick = [along, 1 - along]
    walls = np.array(planning["walls_m"]).reshape(-1, 2, 2)[:, :, pick]
    axes.add_collection(LineCollection(list(walls), colors=INK, linewidths=0.8))
    for spot in scene.stations.values():
        axes.plot(*spot[pick], marker="^", color="#d1495b", markeredgecolor=MUTED, markersize=7, linestyle="none")
    axes.grid(visible=False)
    set_plan_limits(axes, along, scene.low, scene.high)
