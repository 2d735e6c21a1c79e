"""Static 3D pictures of the scene with points and mixtures, and of rays in the plane."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform
from numpy.typing import NDArray

from rayfix_evaluation.pictures.files import set_plan_limits
from rayfix_evaluation.report.geometry import Backdrop, ellipsoids, unit_sphere
from rayfix_evaluation.report.style import INK, MUTED, STATIONS, new_figure

__all__ = ["plane_picture", "space_picture"]

Array = NDArray[np.float64]
Pictures = Mapping[str, Any]

TRUTH, FIX, ESTIMATE = "#1a936f", "#d1495b", "#7c3aed"
"""Colours of the true position, of rayfix's and of the paper's method's."""

_SOLID = "#9aa3af"
_ROOM, _MIDDLE = np.array([0.92, 0.76]), np.array([0.5, 0.52])
"""Fraction of a figure that a 3D view takes up, and its centre."""


def space_picture(scene: Backdrop, pictures: Pictures, show: str) -> Figure:
    """Draw the scene in three dimensions.

    Parameters
    ----------
    show : {"scene", "points_aoa", "points_pt", "mixture_aoa", "mixture_pt"}
        Content in addition to stations and transmitter: the reported paths, points on rays, or fitted mixtures.
    """
    width, height = 8.8, 4.6
    figure = new_figure(width, height)
    figure.set_layout_engine("none")
    # A 3D view is drawn into a square and clipped at its sides; the square is as wide as the figure, and higher.
    tall = width / height
    axes: Any = figure.add_axes((0.0, 0.5 - 0.5 * tall, 1.0, tall), projection="3d")
    extent = scene.high - scene.low
    # The longer horizontal axis runs along the page.
    swap = extent[1] > extent[0]

    def placed(points: Any) -> Array:
        array = np.asarray(points, np.float64)
        return array[..., [1, 0, 2]] * [1, -1, 1] if swap else array

    axes.add_collection3d(
        Poly3DCollection(placed(scene.triangles), facecolors=_SOLID, alpha=0.16, linewidths=0, rasterized=True)
    )
    axes.add_collection3d(Line3DCollection(placed(scene.box_edges()), colors=MUTED, linewidths=0.6))
    colours = {station["id"]: STATIONS[n % len(STATIONS)] for n, station in enumerate(pictures["stations"])}
    for name, spot in scene.stations.items():
        point = placed(spot)
        axes.plot(*point[:, None], marker="^", markersize=7, color=colours.get(name, MUTED), linestyle="none")
        axes.text(point[0], point[1], point[2] + 0.06 * extent.max(), name, color=INK, fontsize=8.5, ha="center")
    for station in pictures["stations"]:
        colour = colours[station["id"]]
        if show == "scene":
            path = placed(station["path"])
            axes.plot(*path.T, color=colour, linewidth=1.3, marker=".", markersize=4)
            if station["walls"]:
                dots = placed(station["crossings"])
                axes.plot(*dots.T, color=colour, linestyle="none", marker="s", markersize=4, fillstyle="none")
        elif show.startswith("points"):
            points = placed(station[show]).reshape(-1, 3)
            axes.plot(*points.T, ".", color=colour, markersize=2.2, alpha=0.6, rasterized=True)
        else:
            _draw_ellipsoids(axes, station[show], colour, placed)
    kind = "pt" if show.endswith("pt") else "aoa"
    estimate = None if show == "scene" else pictures["estimates"][kind]
    if estimate is not None and show.startswith("mixture"):
        _mark(axes, placed(estimate), "x", ESTIMATE, "arg max of the product")
    _mark(axes, placed(pictures["truth"]), "+", TRUTH, "true position")
    corners = placed(np.stack([scene.low, scene.high]))
    low, high = corners.min(axis=0), corners.max(axis=0)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.view_init(elev=32, azim=-62)
    axes.set_axis_off()
    _fit(axes, high - low, placed(scene.box_edges()).reshape(-1, 3))
    figure.legend(loc="lower center", ncols=3)
    return figure


