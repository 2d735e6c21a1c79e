"""Summaries of runs: percentiles with bootstrap intervals, failures, calibration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.drops.calibration import GROSS_BOUNDS, GROSS_ERROR, OPEN_BOUND

PERCENTILES = (50, 68, 90, 95)
COVERAGE = (0.5, 0.68, 0.9, 0.99)
"""Probabilities of the ellipsoids of the calibration."""

_RESAMPLES = 1000
_CONFIDENCE = 95.0


@dataclass(frozen=True, kw_only=True)
class Run:
    """Results of a method on the drops of a case.

    Attributes
    ----------
    error : ndarray of shape (n,), m
        Distance from the truth; inf without a position.
    bound : ndarray of shape (n,), m
        Position error bound; inf if the measurements do not determine a position.
    hidden, heard : ndarray of int of shape (n,)
        Number of stations in the report with a reflected path, and of all.
    covered : ndarray of bool of shape (n, 4) or None
        Whether the ellipsoids of ``COVERAGE`` contain the truth; None for a method without a stated uncertainty.
    """

    error: NDArray[np.float64]
    bound: NDArray[np.float64]
    hidden: NDArray[np.int64]
    heard: NDArray[np.int64]
    covered: NDArray[np.bool_] | None

    def document(self) -> dict[str, Any]:
        """Return the run as JSON-compatible data; lengths to a tenth of a millimetre, null for infinite."""
        return {
            "error_m": _rounded(self.error),
            "bound_m": _rounded(self.bound),
            "hidden": self.hidden.tolist(),
            "heard": self.heard.tolist(),
            "covered": None if self.covered is None else self.covered.astype(int).tolist(),
        }

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "Run":
        """Restore a run from the data of :meth:`document`."""
        covered = document["covered"]
        return cls(
            error=_lengths(document["error_m"]),
            bound=_lengths(document["bound_m"]),
            hidden=np.array(document["hidden"], np.int64),
            heard=np.array(document["heard"], np.int64),
            covered=None if covered is None else np.array(covered, np.bool_).reshape(-1, len(COVERAGE)),
        )

    @classmethod
    def joined(cls, parts: Sequence["Run"]) -> "Run":
        """Concatenate the drops of all parts."""
        covered = [part.covered for part in parts if part.covered is not None]
        return cls(
            error=np.concatenate([part.error for part in parts]),
            bound=np.concatenate([part.bound for part in parts]),
            hidden=np.concatenate([part.hidden for part in parts]),
            heard=np.concatenate([part.heard for part in parts]),
            covered=np.concatenate(covered) if len(covered) == len(parts) else None,
        )

    @property
    def answered(self) -> NDArray[np.bool_]:
        """Whether there is a position."""
        return np.isfinite(self.error)

    @property
    def gross(self) -> NDArray[np.bool_]:
        """Whether an error exceeds five bounds and a metre."""
        return self.answered & (self.error > GROSS_BOUNDS * self.bound) & (self.error > GROSS_ERROR)


def percentile(values: NDArray[np.float64], percent: float) -> float:
    """Smallest value that the given percentage does not exceed; inf if too many values are infinite."""
    return float(np.percentile(values, percent, method="inverted_cdf"))


def resampled(values: NDArray[np.float64], percent: float, seed: int) -> NDArray[np.float64]:
    """Percentiles of samples drawn with replacement, shape (1000,); the same seed draws the same drops."""
    return np.asarray(np.percentile(values[_draws(len(values), seed)], percent, axis=1, method="inverted_cdf"))


def summarise(run: Run, seed: int) -> dict[str, Any]:
    """Summarise a run as JSON-compatible data.

    Percentiles are over all drops, with an infinite error for those without a position, and have bootstrap 95 %
    intervals. Failures are gross errors and missing positions.
    """
    draws = _draws(len(run.error), seed)
    tail = 50.0 - 0.5 * _CONFIDENCE
    percentiles = {}
    for percent in PERCENTILES:
        again = np.percentile(run.error[draws], percent, axis=1, method="inverted_cdf")
        low, high = np.percentile(again, [tail, 100.0 - tail], method="inverted_cdf")
        percentiles[f"p{percent}"] = [_number(percentile(run.error, percent)), _number(low), _number(high)]
    fair = run.answered & (run.bound < OPEN_BOUND) & (run.error < GROSS_BOUNDS * run.bound)
    ratio = np.sqrt(np.mean(run.error[fair] ** 2) / np.mean(run.bound[fair] ** 2)) if fair.any() else np.inf
    calibration = None
    if run.covered is not None and run.answered.any():
        shares = run.covered[run.answered].mean(axis=0)
        calibration = {f"{p:g}": round(float(s), 4) for p, s in zip(COVERAGE, shares, strict=True)}
    return {
        "drops": len(run.error),
        **percentiles,
        "unanswered": round(float(np.mean(~run.answered)), 4),
        "gross": round(float(np.mean(run.gross)), 4),
        "rms_error_over_bound": _number(ratio),
        "coverage": calibration,
    }


def probability_lower(one: Run, other: Run, percent: float, seed: int) -> float:
    """Fraction of joint resamples of the drops in which one run's percentile is below the other's."""
    return float(np.mean(resampled(one.error, percent, seed) < resampled(other.error, percent, seed)))


def _draws(count: int, seed: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, count]).integers(count, size=(_RESAMPLES, count))


def _rounded(values: NDArray[np.float64]) -> list[float | None]:
    return [_number(v) for v in values]


def _number(value: Any) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def _lengths(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([np.inf if v is None else v for v in values])
