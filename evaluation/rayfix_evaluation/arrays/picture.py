"""Picture of angle errors."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from rayfix_evaluation.arrays.statistics import AngleErrors
from rayfix_evaluation.arrays.study import ArrayStudy
from rayfix_evaluation.pictures.files import save_picture

_INK = "#2b2f36"
_COLOURS = ("#3b7dd8", "#e08e2b", "#1a936f", "#d1495b")
_DASHES = ("-", "--", "-.", ":")


def draw_angle_errors(path: str | Path, studies: Mapping[str, tuple[ArrayStudy, Mapping[str, AngleErrors]]]) -> None:
    """Draw the distribution of each estimator's errors, one panel for each study.

    Parameters
    ----------
    path : str or Path
        The suffix is the type: .png, .svg or .pdf.
    studies : mapping of str to (ArrayStudy, mapping of str to AngleErrors)
        Studies by title of the panel.
    """
    figure = Figure(figsize=(4.6 * len(studies), 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    (panels,) = figure.subplots(1, len(studies), sharey=True, squeeze=False)
    for axes, (title, (study, errors)) in zip(panels, studies.items(), strict=True):
        for n, (name, each) in enumerate(errors.items()):
            ordered = np.degrees(np.sort(each.apart))
            share = (np.arange(len(ordered)) + 1.0) / len(ordered)
            axes.plot(ordered, share, label=name, color=_COLOURS[n % 4], linestyle=_DASHES[n % 4], linewidth=1.8)
        axes.axvline(np.degrees(study.limit), color=_INK, linewidth=0.8, alpha=0.6)
        axes.annotate(
            "beam width",
            (np.degrees(study.limit), 0.02),
            textcoords="offset points",
            xytext=(4, 0),
            fontsize=8,
            color=_INK,
        )
        axes.set_xscale("log")
        axes.set_xlim(0.005, 180.0)
        axes.set_ylim(0.0, 1.0)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.grid(alpha=0.25)
        axes.set_xlabel("angle to the strongest path [deg]")
        axes.set_title(title, loc="left", fontsize=10, color=_INK)
    panels[0].set_ylabel("fraction of reports")
    panels[0].legend(frameon=False, fontsize=9, loc="upper left")
    save_picture(figure, path)
