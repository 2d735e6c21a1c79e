"""The calibration of one station from measurements of known positions."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rayfix_evaluation.calibration.gaussian_process import Hyperparameters, Process, Samples, fit_process
from rayfix_evaluation.calibration.measured import AngleErrors, turn_derivatives
from rayfix_evaluation.calibration.spread import Spread, fit_spread, log_density
from rayfix_tables.geometry.angles import local_to_scene
from rayfix_tables.site import AngleBias, Deviations, Station, StationBias

__all__ = [
    "MODELS",
    "AngleCalibration",
    "AngleTrial",
    "Model",
    "RangeCalibration",
    "StationCalibration",
    "calibrate_angles",
    "calibrated_station",
    "chosen_models",
    "independent_shares",
    "num_places",
    "try_angles",
]

Array = NDArray[np.float64]

Model = Literal["none", "constant", "smooth"]
"""Systematic errors: none beyond those of the site, a turn and constants, or these and a function of the direction."""

MODELS: tuple[Model, ...] = ("none", "constant", "smooth")

MOST_SAMPLES = 200
"""Means of measurements that the processes are conditioned on."""

_FOLDS = 5
LEAST_GAIN = 2.0
"""Natural logarithms of held-out evidence by which a larger model must win."""

_FAR = 5.0
"""Robust standard deviations beyond which an error does not shape the systematic part."""

_ANGLES = Hyperparameters()

_USUAL = _ANGLES, replace(_ANGLES, zenith_scale=25.0)
"""Scales of azimuth and zenith. The bias of an azimuth changes little with the zenith; that of a zenith angle may be of
reflections from floor and ceiling, which change with it."""
_TURN_NAMES = ("x", "y", "z")
_VOLUME = 360.0 * 180.0
_TILT_RANGE = 120.0
"""Degrees of azimuth from which on tilts are looked for."""

_SURE = 2.0
"""Standard errors by which a smaller model must be better at a station to be preferred there."""

_KNOWN = 0.6
"""Ratio of posterior and prior deviation above which a term is named as not covered."""


@dataclass(frozen=True, kw_only=True)
class AngleCalibration:
    """What was found of a station's angles.

    Attributes
    ----------
    model : Model
    evidence : dict
        Held-out log evidence of each model, per measurement.
    spread : Spread
        Of azimuth and zenith, deg; of the azimuth alone, one number.
    num_independent : float
        Independent errors that the spread is of.
    correlation_time : float, s, or None
        Where it was found.
    correlated_share : float or None
        Of the variance.
    turn : ndarray of shape (3,) or None, deg
        Of the station about its own axes.
    turn_stdev : ndarray of shape (3,) or None, deg
    constant, constant_stdev : ndarray of shape (2,), deg
        Of azimuth and zenith, besides the turn.
    angles : AngleBias or None
    azimuth_range, zenith_range : tuple of 2 floats, deg
        That were covered.
    notes : tuple of str
        What the log does not cover.
    """

    model: Model
    evidence: dict[Model, float]
    spread: Spread
    num_independent: float
    correlation_time: float | None
    correlated_share: float | None
    turn: Array | None
    turn_stdev: Array | None
    constant: Array
    constant_stdev: Array
    angles: AngleBias | None
    azimuth_range: tuple[float, float]
    zenith_range: tuple[float, float]
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeCalibration:
    """What was found of a station's ranges, m; as :class:`AngleCalibration`.

    Attributes
    ----------
    residual : ndarray of shape (n,), m
        Errors less the bias, each held out; none without the truth.
    weights : ndarray of shape (n,)
        What each is worth in independent ones.
    """

    model: Model
    evidence: dict[Model, float]
    spread: Spread
    num_independent: float
    bias: float
    bias_stdev: float
    correlation_time: float | None
    correlated_share: float | None
    residual: Array = field(default_factory=lambda: np.zeros(0))
    weights: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, kw_only=True)
class StationCalibration:
    """What was found of a station.

    Attributes
    ----------
    station : Station
        With all of it.
    count : int
        Measurements that went into it.
    places : int
        Places, or stretches of a path, that they are of.
    notes : tuple of str
        What the log does not say.
    """

    station: Station
    angles: AngleCalibration | None
    ranges: RangeCalibration | None
    count: int
    places: int
    notes: tuple[str, ...] = field(default=())


@dataclass(frozen=True, kw_only=True, eq=False)
class AngleTrial:
    """Each model of a station's angles, judged on places that it was not fitted to.

    Attributes
    ----------
    residual : dict
        Of each model, errors less their prediction, shape (n, 1 or 2), deg.
    known : dict
        Deviation of the prediction, likewise.
    gain : dict
        Of each place, shape (k,), the log evidence of its measurements beyond that of the model "none".
    evidence : dict
        Mean log evidence of a measurement.
    """

    errors: AngleErrors
    residual: dict[Model, Array]
    known: dict[Model, Array]
    gain: dict[Model, Array]
    evidence: dict[Model, float]


def try_angles(errors: AngleErrors) -> AngleTrial:
    """Judge each model on places that it was not fitted to."""
    folds = folds_of(errors.place, errors.seconds)
    _, place = np.unique(errors.place, return_inverse=True)
    count = np.bincount(place)
    residual, known, gain, evidence = {}, {}, {}, {}
    for model in MODELS:
        residual[model], known[model] = _held_out(errors, model, folds)
        spread = fit_spread(residual[model], _volume(residual[model]))
        density = log_density(residual[model], spread, _volume(residual[model]))
        evidence[model] = float(density.mean())
        # Measurements of one place mostly repeat each other: a place counts as one.
        gain[model] = np.bincount(place, density) / count
    gain = {model: found - gain["none"] for model, found in gain.items()}
    return AngleTrial(errors=errors, residual=residual, known=known, gain=gain, evidence=evidence)


def chosen_models(trials: Sequence[AngleTrial]) -> list[Model]:
    """Choose a model for each station: that of all stations together, unless a smaller one is clearly better for it."""
    total = {model: sum(float(trial.gain[model].sum()) for trial in trials) for model in MODELS}
    best: Model = max(MODELS, key=lambda model: total[model])
    if total[best] <= 0.0:
        best = "none"
    found = []
    for trial in trials:
        model: Model = best
        for smaller in MODELS[: MODELS.index(best)]:
            better = trial.gain[smaller] - trial.gain[model]
            if better.sum() > _SURE * np.sqrt(len(better)) * max(float(better.std()), 1e-9):
                model = smaller
        found.append(model)
    return found


def final_spread(trial: AngleTrial, model: Model, weights: Array) -> Spread:
    """Spread of the errors that a model leaves over; how well its prediction is known is no part of it."""
    residual, known = trial.residual[model], trial.known[model]
    first = fit_spread(residual, _volume(residual), weights)
    return fit_spread(residual / np.sqrt(1.0 + np.square(known / first.stdev)), _volume(residual), weights)


def independent_shares(place: NDArray[np.int64], share: float) -> Array:
    """Return the number of independent errors that each measurement is worth, shape (n,).

    At a place, the correlated part counts once.

    Parameters
    ----------
    place : ndarray of int of shape (n,)
    share : float
        Of the variance that is correlated.
    """
    _, inverse, count = np.unique(place, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / (1.0 + share * (count[inverse] - 1.0)))


def calibrate_angles(trial: AngleTrial, model: Model) -> AngleCalibration:
    """Fit a model to all of a station's angles."""
    errors = trial.errors
    processes = _fit(errors, model)
    azimuth = processes[0].scales
    share = azimuth.correlated**2 / (azimuth.correlated**2 + azimuth.white**2)
    weights = independent_shares(errors.place, float(share))
    turn, turn_stdev, constant, constant_stdev, notes = _constants(errors, processes, model)
    ranges = [(float(column.min()), float(column.max())) for column in errors.true.T]
    return AngleCalibration(
        model=model,
        evidence=trial.evidence,
        spread=final_spread(trial, model, weights),
        num_independent=float(weights.sum()),
        correlation_time=azimuth.time,
        correlated_share=float(share),
        turn=turn,
        turn_stdev=turn_stdev,
        constant=constant,
        constant_stdev=constant_stdev,
        angles=_grid(errors, processes, turn, constant) if model == "smooth" or notes else None,
        azimuth_range=ranges[0],
        zenith_range=ranges[1],
        notes=notes,
    )


