"""The range bias of a station and the spread of its ranges, from measurements of known positions."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.calibration.gaussian_process import Hyperparameters, Process, fit_process
from rayfix_evaluation.calibration.measured import AngleErrors, RangeErrors
from rayfix_evaluation.calibration.spread import fit_spread, log_density
from rayfix_evaluation.calibration.station import (
    LEAST_GAIN,
    MOST_SAMPLES,
    Model,
    RangeCalibration,
    block_means,
    folds_of,
    independent_shares,
    without_outliers,
)

__all__ = ["calibrate_ranges", "with_common_tails"]

Array = NDArray[np.float64]

_ENOUGH = 20.0
"""Independent errors from which on a station's own tails are taken."""

_RANGE_VOLUME = 50.0
"""Metres over which outliers are spread."""


def calibrate_ranges(errors: RangeErrors) -> RangeCalibration:
    """Find the range bias of a station, if it helps on places that it was not fitted to, and the spread of the rest."""
    folds = folds_of(errors.place, errors.seconds)
    scatter = max(float(1.4826 * np.median(np.abs(errors.error - np.median(errors.error)))), 1e-4)
    process = _range_process(errors, np.ones(len(folds), bool), scatter)
    scales = process.scales
    share = scales.correlated**2 / (scales.correlated**2 + scales.white**2)
    weights = independent_shares(errors.place, share)
    held_out: dict[Model, Array] = {"none": errors.error[:, None]}
    residual = errors.error.copy()
    for fold in np.unique(folds):
        out = folds == fold
        residual[out] -= _range_process(errors, ~out, scatter).constants[0][0]
    held_out["constant"] = residual[:, None]
    spreads = {model: fit_spread(found, _RANGE_VOLUME, weights) for model, found in held_out.items()}
    evidence: dict[Model, float] = {
        model: float(np.average(log_density(found, spreads[model], _RANGE_VOLUME), weights=weights))
        for model, found in held_out.items()
    }
    effective = min(float(weights.sum()), MOST_SAMPLES)
    better = (evidence["constant"] - evidence["none"]) * effective > LEAST_GAIN
    model: Model = "constant" if better else "none"
    mean, covariance = process.constants
    return RangeCalibration(
        model=model,
        evidence=evidence,
        spread=spreads[model],
        num_independent=float(weights.sum()),
        bias=float(mean[0]) if better else 0.0,
        bias_stdev=float(np.sqrt(covariance[0, 0])) if better else 0.0,
        correlation_time=scales.time,
        correlated_share=share,
        residual=held_out[model][:, 0],
        weights=weights,
    )


def with_common_tails(found: dict[str, RangeCalibration]) -> dict[str, RangeCalibration]:
    """Give stations of few independent errors the tails that the ranges of all stations have together.

    A handful of places tells no tails: one that is far off would pass for them.
    """
    few = [name for name, each in found.items() if each.num_independent < _ENOUGH]
    if not few:
        return found
    residual = np.concatenate([each.residual for each in found.values()])[:, None]
    weights = np.concatenate([each.weights for each in found.values()])
    together = fit_spread(residual, _RANGE_VOLUME, weights)
    tails = together.tail_share, together.tail_scale
    return found | {
        name: replace(
            found[name],
            spread=fit_spread(found[name].residual[:, None], _RANGE_VOLUME, found[name].weights, tails=tails),
        )
        for name in few
    }


def _range_process(errors: RangeErrors, chosen: NDArray[np.bool_], scatter: float) -> Process:
    angles = AngleErrors(
        local=False,
        true=np.column_stack([errors.true, errors.true]),
        error=np.column_stack([errors.error, errors.error]),
        stated=np.zeros((len(errors.error), 2)),
        seconds=errors.seconds,
        place=errors.place,
    )
    good = chosen & without_outliers(errors.error, chosen)
    samples = block_means(angles, 0, np.ones((len(errors.error), 1)), good)
    usual = Hyperparameters(
        linear=1.0, amplitude=0.0, azimuth_scale=25.0, zenith_scale=25.0, correlated=0.6 * scatter, white=0.5 * scatter,
        time=Hyperparameters.time,
    )  # fmt: skip
    return fit_process(samples, usual, free=("correlated", "white", "time"))
