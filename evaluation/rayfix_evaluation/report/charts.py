"""Charts of results: distributions of the error, percentiles by method, curves, calibration, differences of length."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from rayfix_evaluation.report.style import GRID, INK, METHOD_COLOURS, MUTED, SERIES, new_figure, percent_axis
from rayfix_evaluation.studies.methods import METHODS

__all__ = [
    "arrays_chart",
    "calibration_chart",
    "cdf_by_noise",
    "curve_chart",
    "differences_chart",
    "methods_cdf",
    "percentiles_chart",
    "reflections_chart",
]

Document = Mapping[str, Any]

_DASHES: dict[str, Any] = {"rayfix": "-", "paper": (0, (4, 2))}
_LOW, _HIGH = 0.008, 20.0  # m, of the axes of errors
_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


def cdf_by_noise(panels: Sequence[tuple[str, Sequence[tuple[str, Document]]]]) -> Figure:
    """Distributions of the error of rayfix and of the paper's method, a colour for each noise.

    Parameters
    ----------
    panels : sequence of (title, points)
        Points are a label and the methods of the point.
    """
    figure = new_figure(4.8 * len(panels), 3.7)
    for axes, (title, points) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for colour, (label, methods) in zip(SERIES[-len(points) :], points, strict=False):
            for method, dash in _DASHES.items():
                _cdf(axes, methods[method]["error_m"], colour, dash, label if method == "rayfix" else None)
        _error_axis(axes)
        percent_axis(axes)
        axes.set_title(title)
        first = axes.legend(loc="upper left")
        axes.add_artist(first)
        axes.legend(
            handles=[Line2D([], [], color=INK, linestyle=_DASHES[m], label=METHODS[m].label) for m in _DASHES],
            loc="lower right",
        )
    return figure


def methods_cdf(points: Sequence[Document]) -> Figure:
    """Distributions of the error of all methods, a panel for each point."""
    figure = new_figure(11.2, 4.6)
    panels = figure.subplots(1, len(points), sharey=True)
    for axes, point in zip(np.atleast_1d(panels), points, strict=True):
        _cdf(axes, point["bound"]["bound_m"], MUTED, ":", None)
        for key, method in point["methods"].items():
            strong = key in ("rayfix", "paper")
            _cdf(axes, method["error_m"], METHOD_COLOURS[key], "-", None, width=2.3 if strong else 1.2)
        _error_axis(axes)
        percent_axis(axes)
        axes.set_title(point["label"])
    used = [key for key in METHODS if any(key in point["methods"] for point in points)]
    handles = [Line2D([], [], color=METHOD_COLOURS[key], label=METHODS[key].label) for key in used]
    handles.append(Line2D([], [], color=MUTED, linestyle=":", label="position error bound"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def percentiles_chart(points: Sequence[Document]) -> Figure:
    """Median and 90th percentile of all methods with their intervals, a panel for each point."""
    keys = [key for key in METHODS if any(key in point["methods"] for point in points)]
    figure = new_figure(11.2, 1.3 + 0.28 * (len(keys) + 1))
    panels = figure.subplots(1, len(points), sharey=True)
    rows = {key: len(keys) - n for n, key in enumerate(keys)}
    for axes, point in zip(np.atleast_1d(panels), points, strict=True):
        for key, method in point["methods"].items():
            for name, filled in (("p50", True), ("p90", False)):
                _interval(axes, method[name], rows[key], METHOD_COLOURS[key], filled)
        for name, filled in (("p50", True), ("p90", False)):
            value = point["bound"][name]
            _interval(axes, [value, value, value], 0, MUTED, filled)
        _error_axis(axes)
        axes.set_title(point["label"])
        axes.set_yticks([*rows.values(), 0], [*(METHODS[key].label for key in rows), "position error bound"])
        axes.set_ylim(-0.6, len(keys) + 0.6)
        axes.grid(axis="y", visible=False)
    figure.legend(
        handles=[
            Line2D([], [], color=INK, marker="o", linestyle="none", label="50th percentile"),
            Line2D([], [], color=INK, marker="o", markerfacecolor="none", linestyle="none", label="90th percentile"),
        ],
        loc="outside lower center",
        ncols=2,
    )
    return figure


def curve_chart(study: Document) -> Figure:
    """Median and 90th percentile along a study's axis, or for its points if it has no axis."""
    figure = new_figure(5.0, 3.7)
    axes = figure.subplots()
    points = study["points"]
    keys = [key for key in METHODS if any(key in point["methods"] for point in points)]
    if study["axis"]:
        for key in keys:
            own = sorted((point["x"], point["methods"][key]) for point in points if key in point["methods"])
            _curve(axes, own, METHOD_COLOURS.get(key, SERIES[0]))
        axes.set_xlabel(study["axis"])
        _place_x(axes, sorted({point["x"] for point in points}))
    else:
        for n, key in enumerate(keys):
            shift = 0.16 * (n - 0.5 * (len(keys) - 1))
            for place, point in enumerate(points):
                if key in point["methods"]:
                    for name, filled in (("p50", True), ("p90", False)):
                        _upright(axes, point["methods"][key][name], place + shift, METHOD_COLOURS[key], filled)
        axes.set_xticks(range(len(points)), [point["label"].replace(", ", "\n") for point in points])
        axes.grid(axis="x", visible=False)
    axes.set_yscale("log")
    axes.set_yticks(_TICKS, [_metres(t) for t in _TICKS])
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("error")
    _fit_heights(axes, [point["methods"][key] for point in points for key in point["methods"]])
    handles = [Line2D([], [], color=METHOD_COLOURS[key], label=METHODS[key].label) for key in keys]
    solid, dashed = (
        ({"linestyle": "-"}, {"linestyle": "--"})
        if study["axis"]
        else ({"marker": "o", "linestyle": "none"}, {"marker": "o", "linestyle": "none", "markerfacecolor": "none"})
    )
    handles.append(Line2D([], [], color=INK, label="50th", **solid))  # type: ignore[arg-type]
    handles.append(Line2D([], [], color=INK, label="90th percentile", **dashed))  # type: ignore[arg-type]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def reflections_chart(study: Document) -> Figure:
    """Median and 90th percentile by the number of reflections that the world has more than the table."""
    figure = new_figure(5.0, 3.7)
    axes = figure.subplots()
    for place, point in enumerate(study["points"]):
        (summary,) = point["methods"].values()
        for name, filled in (("p50", True), ("p90", False)):
            _upright(axes, summary[name], place, METHOD_COLOURS["rayfix"], filled)
    for name, style in (("p50", "-"), ("p90", "--")):
        values = [next(iter(point["methods"].values()))[name][0] for point in study["points"]]
        axes.plot(range(len(values) - 1), values[:-1], style, color=METHOD_COLOURS["rayfix"], linewidth=1.2)
    axes.set_xticks(range(len(study["points"])), [point["label"].replace(", ", "\n") for point in study["points"]])
    axes.set_xlabel("reflections that the table and the world have")
    axes.set_yscale("log")
    axes.set_yticks(_TICKS, [_metres(t) for t in _TICKS])
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("error")
    _fit_heights(axes, [summary for point in study["points"] for summary in point["methods"].values()])
    figure.legend(
        handles=[
            Line2D([], [], color=METHOD_COLOURS["rayfix"], marker="o", label="50th"),
            Line2D(
                [],
                [],
                color=METHOD_COLOURS["rayfix"],
                marker="o",
                markerfacecolor="none",
                linestyle="--",
                label="90th percentile",
            ),
        ],
        loc="outside lower center",
        ncols=2,
    )
    return figure