def plane_picture(scene: Backdrop, pictures: Pictures) -> Figure:
    """Draw rays from above, where they cross the plane of the transmitter, and contours of the fitted 2D mixtures."""
    extent = scene.high - scene.low
    along = int(np.argmax(extent[:2]))
    pick = [along, 1 - along]
    height = 10.0 * extent[1 - along] / extent[along]
    figure = new_figure(10.4, min(max(height, 3.0), 9.0) + 0.9)
    axes = figure.subplots()
    flat = scene.triangles[:, :, pick]
    axes.add_collection(PolyCollection(list(flat), facecolors=_SOLID, alpha=0.10, edgecolors="none", rasterized=True))
    x = np.linspace(scene.low[pick[0]], scene.high[pick[0]], 420)
    y = np.linspace(scene.low[pick[1]], scene.high[pick[1]], 260)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    for n, station in enumerate(pictures["stations"]):
        colour = STATIONS[n % len(STATIONS)]
        rays = [np.array(ray)[:, pick] for ray in station["rays"]]
        axes.add_collection(LineCollection(rays, colors=colour, linewidths=0.5, alpha=0.28))
        points = np.array(station["plane_points"]).reshape(-1, 2)
        # Crossings are (x, y), whichever axis runs along the page.
        axes.plot(*points[:, pick].T, ".", color=colour, markersize=2.4, alpha=0.7, rasterized=True)
        if station["mixture_plane"] is not None:
            _contours(axes, station["mixture_plane"], grid, pick, colour)
        spot = scene.stations[station["id"]]
        axes.plot(*spot[pick], marker="^", markersize=8, color=colour, linestyle="none")
        axes.annotate(station["id"], tuple(spot[pick]), textcoords="offset points", xytext=(7, 5), fontsize=9)
    if pictures["estimates"]["plane"] is not None:
        spot = np.array(pictures["estimates"]["plane"])[pick]
        axes.plot(*spot, "x", color=ESTIMATE, markersize=9, markeredgewidth=2, label="arg max of the product")
    truth = np.array(pictures["truth"])[pick]
    axes.plot(*truth, "+", color=TRUTH, markersize=13, markeredgewidth=2, label="true position")
    set_plan_limits(axes, along, scene.low, scene.high)
    axes.grid(visible=False)
    axes.set_xlabel(f"{'xy'[pick[0]]} [m]")
    axes.set_ylabel(f"{'xy'[pick[1]]} [m]")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def _fit(axes: Any, extent: Array, corners: Array) -> None:
    """Zoom and shift a 3D view to fill the figure above the legend."""
    axes.set_box_aspect(extent)
    for zoom in (1.0, None):
        x, y, _ = proj_transform(*corners.T, axes.get_proj())
        spots = axes.figure.transFigure.inverted().transform(axes.transData.transform(np.stack([x, y], axis=-1)))
        low, high = spots.min(axis=0), spots.max(axis=0)
        if zoom is not None:
            axes.set_box_aspect(extent, zoom=zoom * float(np.min(_ROOM / (high - low))))
    box = axes.get_position(original=True)
    shift = _MIDDLE - 0.5 * (low + high)
    axes.set_position((box.x0 + shift[0], box.y0 + shift[1], box.width, box.height))


def _draw_ellipsoids(axes: Any, mixture: Any, colour: str, placed: Any) -> None:
    sphere, faces = unit_sphere()
    found = list(ellipsoids(mixture))
    heaviest = max((weight for weight, _, _ in found), default=1.0)
    for weight, centre, root in found:
        shell = placed(centre + sphere @ root.T)[faces]
        alpha = 0.05 + 0.25 * weight / heaviest
        axes.add_collection3d(Poly3DCollection(shell, facecolors=colour, alpha=alpha, linewidths=0, rasterized=True))


def _contours(axes: Any, mixture: Any, grid: Array, pick: list[int], colour: str) -> None:
    density = np.zeros(grid.shape[:2])
    for weight, mean, cov in zip(mixture["weight"], mixture["mean"], mixture["cov"], strict=True):
        apart = grid - np.array(mean)[pick]
        ordered = np.array(cov)[np.ix_(pick, pick)]
        square = np.einsum("...i,ij,...j->...", apart, np.linalg.inv(ordered), apart)
        density += weight * np.exp(-0.5 * square) / np.sqrt(np.linalg.det(2.0 * np.pi * ordered))
    # Density levels that enclose 50, 80 and 95 % of the mixture.
    falling = np.sort(density.ravel())[::-1]
    held = np.cumsum(falling) / falling.sum()
    levels = sorted({float(falling[np.searchsorted(held, share)]) for share in (0.5, 0.8, 0.95)})
    axes.contour(grid[..., 0], grid[..., 1], density, levels=levels, colors=colour, linewidths=1.0)


def _mark(axes: Any, point: Array, marker: str, colour: str, label: str) -> None:
    axes.plot(
        *point[:, None],
        marker=marker,
        color=colour,
        markersize=12,
        markeredgewidth=2.4,
        linestyle="none",
        label=label,
        zorder=10,
    )
