"""The paper's statements, checked on the measured results."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rayfix_evaluation.studies.summary import Run, percentile, probability_lower

__all__ = ["Statement", "check_statements"]

_STRONGLY = 0.5
"""A strong improvement reduces the 90th percentile to this fraction or less."""

_SURE = 0.95
"""Fraction of bootstrap resamples that must agree before a difference counts as certain."""


@dataclass(frozen=True, kw_only=True)
class Statement:
    """One statement about one method.

    Attributes
    ----------
    claim : str
    method : str
    holds : bool
    figures : str
        Measured values.
    reason : str
        Why it does not hold, or a remark; may be empty.
    """

    claim: str
    method: str
    holds: bool
    figures: str
    reason: str

    def document(self) -> dict[str, Any]:
        """Return the statement as JSON-compatible data."""
        return {name: getattr(self, name) for name in ("claim", "method", "holds", "figures", "reason")}


def check_statements(runs: Mapping[tuple[str, str, str], Run], seed: int) -> list[Statement]:
    """Check the paper's statements for its own method and for rayfix, and rayfix against it.

    Parameters
    ----------
    runs : mapping of (study, point, method) to Run
        With the studies ``cdf-aoa``, ``cdf-pt`` and ``cdf-rpt``.
    """
    found = []
    for method in ("paper", "rayfix"):
        found.append(_propagation_times_help(runs, method, seed))
        found.append(_time_noise_matters_less(runs, method))
        found.append(_relative_times_help_less(runs, method, seed))
    found.append(_ahead(runs, seed))
    return found


def _propagation_times_help(runs: Mapping[tuple[str, str, str], Run], method: str, seed: int) -> Statement:
    without, with_times = runs["cdf-aoa", "1 deg", method], runs["cdf-aoa", "1 deg + PT 0.5 m", method]
    before, after = percentile(without.error, 90), percentile(with_times.error, 90)
    share = probability_lower(with_times, without, 90, seed)
    holds = after <= _STRONGLY * before
    reason = ""
    if not holds:
        reason = (
            "In the paper's method, times resolve the ambiguity along a ray; in rayfix the path prior already does, so "
            "that times add less."
            if method == "rayfix"
            else "Reports without times are seldom ambiguous here: the rays of the stations intersect only once."
        )
    return Statement(
        claim="Propagation times improve the accuracy strongly at 1 deg.",
        method=method,
        holds=holds,
        figures=f"90th percentile {_cm(before)} without, {_cm(after)} with PT 0.5 m; lower in {share:.0%} of "
        "bootstrap resamples",
        reason=reason,
    )


def _time_noise_matters_less(runs: Mapping[tuple[str, str, str], Run], method: str) -> Statement:
    angle = [percentile(runs["cdf-aoa", f"{a} deg + PT 0.5 m", method].error, 90) for a in ("0.25", "1")]
    time = [percentile(runs["cdf-pt", f"PT {r} m", method].error, 90) for r in ("0.2", "1")]
    holds = _ratio(time) < _ratio(angle)
    return Statement(
        claim="The noise of propagation times matters less than that of the angles.",
        method=method,
        holds=holds,
        figures=f"90th percentile {_cm(angle[0])} to {_cm(angle[1])} (x {_ratio(angle):.1f}) from 0.25 to 1 deg; "
        f"{_cm(time[0])} to {_cm(time[1])} (x {_ratio(time):.1f}) from 0.2 to 1 m",
        reason=""
        if holds
        else "At these distances, times of 0.2 m are as accurate as the angles, so that their noise matters.",
    )


def _relative_times_help_less(runs: Mapping[tuple[str, str, str], Run], method: str, seed: int) -> Statement:
    none, relative, absolute = (
        runs[key]
        for key in (
            ("cdf-aoa", "1 deg", method),
            ("cdf-rpt", "RPT 0.5 m", method),
            ("cdf-aoa", "1 deg + PT 0.5 m", method),
        )
    )
    values = [percentile(run.error, 90) for run in (none, relative, absolute)]
    share = probability_lower(absolute, relative, 90, seed)
    holds = values[2] < values[1]
    reason = ""
    if not holds:
        reason = (
            "The difference is within the sampling scatter; RPT 0.5 m comes from times that are more accurate than PT "
            "0.5 m by the square root of two."
            if share > 1.0 - _SURE
            else "A difference constrains the pair of paths of two stations jointly, which rayfix uses in full; and "
            "RPT 0.5 m comes from times that are more accurate than PT 0.5 m by the square root of two."
        )
    elif share < _SURE:
        reason = "The difference is within the sampling scatter."
    return Statement(
        claim="Relative propagation times improve the accuracy less than propagation times.",
        method=method,
        holds=holds,
        figures=f"90th percentile {_cm(values[0])} with angles of 1 deg alone, {_cm(values[1])} with RPT 0.5 m, "
        f"{_cm(values[2])} with PT 0.5 m; PT lower in {share:.0%} of bootstrap resamples",
        reason=reason,
    )


def _ahead(runs: Mapping[tuple[str, str, str], Run], seed: int) -> Statement:
    """Check rayfix against the paper's method at every noise of every figure of the paper."""
    behind, unsure, count = [], [], 0
    for study, point, method in runs:
        if method != "paper" or not study.startswith("cdf-"):
            continue
        ours, theirs = runs[study, point, "rayfix"], runs[study, point, "paper"]
        for percent in (50, 90):
            count += 1
            name = f"{point} ({percent}th)"
            if percentile(ours.error, percent) >= percentile(theirs.error, percent):
                behind.append(f"{name}, in {1.0 - probability_lower(ours, theirs, percent, seed):.0%} of resamples")
            elif probability_lower(ours, theirs, percent, seed) < _SURE:
                unsure.append(name)
    figures = f"{count - len(behind)} of {count} percentiles are lower"
    if unsure:
        figures += f", {len(unsure)} of them within the sampling scatter"
    return Statement(
        claim="rayfix has smaller errors than the paper's method at every noise, at the 50th and the 90th percentile, "
        "on the same drops.",
        method="rayfix",
        holds=not behind,
        figures=figures,
        reason=f"Exceptions: {'; '.join(behind)}." if behind else "",
    )


def _ratio(pair: list[float]) -> float:
    return pair[1] / pair[0] if np.isfinite(pair[1]) else float("inf")


def _cm(value: float) -> str:
    return f"{100 * value:.0f} cm" if np.isfinite(value) else "no position"
