"""All figures by name, with their drawing functions and captions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from rayfix_evaluation.report.captions import (
    cdf_caption,
    length,
    paths_caption,
    points_caption,
    share,
    stress_caption,
)
from rayfix_evaluation.report.charts import (
    arrays_chart,
    calibration_chart,
    cdf_by_noise,
    curve_chart,
    differences_chart,
    methods_cdf,
    percentiles_chart,
    reflections_chart,
)
from rayfix_evaluation.report.geometry import Backdrop, backdrop
from rayfix_evaluation.report.interactive import space_figure
from rayfix_evaluation.report.maps import planning_chart
from rayfix_evaluation.report.spaces import plane_picture, space_picture
from rayfix_evaluation.report.style import styled, write_figure
from rayfix_evaluation.studies.evaluate import Evaluation

__all__ = ["Spec", "figure_specs", "study_of", "write_figures"]

Document = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Spec:
    """One figure.

    Attributes
    ----------
    key : str
        Base name of its files.
    title, caption : str
    draw : callable
        Draws it.
    interactive : str or None
        Content of the interactive version, if there is one.
    """

    key: str
    title: str
    caption: str
    draw: Callable[[], Figure]
    interactive: str | None = None


def study_of(results: Document, key: str) -> Document:
    """Study of a key."""
    (study,) = [study for study in results["studies"] if study["key"] == key]
    return dict(study)


def figure_specs(evaluation: Evaluation) -> tuple[Spec, ...]:
    """List all figures of an evaluation, in the order of the page."""
    scene = backdrop(evaluation.table)
    specs = [
        *_space_specs(evaluation, scene),
        *_cdf_specs(evaluation.results),
        *_method_specs(evaluation.results),
        _planning_spec(evaluation.results, scene),
        _arrays_spec(evaluation.results),
        *(_stress_spec(study) for study in evaluation.results["studies"] if study["key"].startswith("stress-")),
    ]
    return tuple(specs)


def write_figures(specs: Sequence[Spec], folder: Path, after: Callable[[int], None]) -> None:
    """Write each figure as SVG and PNG.

    Parameters
    ----------
    after : callable
        Called with the number of figures written so far.

    Raises
    ------
    RayfixError
        When they cannot be written.
    """
    for n, spec in enumerate(specs):
        with styled():
            write_figure(spec.draw(), folder / spec.key)
        after(n + 1)


def interactive_figures(specs: Sequence[Spec], evaluation: Evaluation) -> dict[str, str]:
    """JSON of the interactive pictures, by key of the figure."""
    scene = backdrop(evaluation.table)
    return {
        spec.key: space_figure(scene, evaluation.pictures, spec.interactive)
        for spec in specs
        if spec.interactive is not None
    }


def _space_specs(evaluation: Evaluation, scene: Backdrop) -> list[Spec]:
    pictures = evaluation.pictures

    def space(key: str, title: str, show: str, caption: str) -> Spec:
        return Spec(
            key=key,
            title=title,
            caption=caption,
            draw=lambda: space_picture(scene, pictures, show),
            interactive=show,
        )

    specs = [
        space("scene", "The scene and its stations", "scene", paths_caption(evaluation)),
        Spec(
            key="plane-points",
            title="Rays and their points in the plane of the transmitter",
            caption="Top view: thin lines are rays launched around each measured angle, dots are their intersections "
            "with the plane at the transmitter's height, and contours hold 50, 80 and 95 % of the Gaussian mixture "
            "fitted to the dots of each station. This is the paper's two-dimensional predecessor, which needs to know "
            f"the height; the maximum of its product of mixtures is {_miss(pictures, 'plane')} from the true position.",
            draw=lambda: plane_picture(scene, pictures),
        ),
        space("points-aoa", "Points from angles", "points_aoa", points_caption(pictures, "aoa")),
        space(
            "mixture-aoa",
            "Mixtures from angles",
            "mixture_aoa",
            "One-sigma ellipsoids of the components that EM fits to each station's points; darker ones have larger "
            "weights. They extend along the rays through the whole building. The maximum of the product of the "
            f"mixtures is {_miss(pictures, 'aoa')} from the true position.",
        ),
        space("points-aoa-pt", "Points from angles and times", "points_pt", points_caption(pictures, "pt")),
        space(
            "mixture-aoa-pt",
            "Mixtures from angles and times",
            "mixture_pt",
            "The same after selection of the points by the propagation time (0.5 m): only the section of each ray near "
            "the measured length remains, so that the mixtures are compact and few positions are possible. The maximum "
            f"of the product is {_miss(pictures, 'pt')} from the true position; rayfix is {_miss_rayfix(pictures)} "
            "off.",
        ),
    ]
    differences = pictures["length_differences"]
    if differences is not None:
        specs.append(
            Spec(
                key="length-differences",
                title="Differences of path length of pairs of points",
                caption=f"Path length of points of {differences['columns']} less that of {differences['rows']}, "
                f"in metres. With a relative propagation time only the difference is known, here "
                f"{differences['measured_m']:.2f} m: the shaded pairs agree with it to within two standard "
                f"deviations of {differences['stdev_m']:g} m, and Algorithm 2 samples from these. Whole diagonals "
                "agree: a relative time carries less information than a time.",
                draw=lambda: differences_chart(differences),
            )
        )
    return specs


def _cdf_specs(results: Document) -> list[Spec]:
    aoa, pt, rpt = (study_of(results, key) for key in ("cdf-aoa", "cdf-pt", "cdf-rpt"))
    without = [p for p in aoa["points"] if p["case"]["timing"] == "none"]
    with_times = [p for p in aoa["points"] if p["case"]["timing"] == "pt"]
    noises = [p for p in rpt["points"] if p["case"]["angle_deg"] == 1.0]
    return [
        Spec(
            key="cdf-aoa",
            title=aoa["title"],
            caption=cdf_caption("aoa", aoa["points"]),
            draw=lambda: cdf_by_noise(
                [
                    ("angles alone", _curves(without, "angle_deg", "deg")),
                    ("with PT 0.5 m", _curves(with_times, "angle_deg", "deg")),
                ]
            ),
        ),
        Spec(
            key="cdf-pt",
            title=pt["title"],
            caption=cdf_caption("pt", pt["points"]),
            draw=lambda: cdf_by_noise([("angles of 1 deg", _curves(pt["points"], "range_stdev", "m"))]),
        ),
        Spec(
            key="cdf-rpt",
            title=rpt["title"],
            caption=cdf_caption("rpt", noises),
            draw=lambda: cdf_by_noise([("angles of 1 deg", _curves(noises, "range_stdev", "m"))]),
        ),
    ]


def _method_specs(results: Document) -> list[Spec]:
    study = study_of(results, "methods")
    points = study["points"]
    curves = [(p["label"], p["methods"]["rayfix"]["coverage"], p["methods"]["rayfix"]["drops"]) for p in points]
    return [
        Spec(
            key="methods-percentiles",
            title="Methods side by side",
            caption="Median (filled) and 90th percentile (open) of the error on the same drops, with bootstrap 95 % "
            "intervals; an arrow marks values above 20 m or no position. Grey dots are the position error bound, given "
            "the path that each station reported; single errors can be below it, the root mean square error of an "
            "unbiased method cannot.",
            draw=lambda: percentiles_chart(points[:3]),
        ),
        Spec(
            key="methods-cdf",
            title="Methods side by side, whole distributions",
            caption="Cumulative distribution of the error. A curve that ends below 100 % gave no position for the "
            "remaining drops. Methods that treat every path as line of sight have large errors wherever paths are "
            "reflected.",
            draw=lambda: methods_cdf(points[:3]),
        ),
        Spec(
            key="calibration",
            title="Calibration of the stated uncertainty",
            caption="Fraction of true positions within rayfix's credible ellipsoids against the stated probability. "
            "The dotted line is perfect calibration; the shaded band is the sampling scatter for this number of drops. "
            "Above it, ellipsoids are too large; below it, too small.",
            draw=lambda: calibration_chart([(label, c, n) for label, c, n in curves if c]),
        ),
    ]


def _planning_spec(results: Document, scene: Backdrop) -> Spec:
    planning = results["planning"]
    figures = "; ".join(
        f"{plan['label']}: {share(plan['coverage'])} of fixes within {plan['threshold_m']:g} m, expected error "
        f"{length(plan['expected_error_m']['50'])} in half of the squares"
        for plan in planning["maps"]
    )
    return Spec(
        key="planning",
        title="Planning maps",
        caption=f"Prediction from the table alone for transmitters at z = {planning['height_m']:g} m, in "
        f"squares of {planning['spacing_m']:g} m; triangles are stations, lines the section of the scene. {figures}. "
        "'rayfix plan' draws such maps for other heights and noise, and compares choices of stations.",
        draw=lambda: planning_chart(scene, planning),
    )


def _arrays_spec(results: Document) -> Spec:
    arrays = results["antenna_arrays"]
    return Spec(
        key="antenna-arrays",
        title="Angle errors of antenna arrays",
        caption="Uniform planar arrays at the stations receive all paths of the forward solver, and four estimators "
        "search for the strongest. Dotted: the half-power beam width; a larger error means another path or no path.",
        draw=lambda: arrays_chart(arrays),
    )


def _stress_spec(study: Document) -> Spec:
    draw = reflections_chart if study["key"] == "stress-reflections" else curve_chart
    return Spec(key=study["key"], title=study["title"], caption=stress_caption(study), draw=lambda: draw(study))


def _curves(points: Sequence[Document], key: str, unit: str) -> list[tuple[str, Document]]:
    return [(f"{p['case'][key]:g} {unit}", p["methods"]) for p in points]


def _miss(pictures: Document, kind: str) -> str:
    estimate = pictures["estimates"][kind]
    if estimate is None:
        return "undetermined, not a distance"
    truth = pictures["truth"][: len(estimate)]
    return length(sum((a - b) ** 2 for a, b in zip(estimate, truth, strict=True)) ** 0.5)


def _miss_rayfix(pictures: Document) -> str:
    if pictures["rayfix"] is None:
        return "without a position, not"
    return length(sum((a - b) ** 2 for a, b in zip(pictures["rayfix"], pictures["truth"], strict=True)) ** 0.5)
