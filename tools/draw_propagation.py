"""Draw the pictures of docs/propagation.md: ``python tools/draw_propagation.py``, or ``make propagation``."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LogNorm

from rayfix.example.files import write_example
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_evaluation.truth.scene_walls import walls_of_twin
from rayfix_offline.scene.materials import complex_permittivity
from rayfix_offline.scene.slabs import slab_power
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import Twin, prepare_twin
from rayfix_service.fusion.measurements.directions import Direction
from rayfix_service.fusion.measurements.likelihood import Term
from rayfix_service.fusion.measurements.observations import Observation
from rayfix_service.fusion.product.unmodelled import unmodelled_density, unmodelled_path
from rayfix_service.fusion.settings import FusionSettings

mpl.use("Agg")
import matplotlib.pyplot as plt

DOCS = Path(__file__).resolve().parent.parent / "docs"
CARRIER_GHZ = 3.5
SLABS = {"plasterboard": 0.025, "glass": 0.012, "wood": 0.04, "brick": 0.1, "concrete": 0.2}
"""Thickness of walls, m."""

COLOURS = ("#1d4ed8", "#15803d", "#c2410c", "#7e22ce", "#22303c")
STATION, HEIGHT = "ap3", 1.2
GRID = 0.25  # m, between the places of the maps


def draw_slabs(figure: Any) -> None:
    """Draw what is reflected and what passes, by the angle of incidence."""
    angle = np.linspace(0.0, 85.0, 300)
    passing, reflecting = figure.subplots(1, 2, sharey=True)
    for colour, (name, thickness) in zip(COLOURS, SLABS.items(), strict=True):
        reflected, passed = slab_power(
            np.cos(np.deg2rad(angle)),
            complex_permittivity(name, CARRIER_GHZ),
            thickness,
            carrier_ghz=CARRIER_GHZ,
        )
        label = f"{name}, {1e3 * thickness:.0f} mm"
        passing.plot(angle, 10.0 * np.log10(passed), color=colour, label=label)
        reflecting.plot(angle, 10.0 * np.log10(reflected), color=colour, label=label)
    for axes, title in ((passing, "passes"), (reflecting, "is reflected")):
        axes.set(title=title, xlabel="angle of incidence, deg", ylim=(-40.0, 0.0), xlim=(0.0, 85.0))
        axes.grid(alpha=0.3)
    passing.set_ylabel(f"share of the power at {CARRIER_GHZ} GHz, dB")
    reflecting.legend(fontsize=8, loc="lower left")


def draw_office(figure: Any) -> None:
    """Draw the strongest path of a station of the bundled office, with opaque walls and with others."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_example(folder, example="office")
        twin = prepare_twin(read_site(path), path.parent)
    station = next(s for s in twin.site.stations if s.id == STATION).position_m
    low, high = twin.scene.bounds
    x, y = (np.arange(low[i] + 0.5 * GRID, high[i], GRID) for i in (0, 1))
    places = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((len(x), len(y)), HEIGHT)], axis=-1)
    free = twin.free_space.contains(places)
    for axes, passed in zip(figure.subplots(1, 2), (False, True), strict=True):
        solver = _solver(twin, passed=passed).station(station)
        gain = np.full(free.shape, np.nan)
        for i, j in np.argwhere(free):
            paths = solver.paths(places[i, j])
            if len(paths):
                gain[i, j] = paths.gain_db.max()
        image = axes.imshow(
            gain.T, origin="lower", extent=(low[0], high[0], low[1], high[1]), vmin=-60.0, vmax=0.0, cmap="viridis"
        )
        axes.plot(*station[:2], "o", color="#b91c1c", ms=7, mec="white")
        reached = np.isfinite(gain[free]).mean()
        name = "walls let signals through" if passed else "opaque walls"
        axes.set(title=f"{name}: a path to {reached:.0%} of the floor", xlabel="x, m", ylabel="y, m")
    figure.colorbar(image, ax=figure.axes, label="strongest path, dB (0 dB: 1 m away)", shrink=0.8)


def _solver(twin: Twin, *, passed: bool) -> ForwardSolver:
    """Make a solver of the twin's triangles, with one reflection."""
    walls = walls_of_twin(twin)
    if not passed:
        opaque = np.full(len(walls.thickness), np.nan)
        walls = type(walls)(
            **{**vars(walls), "thickness": opaque, "transmission_loss_db": np.full(len(opaque), np.inf)}
        )
    return ForwardSolver.from_mesh(twin.scene.vertices, twin.scene.faces, max_reflections=1, walls=walls)


def draw_unmodelled(figure: Any) -> None:
    """Draw where a path that the table does not know says that the target is."""
    settings = FusionSettings(unmodelled_without_length=FusionSettings.unmodelled_probability)
    x, y = np.linspace(-1.0, 14.0, 300), np.linspace(-6.0, 6.0, 240)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    both = figure.subplots(1, 2, sharey=True)
    for axes, length in zip(both, (10.0, None), strict=True):
        lengths: tuple[tuple[Term, ...], ...] = () if length is None else ((Term(0.0, length, 0.25),),)
        seen = Observation("a", Direction(azimuth=0.0, zenith=0.5 * np.pi, cov=3e-4 * np.eye(2)), lengths=lengths)
        terms = [(0.0, length, 0.25)] if length is not None else []
        path = unmodelled_path(seen, terms, np.zeros(3), -np.log(60.0), settings)
        assert path is not None
        density = np.array([[unmodelled_density(tuple(path), *place, 0.0, 0.0)[0] for place in row] for row in places])
        outlier = 0.01 / (4.0 * np.pi) / 60.0
        shown = axes.contourf(
            x,
            y,
            density.T / outlier,
            levels=np.logspace(-2, 4, 13),
            norm=LogNorm(1e-2, 1e4),
            cmap="magma_r",
            extend="both",
        )
        axes.plot(0.0, 0.0, "o", color="#1d4ed8", ms=7)
        axes.annotate("", (13.5, 0.0), (0.3, 0.0), arrowprops={"arrowstyle": "->", "color": "#1d4ed8", "lw": 1.2})
        # The arc is where the straight path would end.
        what = "direction alone" if length is None else f"direction, and a length of {length:.0f} m (0.5 m)"
        axes.set(title=what, xlabel="m", aspect="equal", xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
        if length is not None:
            axes.add_patch(plt.Circle((0.0, 0.0), length, fill=False, color="#1d4ed8", ls=":", lw=1.0))
    both[0].set_ylabel("m")
    figure.colorbar(shown, ax=both, label="density / that of an outlier", shrink=0.8, ticks=[1e-2, 1, 1e2, 1e4])


Draw = Callable[[Any], None]
PICTURES: tuple[tuple[str, Draw, tuple[float, float]], ...] = (
    ("propagation-slabs.svg", draw_slabs, (10.0, 4.0)),
    ("propagation-office.png", draw_office, (12.0, 4.2)),
    ("propagation-unmodelled.png", draw_unmodelled, (11.0, 4.0)),
)


def main() -> None:
    """Write the pictures."""
    with mpl.rc_context({"svg.hashsalt": "rayfix", "svg.fonttype": "path"}):
        for name, draw, size in PICTURES:
            figure = plt.figure(figsize=size, layout="constrained")
            draw(figure)
            metadata: dict[str, Any] = {"Date": None} if name.endswith(".svg") else {"Software": None}
            figure.savefig(DOCS / name, metadata=metadata, facecolor="white", dpi=110)
            plt.close(figure)


if __name__ == "__main__":
    main()
