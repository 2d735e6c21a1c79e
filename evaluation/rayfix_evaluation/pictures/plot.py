"""Pictures of a scene and a fix, from above and from the side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import ArrayLike, NDArray

from rayfix_evaluation.pictures.files import save_picture, set_plan_limits
from rayfix_tables.table import Table

_INK, _RAY, _FIX, _RIVAL, _TRUTH, _STATION = "#2b2f36", "#3b7dd8", "#d1495b", "#e9a5ae", "#1a936f", "#2b2f36"
_TWO_SIGMA = 2.0

View = tuple[int, int]
"""Coordinates that run to the right, and up or (x) down."""


@dataclass(frozen=True, kw_only=True)
class SceneFigure:
    """A figure with the scene and its stations, seen from above and from the side.

    Attributes
    ----------
    views : tuple of (Axes, View)
    """

    figure: Figure
    table: Table
    views: tuple[tuple[Axes, View], ...]

    def finish(
        self,
        path: str | Path,
        *,
        document: Mapping[str, Any],
        truth: ArrayLike | None = None,
        handles: Sequence[Artist] = (),
    ) -> None:
        """Add title and legend, and write the picture.

        Parameters
        ----------
        path, document, truth
            As of :func:`plot_fix`.
        handles : sequence of Artist
            First entries of the legend, before labelled drawings.
        """
        found = self.views[0][0].get_legend_handles_labels()[0]
        entries = [*handles, *found]
        if entries:
            self.figure.legend(
                handles=entries,
                loc="outside lower center",
                ncols=min(len(entries), 8),
                frameon=False,
                fontsize=9,
                labelcolor=_INK,
            )
        self.figure.suptitle(_title(self.table, document, truth), fontsize=11, color=_INK, x=0.01, ha="left")
        save_picture(self.figure, path)


def make_figure(table: Table) -> SceneFigure:
    """Draw the scene and its stations."""
    bounds = np.stack([table.scene.vertices.min(axis=0), table.scene.vertices.max(axis=0)])
    extent = bounds[1] - bounds[0]
    # The longer horizontal axis runs to the right; a long hall then fills the page.
    along = int(np.argmax(extent[:2]))
    across = 1 - along
    margin = 0.04 * extent[along]
    heights = [extent[across] + 2.0 * margin, extent[2] + 2.0 * margin]
    figure = Figure(figsize=(11.0, 1.6 + 10.0 * sum(heights) / (extent[along] + 2.0 * margin)), layout="constrained")
    FigureCanvasAgg(figure)
    above, beside = figure.subplots(2, 1, height_ratios=heights)
    names = ("x", "y", "z")
    for axes, vertical, title in ((above, across, "from above"), (beside, 2, "from the side")):
        _draw_scene(axes, table, along, vertical)
        for station in table.site.stations:
            spot = (station.position[along], station.position[vertical])
            axes.plot(*spot, marker="^", markersize=8, color=_STATION, linestyle="none")
            if vertical == across:
                axes.annotate(station.id, spot, textcoords="offset points", xytext=(7, 5), color=_STATION, fontsize=9)
        axes.set_ylabel(f"{names[vertical]} [m]")
        axes.set_title(title, loc="left", fontsize=10, color=_INK)
    set_plan_limits(above, along, bounds[0] - margin, bounds[1] + margin)
    beside.set_xlim(bounds[0, along] - margin, bounds[1, along] + margin)
    beside.set_ylim(bounds[0, 2] - margin, bounds[1, 2] + margin)
    beside.set_aspect("equal")
    beside.set_xlabel(f"{names[along]} [m]")
    return SceneFigure(figure=figure, table=table, views=((above, (along, across)), (beside, (along, 2))))


def plot_fix(
    path: str | Path,
    table: Table,
    document: Mapping[str, Any],
    *,
    truth: ArrayLike | None = None,
    rays: Mapping[str, NDArray[np.float64]] | None = None,
) -> None:
    """Draw a fix in its scene and write the picture.

    Parameters
    ----------
    path : str or Path
        The suffix is the type: .png, .svg or .pdf.
    document : mapping
        Answer of the HTTP interface.
    truth : array_like of shape (3,), optional
        True position, m.
    rays : mapping of str to ndarray of shape (n, 3), optional
        Corners of the path that each station reported, m.
    """
    figure = make_figure(table)
    for axes, view in figure.views:
        _draw_paths(axes, rays or {}, view)
        draw_candidates(axes, document, view)
        if truth is not None:
            draw_truth(axes, truth, view)
    figure.finish(path, document=document, truth=truth)


def draw_candidates(axes: Axes, document: Mapping[str, Any], view: View) -> None:
    """Draw the candidates of a fix as ellipses of two standard deviations."""
    pick = list(view)
    for n, candidate in reversed(list(enumerate(document["candidates"]))):
        position = _vector(candidate["position"])[pick]
        cov = np.array(candidate["covariance_m2"])[np.ix_(pick, pick)]
        colour = _FIX if n == 0 else _RIVAL
        axes.add_patch(_ellipse(position, cov, colour, alpha=0.35 if n == 0 else 0.25))
        label = "fix, 2 sigma" if n == 0 else ("rivals" if n == 1 else None)
        axes.plot(*position, marker="o", markersize=5, color=colour, linestyle="none", label=label)


def draw_truth(axes: Axes, truth: ArrayLike, view: View) -> None:
    """Mark the true position."""
    spot = np.asarray(truth)[list(view)]
    axes.plot(*spot, marker="+", markersize=13, markeredgewidth=2, color=_TRUTH, linestyle="none", label="truth")


def _draw_paths(axes: Axes, paths: Mapping[str, NDArray[np.float64]], view: View) -> None:
    for n, corners in enumerate(paths.values()):
        axes.plot(
            corners[:, view[0]],
            corners[:, view[1]],
            color=_RAY,
            linewidth=1.1,
            alpha=0.8,
            marker=".",
            markersize=5,
            label="reported paths" if n == 0 else None,
        )


def _title(table: Table, document: Mapping[str, Any], truth: ArrayLike | None) -> str:
    if document["position"] is None:
        return f"{table.site.name}: no position ({document['status']})"
    p = document["position"]
    text = f"{table.site.name}: {document['status']} at ({p['x']:.2f}, {p['y']:.2f}, {p['z']:.2f}) m"
    if truth is not None:
        text += f", error {np.linalg.norm(np.array([p['x'], p['y'], p['z']]) - np.asarray(truth)):.2f} m"
    return text


def _draw_scene(axes: Axes, table: Table, along: int, vertical: int) -> None:
    """Shade every triangle faintly: solids appear as outlines, darker where more surfaces overlap."""
    triangles = np.asarray(table.scene.vertices)[np.asarray(table.scene.faces)]
    extent = triangles.max(axis=(0, 1)) - triangles.min(axis=(0, 1))
    size = triangles.max(axis=1) - triangles.min(axis=1)
    # The building's shell is left out, because it would shade everything.
    shell = np.all(size[:, [along, vertical]] > 0.9 * extent[[along, vertical]], axis=1)
    flat = triangles[~shell][:, :, [along, vertical]]
    axes.add_collection(PolyCollection(list(flat), facecolors=(0.43, 0.47, 0.53, 0.10), edgecolors="none"))
    axes.set_facecolor("#fbfbf9")


def _ellipse(position: NDArray[np.float64], cov: NDArray[np.float64], colour: str, alpha: float) -> Ellipse:
    values, vectors = np.linalg.eigh(cov)
    width, height = 2.0 * _TWO_SIGMA * np.sqrt(np.maximum(values[::-1], 0.0))
    angle = float(np.rad2deg(np.arctan2(vectors[1, -1], vectors[0, -1])))
    return Ellipse(tuple(position), width, height, angle=angle, facecolor=colour, edgecolor=colour, alpha=alpha)


def _vector(position: Mapping[str, float]) -> NDArray[np.float64]:
    return np.array([position["x"], position["y"], position["z"]])