def calibration_chart(curves: Sequence[tuple[str, Document, int]]) -> Figure:
    """Draw the fraction of true positions within ellipsoids against the stated probability.

    Parameters
    ----------
    curves : sequence of (label, coverage, drops)
        Coverage by the stated probability.
    """
    figure = new_figure(5.4, 4.2)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=MUTED, linewidth=1.0, linestyle=":")
    count = max(drops for _, _, drops in curves)
    stated = np.linspace(0.0, 1.0, 101)
    reach = 1.96 * np.sqrt(stated * (1.0 - stated) / count)
    axes.fill_between(stated, stated - reach, stated + reach, color=GRID, alpha=0.6, linewidth=0)
    for colour, (label, coverage, _) in zip(SERIES, curves, strict=False):
        axes.plot([float(p) for p in coverage], list(coverage.values()), "o-", color=colour, markersize=4, label=label)
    axes.set_xlabel("stated probability of the ellipsoid")
    axes.set_ylabel("fraction of true positions within")
    axes.set_xlim(0.4, 1.0)
    axes.set_ylim(0.2, 1.02)
    axes.legend(loc="lower right")
    return figure


def differences_chart(document: Document) -> Figure:
    """Table of length differences of pairs of points; those that agree with the measured difference are marked."""
    difference, agrees = np.array(document["difference_m"]), np.array(document["agrees"], bool)
    rows, columns = difference.shape
    figure = new_figure(1.9 + 0.66 * columns, 1.3 + 0.36 * rows)
    axes = figure.subplots()
    axes.set_xlim(-0.5, columns - 0.5)
    axes.set_ylim(rows - 0.5, -0.5)
    for i in range(rows):
        for j in range(columns):
            if agrees[i, j]:
                axes.fill_between([j - 0.5, j + 0.5], i - 0.5, i + 0.5, color=SERIES[0], alpha=0.35, linewidth=0)
            weight = "bold" if agrees[i, j] else "normal"
            axes.text(j, i, f"{difference[i, j]:.2f}", ha="center", va="center", fontsize=8.5, fontweight=weight)
    axes.set_xticks(range(columns), [f"{v:.2f}" for v in document["column_lengths_m"]])
    axes.set_yticks(range(rows), [f"{v:.2f}" for v in document["row_lengths_m"]])
    axes.xaxis.tick_top()
    axes.xaxis.set_label_position("top")
    axes.set_xlabel(f"path length of points of {document['columns']} [m]")
    axes.set_ylabel(f"path length of points of {document['rows']} [m]")
    axes.grid(visible=False)
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return figure


