"""Pictures of planning maps: heat maps on the floor plan."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.pyplot import get_cmap
from matplotlib.ticker import FuncFormatter, LogLocator
from numpy.typing import NDArray

from rayfix_evaluation.pictures.files import save_picture, set_plan_limits
from rayfix_evaluation.planning.floor import slice_mesh
from rayfix_evaluation.planning.forecast import PlanMap
from rayfix_tables.table import Table

Array = NDArray[np.float64]

_INK, _SOLID, _PAPER, _NO_FIX = "#2b2f36", "#d9dbdf", "#ffffff", "#7a1f2b"


@dataclass(frozen=True, kw_only=True)
class _Quantity:
    """Quantity and colours of a panel."""

    title: str
    label: str
    cmap: Colormap
    norm: Normalize


def draw_plan(path: str | Path, table: Table, plan: PlanMap) -> None:
    """Draw the map of one table: expected error, probability of a useful fix, and number of audible stations.

    Parameters
    ----------
    path : str or Path
        Its suffix says the type: .png, .svg or .pdf.
    """
    figure, panels = _figure(table, rows=3, columns=1)
    stations = len(table.site.stations)
    audible = _Quantity(
        title="audible stations",
        label="stations",
        cmap=get_cmap("cividis"),
        norm=Normalize(0.0, float(stations)),
    )
    for axes, quantity, values in (
        (panels[0][0], _error(plan.error), plan.error),
        (panels[1][0], _within(plan), plan.within),
        (panels[2][0], audible, plan.num_audible),
    ):
        _draw_panel(figure, axes, table, plan, quantity, values)
    _save(figure, path, _title(table, plan))


def draw_comparison(path: str | Path, one: tuple[Table, PlanMap], other: tuple[Table, PlanMap]) -> None:
    """Draw two tables' maps above each other, and the changes from the first to the second.

    Parameters
    ----------
    path : str or Path
        Its suffix says the type: .png, .svg or .pdf.
    """
    (table, plan), (other_table, other_plan) = one, other
    figure, panels = _figure(table, rows=3, columns=2)
    error = _error(np.concatenate([plan.error, other_plan.error]))
    for row, (its_table, its_plan) in zip(panels, (one, other), strict=False):
        name = its_table.path.name
        _draw_panel(figure, row[0], its_table, its_plan, replace(error, title=f"{name}: {error.title}"), its_plan.error)
        _draw_panel(figure, row[1], its_table, its_plan, _within(plan), its_plan.within)
    ratio, gain = changes(plan, other_plan)
    most = max(1.0, float(np.abs(ratio[np.isfinite(ratio)]).max(initial=0.0)))
    _draw_panel(
        figure,
        panels[2][0],
        other_table,
        plan,
        _Quantity(
            title="change of the error",
            label="factor",
            cmap=get_cmap("PuOr_r"),
            norm=LogNorm(2.0**-most, 2.0**most),
        ),
        2.0**ratio,
    )
    largest = max(0.05, float(np.nanmax(np.abs(gain), initial=0.0)))
    _draw_panel(
        figure,
        panels[2][1],
        other_table,
        plan,
        _Quantity(
            title="change of the probability",
            label="difference",
            cmap=get_cmap("PuOr"),
            norm=Normalize(-largest, largest),
        ),
        gain,
    )
    _save(figure, path, f"{_title(table, plan)}\nbeside {_title(other_table, other_plan)}")


def changes(plan: PlanMap, other: PlanMap) -> tuple[Array, Array]:
    """Change of each square of a map: log2 of the ratio of errors, difference of probabilities; NaN if not in both."""
    places = {tuple(place): n for n, place in enumerate(np.round(other.position, 6).tolist())}
    match = np.array([places.get(tuple(place), -1) for place in np.round(plan.position, 6).tolist()])
    with np.errstate(invalid="ignore"):
        ratio = np.log2(other.error[match]) - np.log2(plan.error)
    return np.where(match >= 0, ratio, np.nan), np.where(match >= 0, other.within[match] - plan.within, np.nan)


def _error(error: Array) -> _Quantity:
    known = error[np.isfinite(error)]
    low, high = np.quantile(known, [0.02, 0.98]) if len(known) else (0.1, 1.0)
    high = max(float(high), 1.5 * float(low))
    # The darkest is the worst.
    return _Quantity(
        title="error to expect, root mean square",
        label="m",
        cmap=get_cmap("viridis_r"),
        norm=LogNorm(float(low), high),
    )


def _within(plan: PlanMap) -> _Quantity:
    return _Quantity(
        title=f"probability of an error below {plan.settings.threshold:g} m",
        label="probability",
        cmap=get_cmap("cividis"),
        norm=Normalize(0.0, 1.0),
    )


def _figure(table: Table, *, rows: int, columns: int) -> tuple[Figure, list[list[Axes]]]:
    """Make room for panels in the proportions of the scene, its longer side to the right."""
    size = _extent(table)[1] - _extent(table)[0]
    width = 10.0 / columns + 1.2
    height = (width - 1.4) * size.min() / size.max() + 0.55
    figure = Figure(figsize=(width * columns, height * rows + 0.7), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, [list(row) for row in figure.subplots(rows, columns, squeeze=False)]


def _extent(table: Table) -> Array:
    """Low and high corner of the scene from above, shape (2, 2), m."""
    vertices = np.asarray(table.scene.vertices)[:, :2]
    return np.stack([vertices.min(axis=0), vertices.max(axis=0)])


def _draw_panel(figure: Figure, axes: Axes, table: Table, plan: PlanMap, quantity: _Quantity, values: Array) -> None:
    low, high = _extent(table)
    along = int(np.argmax(high - low))
    order = [along, 1 - along]
    corners, grid = _grid(plan, values, order)
    no_fix = np.isposinf(grid)
    if no_fix.any():
        # Squares without a fix are outside of the colour scale.
        axes.pcolormesh(*corners, np.ma.masked_where(~no_fix, np.ones_like(grid)), cmap=_one_colour(_NO_FIX))
    shown = np.ma.masked_invalid(grid)
    mesh = axes.pcolormesh(*corners, shown, cmap=quantity.cmap, norm=quantity.norm)
    bar = figure.colorbar(mesh, ax=axes, label=quantity.label, fraction=0.03, pad=0.01)
    if isinstance(quantity.norm, LogNorm):
        bar.set_ticks(LogLocator(subs=(1.0, 2.0, 5.0)), minor=False)
        bar.set_ticks([], minor=True)
        bar.formatter = FuncFormatter(lambda value, _: f"{value:g}")
    _draw_solids(axes, table, plan.settings.height, order)
    walls = slice_mesh(table.scene.vertices, table.scene.faces, plan.settings.height)[:, :, order]
    axes.add_collection(LineCollection(list(walls), colors=_INK, linewidths=0.8))
    for station in table.site.stations:
        spot = (station.position[along], station.position[1 - along])
        axes.plot(*spot, marker="^", markersize=8, color=_PAPER, markeredgecolor=_INK, linestyle="none")
        # Labels are placed towards the centre, where there is space.
        right = spot[0] < 0.5 * (low + high)[along]
        up = (spot[1] < 0.5 * (low + high)[1 - along]) == (along == 0)
        axes.annotate(
            station.id,
            spot,
            textcoords="offset points",
            xytext=(8 if right else -8, 5 if up else -5),
            ha="left" if right else "right",
            va="bottom" if up else "top",
            fontsize=9,
            color=_INK,
            bbox={"boxstyle": "round,pad=0.15", "facecolor": _PAPER, "edgecolor": "none", "alpha": 0.8},
        )
    margin = 0.02 * float((high - low).max())
    set_plan_limits(axes, along, low - margin, high + margin)
    axes.set_xlabel(f"{'xy'[along]} [m]", fontsize=8)
    axes.set_ylabel(f"{'xy'[1 - along]} [m]", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.set_title(quantity.title, loc="left", fontsize=10, color=_INK)


def _draw_solids(axes: Axes, table: Table, height: float, order: list[int]) -> None:
    """Shade solids at this height."""
    free_space = table.scene.free_space
    layer = int((height - free_space.origin[2]) / free_space.voxel_size)
    blocked = ~np.asarray(free_space.free[:, :, layer])
    edges = [free_space.origin[i] + np.arange(blocked.shape[i] + 1) * free_space.voxel_size for i in range(2)]
    image = blocked.T if order == [0, 1] else blocked
    shaded = np.ma.masked_where(~image, np.ones(image.shape))
    axes.pcolormesh(edges[order[0]], edges[order[1]], shaded, cmap=_one_colour(_SOLID))


def _grid(plan: PlanMap, values: Array, order: list[int]) -> tuple[tuple[Array, Array], Array]:
    """Edges of the squares along both axes, and the values on the whole grid, NaN where there is no square."""
    spacing = plan.settings.spacing
    spots = plan.position[:, order]
    low = spots.min(axis=0)
    step = np.rint((spots - low) / spacing).astype(np.int64)
    shape = step.max(axis=0) + 1
    grid = np.full((shape[1], shape[0]), np.nan)
    grid[step[:, 1], step[:, 0]] = values
    edges = [low[i] + (np.arange(shape[i] + 1) - 0.5) * spacing for i in range(2)]
    return (edges[0], edges[1]), grid


def _one_colour(colour: str) -> Colormap:
    return ListedColormap([colour])


def _title(table: Table, plan: PlanMap) -> str:
    noise = plan.settings.noise
    azimuth, zenith = (f"{np.degrees(stdev):g}" for stdev in (noise.azimuth_stdev, noise.zenith_stdev))
    angles = f"angles to {azimuth} deg" if azimuth == zenith else f"azimuth to {azimuth} and zenith to {zenith} deg"
    times = "no times" if plan.settings.timing == "none" else f"{plan.settings.timing} to {noise.range_stdev:g} m"
    if plan.settings.paths is not None:
        times += f", {plan.settings.paths} paths"
    return (
        f"{table.site.name}, {table.path.name}: {angles}, {times}, {plan.settings.height:g} m high; "
        f"{plan.coverage:.1%} of fixes within {plan.settings.threshold:g} m"
    )


def _save(figure: Figure, path: str | Path, title: str) -> None:
    figure.suptitle(title, fontsize=11, color=_INK, x=0.01, ha="left")
    save_picture(figure, path)
