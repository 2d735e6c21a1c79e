"""Fixes beside the truth: errors with intervals, and how often the stated regions hold the target."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["PROBABILITIES", "ScoredFixes", "score_document"]

Array = NDArray[np.float64]

PROBABILITIES = (0.5, 0.68, 0.9, 0.95)
"""Of the circles that fixes of a log state."""

_PERCENTILES = (50, 68, 90, 95, 99)
_DRAWS = 400
_INTERVAL = 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoredFixes:
    """Fixes with a position at times of a known true position; n of them.

    Attributes
    ----------
    position, truth : ndarray of shape (n, 3), m
    radius : ndarray of shape (n, 4), m
        Of the circles of :data:`PROBABILITIES`; NaN where the file has none.
    status : ndarray of str of shape (n,)
    num_used : ndarray of int of shape (n,)
        Measurements that each fix used.
    place : ndarray of int of shape (n,)
        Number of the true place; errors of one place are alike.
    """

    position: Array
    truth: Array
    radius: Array
    status: NDArray[np.str_]
    num_used: NDArray[np.int64]
    place: NDArray[np.int64]

    @property
    def horizontal(self) -> Array:
        """Horizontal errors, shape (n,), m."""
        return np.asarray(np.hypot(*(self.position - self.truth).T[:2]))

    @property
    def spatial(self) -> Array:
        """Errors in space, shape (n,), m."""
        return np.asarray(np.linalg.norm(self.position - self.truth, axis=1))

    def only(self, chosen: NDArray[np.bool_]) -> "ScoredFixes":
        """Select some."""
        return ScoredFixes(**{name: values[chosen] for name, values in vars(self).items()})


def score_document(fixes: ScoredFixes, *, seed: int = 1) -> dict[str, Any]:
    """Summarise fixes, all of them and by status and number of measurements, as JSON-compatible data.

    The intervals hold a figure with 90 %, by drawing places again: fixes of one place are alike, so that a thousand of
    them say little more than one.

    Parameters
    ----------
    fixes : ScoredFixes
        At least one.
    seed : int
        Of the draws.
    """
    statuses = {str(s): fixes.only(fixes.status == s) for s in np.unique(fixes.status)}
    counts = {str(int(c)): fixes.only(fixes.num_used == c) for c in np.unique(fixes.num_used)}
    return {
        "all": _summary(fixes, seed),
        "by_status": {name: _summary(some, seed) for name, some in statuses.items()},
        "by_measurements_used": {name: _summary(some, seed) for name, some in counts.items()},
    }


def _summary(fixes: ScoredFixes, seed: int) -> dict[str, Any]:
    draws = _draws(fixes.place, seed)
    return {
        "fixes": len(fixes.place),
        "places": len(np.unique(fixes.place)),
        "horizontal_error_m": _errors(fixes.horizontal, draws),
        "error_in_space_m": _errors(fixes.spatial, draws),
        "circles": _calibration(fixes, draws),
    }


def _draws(place: NDArray[np.int64], seed: int) -> list[NDArray[np.int64]]:
    """Draw places with replacement; gives the indices of their fixes."""
    _, inverse = np.unique(place, return_inverse=True)
    members = [np.flatnonzero(inverse == n) for n in range(inverse.max() + 1)]
    rng = np.random.default_rng(seed)
    return [np.concatenate([members[n] for n in rng.integers(len(members), size=len(members))]) for _ in range(_DRAWS)]


def _errors(errors: Array, draws: list[NDArray[np.int64]]) -> Mapping[str, Any]:
    names = ["mean", "rms", *(f"p{p}" for p in _PERCENTILES)]
    values, drawn = _figures(errors), np.array([_figures(errors[draw]) for draw in draws])
    return {
        name: {"value": float(value), "interval": _interval(column)}
        for name, value, column in zip(names, values, drawn.T, strict=True)
    }


def _figures(errors: Array) -> Array:
    return np.array([errors.mean(), np.sqrt(np.square(errors).mean()), *np.percentile(errors, _PERCENTILES)])


def _calibration(fixes: ScoredFixes, draws: list[NDArray[np.int64]]) -> Mapping[str, Any]:
    found = {}
    for n, probability in enumerate(PROBABILITIES):
        stated = np.isfinite(fixes.radius[:, n])
        if not stated.any():
            continue
        inside = np.where(stated, fixes.horizontal <= fixes.radius[:, n], np.nan)
        shares = np.array([_mean(inside[draw]) for draw in draws])
        found[f"{probability:g}"] = {
            "holds": float(np.nanmean(inside)),
            "interval": _interval(shares[np.isfinite(shares)]),
            "median_radius_m": float(np.nanmedian(fixes.radius[:, n])),
        }
    return found


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan


def _interval(values: Array) -> list[float]:
    low, high = np.quantile(values, [0.5 * (1.0 - _INTERVAL), 0.5 * (1.0 + _INTERVAL)])
    return [float(low), float(high)]