def _volume(residual: Array) -> float:
    return _VOLUME if residual.shape[1] == 2 else 360.0


def _tells_tilt(errors: AngleErrors) -> bool:
    """Whether azimuths reach far enough for a tilt to differ from a constant of the zenith."""
    return float(np.ptp(errors.true[:, 0])) >= _TILT_RANGE


def _has_zenith(errors: AngleErrors) -> bool:
    return bool(np.isfinite(errors.error[:, 1]).all())


def _features(errors: AngleErrors, true: Array) -> list[Array]:
    """Return derivatives of azimuth and zenith by the constants: a turn of the station, or one of each angle."""
    one, none = np.ones((len(true), 1)), np.zeros((len(true), 1))
    if errors.local and _has_zenith(errors):
        azimuth, zenith = turn_derivatives(true)
        if not _tells_tilt(errors):
            azimuth[:, :2] = zenith[:, :2] = 0.0
        return [np.hstack([azimuth, none]), np.hstack([zenith, one])]
    return [np.hstack([one, none]), np.hstack([none, one])]


def _fit(errors: AngleErrors, model: Model, chosen: NDArray[np.bool_] | None = None) -> tuple[Process, ...]:
    """Fit the processes of azimuth and zenith to all errors, or to those that are chosen."""
    chosen = np.ones(len(errors.seconds), bool) if chosen is None else chosen
    columns = 2 if _has_zenith(errors) else 1
    found = []
    for column in range(columns):
        good = chosen & without_outliers(errors.error[:, column], chosen)
        features = _features(errors, errors.true)[column]
        samples = block_means(errors, column, features, good)
        found.append(_process(samples, model, _USUAL[column]))
    return tuple(found)


