"""The report as one self-contained HTML page; its templates are in ``templates``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from rayfix_evaluation.report.captions import length, share
from rayfix_evaluation.report.figures import Spec, study_of
from rayfix_evaluation.report.interactive import plotly_script
from rayfix_evaluation.report.style import inline_svg
from rayfix_evaluation.studies.evaluate import Evaluation
from rayfix_evaluation.studies.methods import METHODS

__all__ = ["render_page"]

_DASH = "\N{EN DASH}"

_METHOD_FIGURES = (
    "scene",
    "plane-points",
    "points-aoa",
    "mixture-aoa",
    "points-aoa-pt",
    "mixture-aoa-pt",
    "length-differences",
)

_SECTIONS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("statements", "The paper's statements, tested here", ()),
    ("site", "The site and the drops", ()),
    ("method", "From angles and times to a position", _METHOD_FIGURES),
    ("noise", "Accuracy by measurement noise", ("cdf-aoa", "cdf-pt", "cdf-rpt")),
    ("methods", "Methods side by side", ("methods-percentiles", "methods-cdf")),
    ("calibration", "Stated and actual uncertainty", ("calibration",)),
    ("planning", "Accuracy over the floor", ("planning",)),
    ("arrays", "Angle errors of antenna arrays", ("antenna-arrays",)),
    ("stress", "Robustness", ()),
    ("made", "How to reproduce this page", ()),
)
"""Sections of the page: name of the template, title, and figures. Figures of stress curves are in that section."""


@dataclass(frozen=True, kw_only=True)
class _Figure:
    """A figure for the templates; ``data`` is the JSON of its interactive picture, if it has one."""

    key: str
    title: str
    caption: str
    svg: Markup
    data: Markup | None


@dataclass(frozen=True, kw_only=True)
class _Section:
    key: str
    title: str
    keys: tuple[str, ...]
    figures: tuple[_Figure, ...]

    @property
    def template(self) -> str:
        return f"{self.key}.html"


def render_page(
    evaluation: Evaluation, specs: Sequence[Spec], interactive: Mapping[str, str], figures: Path, command: str
) -> str:
    """Render the page.

    Parameters
    ----------
    interactive : mapping of str to str
        JSON of Plotly figures by the keys of figures.
    figures : Path
        Folder of the written SVGs.
    command : str
        Command line of the evaluation.
    """
    results = evaluation.results
    drawn = {spec.key: _figure(spec, interactive, figures) for spec in specs}
    study = study_of(results, "methods")
    return (
        _environment()
        .get_template("page.html")
        .render(
            results=results,
            methods=METHODS,
            figures=drawn,
            sections=[_section(*section, drawn) for section in _SECTIONS],
            base=study["points"][0],
            methods_study=study,
            noise_studies=[study_of(results, key) for key in ("cdf-aoa", "cdf-pt", "cdf-rpt")],
            used_methods=[key for key in METHODS if any(key in point["methods"] for point in study["points"])],
            stated_probabilities=_stated_probabilities(study),
            times=evaluation.timings["studies"]["methods"],
            site_rows=_site_rows(evaluation),
            made_rows=_made_rows(results),
            command=command,
            style=Markup(_asset("page.css")),
            script=Markup(_asset("page.js")),
            plotly=Markup(plotly_script()),
        )
    )


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("rayfix_evaluation.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "length_text": length,
        "share": share,
        "interval": _interval,
        "number": _number,
        "milliseconds": _milliseconds,
        "plain": "{:g}".format,
    }
    return environment


def _asset(name: str) -> str:
    return files("rayfix_evaluation.report").joinpath(name).read_text(encoding="utf-8")


def _figure(spec: Spec, interactive: Mapping[str, str], figures: Path) -> _Figure:
    data = interactive.get(spec.key)
    return _Figure(
        key=spec.key,
        title=spec.title,
        caption=spec.caption,
        svg=Markup(inline_svg(figures / f"{spec.key}.svg")),
        data=None if data is None else Markup(_harmless(data)),
    )


def _harmless(text: str) -> str:
    """Escape JSON so that it cannot close the script element that contains it."""
    return text.replace("</", "<\\/")


def _section(key: str, title: str, keys: tuple[str, ...], drawn: Mapping[str, _Figure]) -> _Section:
    wanted = keys if key != "stress" else tuple(name for name in drawn if name.startswith("stress-"))
    return _Section(
        key=key, title=title, keys=wanted, figures=tuple(figure for name, figure in drawn.items() if name in wanted)
    )


def _stated_probabilities(study: Mapping[str, Any]) -> list[float]:
    """Probabilities of the credible ellipsoids, from the first method with a stated uncertainty."""
    coverages = (method["coverage"] for point in study["points"] for method in point["methods"].values())
    return [float(probability) for probability in next(coverage for coverage in coverages if coverage)]


def _site_rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    results, table = evaluation.results, evaluation.table
    drops = results["drops"]
    vertices = table.scene.vertices
    size = " x ".join(f"{v:.3g}" for v in vertices.max(axis=0) - vertices.min(axis=0))
    heard = ", ".join(f"{n} by {k}" for k, n in drops["by_stations"].items())
    propagation = table.site.document["propagation"]
    origin = results["origin_m"]
    return [
        (
            "Scene",
            f"{size} m, {len(table.scene.faces):,} triangles, {table.scene.free_space.volume:,.0f} m3 of free space",
        ),
        (
            "Stations",
            ", ".join(
                f"{s.id} at ({', '.join(f'{v:.10g}' for v in np.round(np.add(s.position, origin), 6))}) m"
                for s in table.site.stations
            ),
        ),
        *(
            [("Figures and maps", f"their coordinates count from ({', '.join(f'{v:.0f}' for v in origin)}) m")]
            if any(origin)
            else []
        ),
        ("Paths", f"up to {propagation['max_reflections']} reflections and {propagation['max_path_length_m']:g} m"),
        (
            "Drops",
            f"{drops['drawn']} uniform in the free space; audible to stations: {heard}; {drops['unheard']} left out",
        ),
        (
            "Line of sight",
            f"in {share(drops['line_of_sight'])} of the pairs of a drop and a station to which it is audible",
        ),
        (
            "Audible paths",
            f"{drops['paths_heard']:.1f} for each pair of a drop and a station, which reports the strongest",
        ),
    ]


def _made_rows(results: Mapping[str, Any]) -> list[tuple[str, str]]:
    effort = results["effort"]
    coarse = "; tables of other path priors have a finest window twice as wide" if effort["coarse"] else ""
    return [
        ("Software", f"rayfix {results['software_version']}, code {results['code']}, Python {results['python']}"),
        ("Libraries", ", ".join(f"{name} {v}" for name, v in results["libraries"].items())),
        ("Table", results["table_id"]),
        ("Other tables", ", ".join(f"{name} {v[:12]}" for name, v in results["tables"].items() if name != "site")),
        ("Seed", str(results["seed"])),
        (
            "Effort",
            f"{effort['name']}: {effort['drops']} drops for each noise and method, "
            f"{effort['stress_drops']} for each point of a curve{coarse}",
        ),
    ]


def _interval(values: Sequence[float | None]) -> str:
    """Format the ends of a percentile's interval, given the percentile and both ends."""
    _, low, high = values
    if low is None or high is None:
        return ""
    if high < 0.995:
        return f"{100 * low:.0f}{_DASH}{100 * high:.0f}"
    return f"{low:.2f}{_DASH}{high:.2f} m" if low < 0.995 else f"{low:.1f}{_DASH}{high:.1f}"


def _number(value: float | None) -> str:
    return _DASH if value is None else f"{value:.2f}"


def _milliseconds(value: float) -> str:
    return f"{value:.1f}" if value < 10 else f"{value:,.0f}"
