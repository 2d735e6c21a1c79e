"""What the report says about figures, from the figures themselves."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rayfix_evaluation.studies.evaluate import Evaluation

__all__ = ["cdf_caption", "length", "paths_caption", "points_caption", "share", "stress_caption"]

Document = Mapping[str, Any]

_ABOUT = {
    "stress-heard": "Only as many of the stations that hear a drop are left in its report, chosen by chance.",
    "stress-blocked": "Direct paths are blocked with this probability, as people and vehicles do that the twin does "
    "not "
    "know; the station then reports its strongest reflection.",
    "stress-rule": "Each station reports the strongest of its paths, the first to arrive, or any of them alike. The "
    "table "
    "expects strong ones.",
    "stress-objects": "Each object of the scene is moved by this much in a direction of its own; the table is that of "
    "the "
    "twin.",
    "stress-walls": "Each side of the building is moved by this much inwards or outwards; the table is that of the "
    "twin.",
    "stress-told": "The report states deviations that are this many times the true ones (1 deg and 0.5 m).",
    "stress-bias": "Every station's azimuth and zenith are off by this much, the same way in every report.",
    "stress-missing": "One station is out of service; the table still has it.",
    "stress-outliers": "So many stations report an angle drawn from all around.",
    "stress-late": "So many stations report a time that is 10 m late.",
    "stress-reflections": "Left to right: tables that follow rays over fewer reflections than the world has, and, "
    "last, "
    "the site's table in a world of one reflection more.",
}


def length(value: float | None) -> str:
    """Length as people write it."""
    if value is None:
        return "no position"
    return f"{100 * value:.0f} cm" if value < 0.995 else f"{value:.1f} m"


def share(value: float) -> str:
    """Share as people write it: not 0 % where there is something."""
    return f"{100 * value:.1f} %" if 0.0 < value < 0.1 else f"{100 * value:.0f} %"


def paths_caption(evaluation: "Evaluation") -> str:
    """Caption of the scene."""
    pictures = evaluation.pictures
    stations = pictures["stations"]
    direct = sum(station["bounces"] == 0 for station in stations)
    return (
        f"{evaluation.results['site']}: triangles are the objects of the twin, coloured lines the path that each of "
        "the "
        f"{len(stations)} stations reports of one transmitter (+): {direct} directly, {len(stations) - direct} by "
        "reflection. The figures that follow are of this transmitter."
    )


def points_caption(pictures: Document, kind: str) -> str:
    """Caption of the points of rays."""
    if kind == "aoa":
        return (
            "Points every 10 cm along rays launched from each station around its measured angle (1 deg), mirrored at "
            "walls "
            "and objects: the transmitter can be at any of them. Algorithm 1 before times are used."
        )
    kept = [len(station["points_pt"]) for station in pictures["stations"]]
    return (
        "Those of the points that the measured propagation times (0.5 m) leave, each kept with the probability that "
        "its "
        f"path length agrees (at most {max(kept)} of a station are drawn). What was a net of rays is one patch or a "
        "few "
        "for each station; where patches of all stations meet is the transmitter."
    )


def cdf_caption(kind: str, points: Sequence[Document]) -> str:
    """Caption of the distributions of the error by noise."""
    first, last = points[0], points[-1]
    method = {key: (first["methods"][key]["p90"][0], last["methods"][key]["p90"][0]) for key in ("rayfix", "paper")}
    if kind == "aoa":
        with_one = next(p for p in points if p["case"]["timing"] == "none" and p["case"]["angle_deg"] == 1.0)
        before, after = (with_one["methods"][key]["p90"][0] for key in ("paper", "rayfix"))
        best, worst = last["methods"]["paper"]["p90"][0], last["methods"]["rayfix"]["p90"][0]
        return (
            "Share of drops with an error below that on the horizontal axis, rayfix (solid) and the paper's method run "
            f"online (dashed). Without times at 1 deg, the 90th percentile is {length(before)} for the paper's method "
            "and "
            f"{length(after)} for rayfix; with propagation times of 0.5 m, {length(best)} and {length(worst)}."
        )
    what = "propagation times" if kind == "pt" else "relative propagation times"
    return (
        f"{what.capitalize()} from 0.2 to 1 m beside angles of 1 deg. From the best to the worst time the 90th "
        "percentile "
        f"goes from {length(method['paper'][0])} to {length(method['paper'][1])} for the paper's method (dashed) and "
        "from "
        f"{length(method['rayfix'][0])} to {length(method['rayfix'][1])} for rayfix (solid)."
    )


def stress_caption(study: Document) -> str:
    """Caption of a curve: what was done, and what became of rayfix."""
    points = study["points"]
    values = []
    for point in points:
        key = next(iter(point["methods"]))
        values.append((point["label"], point["methods"][key]["p50"][0], point["methods"][key]["p90"][0]))
    (begin, b50, b90), (end, e50, e90) = values[0], values[-1]
    if study["key"] == "stress-missing":
        end, e50, e90 = max(values, key=lambda v: float("inf") if v[2] is None else v[2])
        begin = "all in service"
    if study["key"] == "stress-reflections":
        end, e50, e90 = values[-2]
    if study["key"] == "stress-told":
        begin, end = f"{begin} of the true ones", f"{end} times"
        same = next(v for v in values if v[0] == "1")
        begin, b50, b90 = "true deviations", same[1], same[2]
        half = next(v for v in values if v[0] == "0.5")
        return (
            f"{_ABOUT[study['key']]} rayfix: median {length(b50)} and 90th percentile {length(b90)} with {begin}, "
            f"{length(half[1])} and {length(half[2])} told half, {length(e50)} and {length(e90)} told {end} too much."
        )
    return (
        f"{_ABOUT[study['key']]} rayfix: median {length(b50)} and 90th percentile {length(b90)} at '{begin}', "
        f"{length(e50)} and {length(e90)} at '{end}'."
    )