def _process(samples: Samples, model: Model, usual: Hyperparameters) -> Process:
    free: tuple[str, ...] = ()
    match model:
        case "none":
            usual = replace(usual, linear=1e-6, amplitude=0.0)
        case "constant":
            usual, free = replace(usual, amplitude=0.0), ("linear",)
        case "smooth":
            free = ("linear", "amplitude", "azimuth_scale", "zenith_scale")
    scatter = max(float(np.std(samples.error)), 1e-3)
    usual = replace(
        usual, linear=min(usual.linear, scatter), amplitude=min(usual.amplitude, scatter), correlated=0.6 * scatter,
        white=0.3 * scatter,
    )  # fmt: skip
    return fit_process(samples, usual, free=(*free, "correlated", "white", "time"))


def without_outliers(error: Array, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Errors that are not so large that they must be outliers."""
    middle = np.median(error[chosen])
    scale = 1.4826 * np.median(np.abs(error[chosen] - middle))
    return np.asarray(np.abs(error - middle) <= _FAR * max(float(scale), 1e-6) * 1.5)


def block_means(errors: AngleErrors, column: int, features: Array, chosen: NDArray[np.bool_]) -> Samples:
    """Average measurements that follow each other at a place, so that few stand for many."""
    rows = np.column_stack([errors.true, features, errors.error[:, column], errors.seconds])[chosen]
    order = np.lexsort((errors.seconds[chosen], errors.place[chosen]))
    rows, place = rows[order], errors.place[chosen][order]
    size = max(1, int(np.ceil(len(rows) / MOST_SAMPLES)))
    starts_place = np.append(True, place[1:] != place[:-1])
    first = np.maximum.accumulate(np.where(starts_place, np.arange(len(rows)), 0))
    _, group = np.unique(np.column_stack([place, (np.arange(len(rows)) - first) // size]), axis=0, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group).astype(np.float64)
    means = np.column_stack([np.bincount(group, column) / count for column in rows.T])
    return Samples(
        direction=means[:, :2], features=means[:, 2:-2], error=means[:, -2], seconds=means[:, -1], weight=count
    )


def folds_of(place: NDArray[np.int64], seconds: Array, *, most: int = _FOLDS) -> NDArray[np.int64]:
    """Return the fold of each measurement: places that follow each other are left out together."""
    places, inverse = np.unique(place, return_inverse=True)
    begin = np.array([seconds[place == each].min() for each in places])
    rank = np.empty(len(places), np.int64)
    rank[np.argsort(begin, kind="stable")] = np.arange(len(places))
    return np.asarray(rank[inverse] * min(most, len(places)) // len(places))


def _held_out(errors: AngleErrors, model: Model, folds: NDArray[np.int64]) -> tuple[Array, Array]:
    """Errors less their prediction from the other folds, and the prediction's deviation, shape (n, 1 or 2), deg."""
    columns = 2 if _has_zenith(errors) else 1
    residual, known = errors.error[:, :columns].copy(), np.zeros((len(folds), columns))
    if model == "none":
        return residual, known
    features = _features(errors, errors.true)
    for fold in np.unique(folds):
        out = folds == fold
        processes = _fit(errors, model, ~out)
        for column, process in enumerate(processes):
            _, whole, stdev = process.predict(errors.true[out], features[column][out])
            residual[out, column] -= whole
            known[out, column] = stdev
    return residual, known


def _constants(
    errors: AngleErrors, processes: tuple[Process, ...], model: Model
) -> tuple[Array | None, Array | None, Array, Array, tuple[str, ...]]:
    """Turn of the station and constants, their deviations, and what is not covered."""
    constant, stdev = np.zeros(2), np.zeros(2)
    if model == "none":
        return None, None, constant, stdev, ()
    found = [process.constants for process in processes]
    if not errors.local or len(processes) < 2:
        for column in range(len(processes)):
            constant[column], stdev[column] = found[column][0][column], np.sqrt(found[column][1][column, column])
        return None, None, constant, stdev, ()
    # Both angles tell of the same turn: their posteriors are multiplied, and the prior that both hold taken off once.
    scales = [process.scales.linear for process in processes]
    precision = sum(np.linalg.inv(covariance) for _, covariance in found)
    information = sum(np.linalg.solve(covariance, mean) for mean, covariance in found)
    precision = precision - np.eye(4) / max(scales) ** 2
    covariance = np.linalg.inv(precision)
    mean = covariance @ information
    deviation = np.sqrt(np.diag(covariance))
    notes = []
    low, high = errors.true[:, 0].min(), errors.true[:, 0].max()
    seen = f"it saw targets from {low:.0f} to {high:.0f} deg of azimuth only"
    for n, name in enumerate(_TURN_NAMES):
        if deviation[n] > _KNOWN * max(scales):
            mean[n] = 0.0
            notes.append(f"its turn about {name} is not told: {seen}")
    constant[1], stdev[1] = mean[3], deviation[3]
    return mean[:3], deviation[:3], constant, stdev, tuple(notes)


def _grid(errors: AngleErrors, processes: tuple[Process, ...], turn: Array | None, constant: Array) -> AngleBias:
    """Tabulate what turn and constants leave over, for the directions that were covered and somewhat beyond."""
    axes = []
    for column, least, most, count in ((0, -180.0, 180.0, 37), (1, 0.0, 180.0, 19)):
        scales = [p.scales.azimuth_scale if column == 0 else p.scales.zenith_scale for p in processes]
        beyond = 2.5 * max(scales)
        low, high = errors.true[:, column].min() - beyond, errors.true[:, column].max() + beyond
        low, high = max(low, least), min(high, most)
        step = max((high - low) / (count - 1), min(scales) / 4.0)
        axes.append(np.linspace(low, high, max(2, int(np.ceil((high - low) / step)) + 1)))
    azimuths, zeniths = axes
    true = np.stack(np.meshgrid(azimuths, zeniths), axis=-1).reshape(-1, 2)
    turned = np.zeros(3) if turn is None else turn
    stated = np.append(turned, constant[1]) if errors.local and len(processes) == 2 else constant
    features = _features(errors, true)
    shape = len(zeniths), len(azimuths)
    found = []
    for column in range(2):
        if column < len(processes):
            _, whole, stdev = processes[column].predict(true, features[column])
            rest = whole - features[column] @ stated
        else:
            rest = stdev = np.zeros(len(true))
        found += [_rows(rest.reshape(shape)), _rows(stdev.reshape(shape))]
    # A turned station sees all directions moved.
    azimuths = azimuths - turned[2]
    return AngleBias(
        azimuths=tuple(np.deg2rad(azimuths).tolist()),
        zeniths=tuple(np.deg2rad(zeniths).tolist()),
        azimuth=found[0],
        azimuth_stdev=found[1],
        zenith=found[2],
        zenith_stdev=found[3],
    )


def _rows(degrees: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in np.deg2rad(degrees).tolist())


def calibrated_station(station: Station, angles: AngleCalibration | None, ranges: RangeCalibration | None) -> Station:
    """Return the station with what was found; what was not measured stays as it is."""
    bias, deviations = station.bias, Deviations()
    orientation = station.orientation
    if angles is not None:
        azimuth, zenith = np.deg2rad(angles.constant)
        in_grid = angles.angles is not None
        bias = replace(
            bias,
            azimuth=float(azimuth),
            zenith=float(zenith),
            # The grid states how well all of it is known.
            angle_stdev=0.0 if in_grid else float(np.deg2rad(_constant_stdev(angles))),
            angles=angles.angles,
        )
        if angles.turn is not None:
            turned = local_to_scene(orientation) @ Rotation.from_rotvec(np.deg2rad(angles.turn)).as_matrix()
            a, b, c = Rotation.from_matrix(turned).as_euler("ZYX").tolist()
            orientation = (a, b, c)
        stdev = angles.spread.stdev
        deviations = replace(
            deviations,
            azimuth=float(np.deg2rad(stdev[0])),
            zenith=float(np.deg2rad(stdev[1])) if len(stdev) > 1 else None,
            tail_share=angles.spread.tail_share,
            tail_scale=angles.spread.tail_scale,
        )
    if ranges is not None:
        bias = replace(bias, range=ranges.bias, range_stdev=ranges.bias_stdev)
        deviations = replace(deviations, range=ranges.spread.stdev[0])
        if angles is None:
            deviations = replace(deviations, tail_share=ranges.spread.tail_share, tail_scale=ranges.spread.tail_scale)
    if deviations == Deviations():
        return station
    return replace(station, bias=StationBias(**vars(bias)), deviations=deviations, orientation=orientation)


def _constant_stdev(angles: AngleCalibration) -> float:
    """Deviation of the constants, deg: of the turn about the upright axis and of the zenith, the larger one."""
    turn = 0.0 if angles.turn_stdev is None else float(angles.turn_stdev[2])
    return max(turn, *map(float, angles.constant_stdev))


def num_places(place: NDArray[np.int64]) -> int:
    """Count the places."""
    return len(np.unique(place))
