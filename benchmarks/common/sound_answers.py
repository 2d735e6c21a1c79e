"""Checks that every answer with a position must pass, whatever the report."""

import math
from typing import Any

import numpy as np

from rayfix_tables.freespace import FreeSpace

ROUNDING = 1e-6
"""By which probabilities that are told may add up to more than one."""

UNTOLD = 0.05
"""Probability that the candidates which are too improbable to be told may have together."""


def faults_of(document: dict[str, Any], free_space: FreeSpace) -> list[str]:
    """List what is wrong with an answer in the native format, in words; nothing of a sound one.

    Positions lie in the free space, numbers are finite, covariances positive definite. The candidates' probabilities
    add up to one at most, and to no less than the confidence, which is lower where fewer candidates are told.
    """
    faults = [f"{path} is not finite" for path, number in _numbers(document) if not math.isfinite(number)]
    if faults:
        return faults
    candidates = document["candidates"]
    total = sum(candidate["probability"] for candidate in candidates)
    if total > 1.0 + ROUNDING or any(candidate["probability"] < 0.0 for candidate in candidates):
        faults.append(f"probabilities sum to {total}")
    if candidates and total < document["confidence"] - UNTOLD:
        faults.append(f"probabilities sum to {total}, the confidence is {document['confidence']}")
    for place in (*candidates, *([document] if document.get("position") else [])):
        position = [place["position"][axis] for axis in "xyz"]
        if not free_space.contains(np.array(position)):
            faults.append(f"{position} is outside the free space")
        if np.linalg.eigvalsh(np.array(place["covariance_m2"]))[0] <= 0.0:
            faults.append(f"the covariance at {position} is not positive definite")
    if bool(candidates) != (document.get("position") is not None):
        faults.append(f"{len(candidates)} candidates and position {document.get('position')}")
    return faults


def _numbers(value: Any, path: str = "") -> list[tuple[str, float]]:
    match value:
        case float() | int():
            return [(path, value)]
        case dict():
            return [found for key, inner in value.items() for found in _numbers(inner, f"{path}.{key}")]
        case list():
            return [found for n, inner in enumerate(value) for found in _numbers(inner, f"{path}[{n}]")]
    return []
