"""Style of figures, and writing their files."""

import io
import re
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rayfix_evaluation.studies.store import write_bytes, write_text

__all__ = ["METHOD_COLOURS", "SERIES", "STATIONS", "inline_svg", "new_figure", "percent_axis", "write_figure"]

INK, MUTED, GRID, PAPER = "#23272f", "#6b7280", "#d8dce3", "#fffffe"
"""Colours that the page replaces by those of its light or dark scheme."""

_VARIABLES = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--rule)", PAPER: "none"}

SERIES = ("#0f9d8f", "#3f7fd9", "#9b5de5", "#d1495b", "#e08a1e")
"""Colours of an ordered quantity."""

_SCALE = 1.45
"""Largest number of pixels on the page per point of a figure."""

STATIONS = ("#3f7fd9", "#e08a1e", "#1a936f", "#b5179e", "#8d6e63", "#00897b", "#c0392b", "#5e60ce")
"""Colours of stations, used again where there are more of them."""

METHOD_COLOURS = {
    "rayfix": "#d1495b",
    "rayfix-uniform": "#e58b97",
    "rayfix-paper": "#efb5bc",
    "paper": "#3f7fd9",
    "paper-table": "#7fb0ef",
    "planar": "#0f9d8f",
    "reverse-rays": "#9b5de5",
    "los-angles": "#e08a1e",
    "los-ranges": "#b9770e",
    "los-differences": "#8d6e63",
    "los-robust": "#c2580a",
    "fingerprints": "#6b8e23",
}

_STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.size": 9.5,
    "text.color": INK,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.7,
    "svg.fonttype": "none",
    "svg.hashsalt": "rayfix",
    "figure.facecolor": PAPER,
    "savefig.facecolor": PAPER,
}


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches; call within :func:`styled`."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def styled() -> AbstractContextManager[None]:
    """Return the context in which figures are drawn and written."""
    return mpl.rc_context(_STYLE)  # type: ignore[arg-type]  # its keys are a Literal of hundreds


def percent_axis(axes: Axes) -> None:
    """Format the vertical axis for fractions, with lines at the median and the 90th percentile."""
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks([0.0, 0.25, 0.5, 0.75, 0.9, 1.0], ["0", "25", "50", "75", "90", "100 %"])


def write_figure(figure: Figure, stem: Path) -> None:
    """Write a figure as SVG and PNG.

    Raises
    ------
    RayfixError
        When they cannot be written.
    """
    drawn, picture = io.StringIO(), io.BytesIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None}, dpi=110)
    # A hundredth of a point is enough, and half of the file.
    write_text(stem.with_suffix(".svg"), re.sub(r"(\d\.\d\d)\d+", r"\1", drawn.getvalue()))
    figure.savefig(picture, format="png", dpi=140)
    write_bytes(stem.with_suffix(".png"), picture.getvalue())


def inline_svg(path: Path) -> str:
    """SVG of a file for inclusion in a page: without header, with the page's colours and unique ids."""
    text = path.read_text(encoding="utf-8")
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, variable)
    name = path.stem
    text = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{name}-\1"', text)
    # The page sets the size, up to the figure's own width; the view box keeps the proportions.
    head, rest = text.split(">", 1)
    width = float(re.findall(r'\bwidth="([\d.]+)pt"', head)[0])
    head = re.sub(r'\s(width|height)="[^"]*"', "", head)
    return f'{head} style="max-width:{_SCALE * width:.0f}px" role="img">{rest}'