def arrays_chart(arrays: Sequence[Document]) -> Figure:
    """Distributions of the angle between the estimated and the strongest path's direction, a panel for each array."""
    figure = new_figure(4.8 * len(arrays), 3.7)
    panels = figure.subplots(1, len(arrays), sharey=True, squeeze=False)[0]
    for axes, array in zip(panels, arrays, strict=True):
        for colour, (name, found) in zip(SERIES, array["estimators"].items(), strict=False):
            apart = np.array(found["apart_deg"])
            axes.step(apart, np.arange(1, len(apart) + 1) / max(len(apart), 1), color=colour, label=name, where="post")
        axes.axvline(array["beam_width_deg"], color=MUTED, linewidth=1.0, linestyle=":")
        axes.set_xscale("log")
        axes.set_xlim(0.01, 180.0)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xlabel("angle to the strongest path [deg]")
        axes.set_title(f"{array['label']}, {array['snr_db']:g} dB")
        percent_axis(axes)
        axes.legend(loc="upper left")
    return figure


def _cdf(
    axes: Axes, errors: Sequence[float | None], colour: str, style: Any, label: str | None, width: float = 1.7
) -> None:
    known = np.sort([e for e in errors if e is not None])
    share = np.arange(1, len(known) + 1) / len(errors)
    # Drops without a position are not counted: the curve ends below 100 %.
    x = np.concatenate([[_LOW], np.clip(known, _LOW, _HIGH), [_HIGH]])
    y = np.concatenate([[0.0], share, share[-1:] if len(share) else [0.0]])
    axes.step(x, y, where="post", color=colour, linestyle=style, label=label, linewidth=width)


def _error_axis(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_xlim(_LOW, _HIGH)
    axes.set_xticks(_TICKS[::1], ["1 cm", "", "5 cm", "", "20 cm", "", "1 m", "", "5 m", ""])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("error")


def _interval(axes: Axes, values: Sequence[float | None], row: float, colour: str, filled: bool) -> None:
    value, low, high = (_HIGH if v is None else min(v, _HIGH) for v in values)
    axes.plot([low, high], [row, row], color=colour, linewidth=1.2, alpha=0.7)
    marker = ">" if values[0] is None or values[0] > _HIGH else "o"
    axes.plot(value, row, marker, color=colour, markersize=5.5, markerfacecolor=colour if filled else "none")


def _upright(axes: Axes, values: Sequence[float | None], place: float, colour: str, filled: bool) -> None:
    value, low, high = (_HIGH if v is None else v for v in values)
    axes.plot([place, place], [low, high], color=colour, linewidth=1.2, alpha=0.7)
    axes.plot(place, value, "o", color=colour, markersize=5.5, markerfacecolor=colour if filled else "none")


def _curve(axes: Axes, points: Sequence[tuple[float, Document]], colour: str) -> None:
    x = [at for at, _ in points]
    for name, style in (("p50", "-"), ("p90", "--")):
        values = np.array([[np.nan if v is None else v for v in summary[name]] for _, summary in points])
        axes.plot(x, values[:, 0], style, color=colour, marker="o", markersize=3.5)
        axes.fill_between(x, values[:, 1], values[:, 2], color=colour, alpha=0.13, linewidth=0)


def _place_x(axes: Axes, places: Sequence[float]) -> None:
    """Ticks at the points; a logarithmic axis if each is a multiple of the one before."""
    if min(places) > 0 and max(places) >= 8 * min(places):
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xticks(places, [f"{x:g}" for x in places])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _fit_heights(axes: Axes, summaries: Sequence[Document]) -> None:
    values = [v for summary in summaries for name in ("p50", "p90") for v in summary[name] if v is not None]
    if values:
        axes.set_ylim(0.8 * min(values), 1.25 * max(values))


def _metres(value: float) -> str:
    return f"{100 * value:g} cm" if value < 1.0 else f"{value:g} m"
