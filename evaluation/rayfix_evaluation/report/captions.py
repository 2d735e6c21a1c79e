"""Captions of figures, generated from the results."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rayfix_evaluation.studies.evaluate import Evaluation

__all__ = ["cdf_caption", "length", "paths_caption", "points_caption", "share", "stress_caption"]

Document = Mapping[str, Any]

_ABOUT = {
    "stress-heard": "The report holds at most this many of the audible stations, chosen at random.",
    "stress-blocked": "Each direct path is blocked with this probability, as by people and vehicles that are not in "
    "the twin; the station then reports its strongest reflection.",
    "stress-rule": "Each station reports its strongest path, its first path, or a random one. The table's path prior "
    "favours strong paths.",
    "stress-objects": "Each object of the scene is displaced by this distance in a random direction; the table is that "
    "of the undisturbed twin.",
    "stress-walls": "Each outer wall is displaced by this distance, inwards or outwards; the table is that of the "
    "undisturbed twin.",
    "stress-told": "The report states standard deviations that are the true ones (1 deg and 0.5 m) times this factor.",
    "stress-bias": "Azimuth and zenith of every station have this bias, the same in every report.",
    "stress-missing": "One station is out of service, but still in the table.",
    "stress-outliers": "This many stations report an angle drawn uniformly from all directions.",
    "stress-late": "This many stations report a propagation time that is 10 m too long.",
    "stress-reflections": "From left to right: tables with fewer reflections than the simulated world, and, last, the "
    "site's table in a world with one reflection more.",
}


def length(value: float | None) -> str:
    """Format a length: below a metre in centimetres."""
    if value is None:
        return "no position"
    return f"{100 * value:.0f} cm" if value < 0.995 else f"{value:.1f} m"


def share(value: float) -> str:
    """Format a fraction in per cent, small ones with a decimal."""
    return f"{100 * value:.1f} %" if 0.0 < value < 0.1 else f"{100 * value:.0f} %"


def paths_caption(evaluation: "Evaluation") -> str:
    """Caption of the scene."""
    pictures = evaluation.pictures
    stations = pictures["stations"]
    direct = sum(station["bounces"] == 0 and station["walls"] == 0 for station in stations)
    reflected = sum(station["bounces"] > 0 for station in stations)
    passed = sum(station["walls"] > 0 for station in stations)
    through = f", {passed} through walls (squares where they enter)" if passed else ""
    return (
        f"{evaluation.results['site']}: grey triangles are the objects of the twin, coloured lines the paths that "
        f"{len(stations)} stations report for one transmitter (+): {direct} direct, {reflected} reflected{through}. "
        "The following figures are for this transmitter."
    )


def points_caption(pictures: Document, kind: str) -> str:
    """Caption of the points of rays."""
    if kind == "aoa":
        return (
            "Points every 10 cm along the rays launched from each station around its measured angle (1 deg) and "
            "reflected at walls and objects: candidate positions of the transmitter. Algorithm 1, before times are "
            "used."
        )
    kept = [len(station["points_pt"]) for station in pictures["stations"]]
    return (
        "The points that remain after selection by the measured propagation times (0.5 m); each is kept with the "
        f"likelihood of its path length (at most {max(kept)} points of a station are drawn). Each station is left with "
        "one or a few clusters; the clusters of all stations overlap at the transmitter."
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
            "Cumulative distribution of the error, rayfix (solid) and the paper's method run online (dashed). With "
            f"angles of 1 deg alone, the 90th percentile is {length(before)} for the paper's method and "
            f"{length(after)} for rayfix; with propagation times of 0.5 m, {length(best)} and {length(worst)}."
        )
    what = "propagation times" if kind == "pt" else "relative propagation times"
    return (
        f"{what.capitalize()} with standard deviations from 0.2 to 1 m, and angles of 1 deg. Between these the "
        f"90th percentile grows from {length(method['paper'][0])} to {length(method['paper'][1])} for the paper's "
        f"method (dashed) and from {length(method['rayfix'][0])} to {length(method['rayfix'][1])} for rayfix (solid)."
    )


def stress_caption(study: Document) -> str:
    """Caption of a curve: the condition that varies, and rayfix's error at both ends."""
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
        end = f"{end} times"
        same = next(v for v in values if v[0] == "1")
        b50, b90 = same[1], same[2]
        half = next(v for v in values if v[0] == "0.5")
        return (
            f"{_ABOUT[study['key']]} rayfix: median {length(b50)} and 90th percentile {length(b90)} with the true "
            f"standard deviations, {length(half[1])} and {length(half[2])} with half of them, {length(e50)} and "
            f"{length(e90)} with {end} the true ones."
        )
    return (
        f"{_ABOUT[study['key']]} rayfix: median {length(b50)} and 90th percentile {length(b90)} at '{begin}', "
        f"{length(e50)} and {length(e90)} at '{end}'."
    )
