"""The filter's update with a report of errors that drift.

Unlike :func:`.particles.update` it takes no Gaussians over the position: each particle meets the report with drifts of
its own, so the likelihood comes straight from the path map. With a position goes one component of each measurement (a
path and a Gaussian of its errors, or the outlier). Both are drawn in two ways, as often the one as the other:

- For each particle components are drawn, and taken into the prediction to first order; a position is drawn from the
  result, of particles chosen by how well this explains the report (Pitt, Shephard 1999; A. Doucet, S. Godsill,
  C. Andrieu, "On sequential Monte Carlo sampling methods for Bayesian filtering", Statistics and Computing 10, 2000:
  local linearisation). This finds the position where errors are small, or their drifts are known.
- A position is drawn from a particle's prediction, then components by their probability there. This finds paths that
  the prediction's middle does not have, and nothing of it is of first order.

Weights are those of draws from the mixture of both (the balance heuristic: E. Veach, L. J. Guibas, "Optimally combining
sampling techniques for Monte Carlo rendering", SIGGRAPH 1995). So a draw counts at most twice what it would by the
better way alone.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.tracking.drift import DriftModel, Drifts, no_drifts
from rayfix_service.tracking.motion import Bridge, MotionModel, Step, bridge_of, step_of
from rayfix_service.tracking.on_paths import Measured
from rayfix_service.tracking.particles import Particles, Updated, systematic
from rayfix_service.tracking.path_kernels import propose, refine, settle
from rayfix_service.tracking.walls import Walls
from rayfix_tables.gaussians.definite import cholesky_factors

_ROUNDS = 8
"""Times that positions are drawn at most."""

_ENOUGH = 1.0
"""Effective number of them, in particles, at which it ends.

Half of the draws have little weight where drifts are known well; with 0.5, what few particles know of them was lost
sooner at ten reports a second.
"""

Array = NDArray[np.float64]
DriftOf = tuple[Array, Array, Array]
Component = tuple[NDArray[Any], ...]


class KnownHeight(NamedTuple):
    """Gaussian over the height, ``exp(-precision (z - mean)^2 / 2)``: m, 1 / m2."""

    mean: float
    precision: float


def with_drifts(
    particles: Particles, measured: Sequence[Measured], model: DriftModel, rng: np.random.Generator
) -> Particles:
    """Let new particles know what the report that they were drawn from tells of the drifts."""
    drifts = no_drifts(len(particles), rng)
    origin = np.arange(len(particles))
    settled = _settled(particles.position, origin, measured, [_drift_of(drifts, each) for each in measured], None, rng)
    found = [(each.key, *learned) for each, learned in zip(measured, settled.learned, strict=True)]
    return replace(particles, drifts=drifts.heard(found, model.max_stations))


def update_drifting(
    particles: Particles,
    measured: Sequence[Measured],
    motion: MotionModel,
    model: DriftModel,
    seconds: float,
    num_steps: int,
    walls: Walls,
    rng: np.random.Generator,
    *,
    height: KnownHeight | None = None,
) -> Updated | None:
    """Predict particles to the time of a report and take the report in; None where all ways are blocked.

    Parameters
    ----------
    particles : Particles
        With drifts that have been aged to the report's time.
    measured : sequence of Measured
    seconds : float
        Time since the particles' last step, positive.
    num_steps : int
        Straight parts that their ways have in this time.
    height : KnownHeight, optional
    """
    assert particles.drifts is not None
    count = len(particles)
    step = step_of(motion, particles.velocity_variance, seconds)
    middle = particles.position + seconds * particles.velocity
    sampler = _Sampler(
        particles.position,
        _predicted(middle, step, height),
        measured,
        [_drift_of(particles.drifts, each) for each in measured],
        rng,
    )
    bridge = bridge_of(motion, particles.velocity_variance, seconds, num_steps) if num_steps > 1 else None
    drawn: list[_Drawn] = []
    while True:
        new = sampler.draw(count)
        corners = [particles.position[new.origin], new.end]
        if bridge is not None:
            straight = seconds / num_steps * particles.velocity[new.origin]
            corners[1:1] = _on_the_way(bridge, corners[0], straight, new.end - middle[new.origin], rng)
        free = np.ones(count, np.bool_)
        for begin, stop in pairwise(corners):
            free &= walls.passable(begin, stop)
        drawn.append(new._replace(log_weight=np.where(free, new.log_weight, -np.inf)))
        weight, log_top = _weights([each.log_weight for each in drawn])
        effective = weight.sum() ** 2 / (weight**2).sum() if math.isfinite(log_top) else 0.0
        if effective >= _ENOUGH * count or len(drawn) == _ROUNDS:
            break
    if not math.isfinite(log_top):
        return None
    kept = systematic(weight, count, rng)
    origin, end = (np.concatenate([each[n] for each in drawn])[kept] for n in (0, 1))
    found = []
    for n, each in enumerate(measured):
        mean, variance = (np.concatenate([one.learned[n][of] for one in drawn])[kept] for of in (0, 1))
        found.append((each.key, mean, variance))
    return Updated(
        particles=Particles(
            position=end,
            velocity=particles.velocity[origin] + step.gain * (end - middle[origin]),
            velocity_variance=step.velocity_variance,
            drifts=particles.drifts.those(origin).heard(found, model.max_stations),
        ),
        log_evidence=log_top + math.log(weight.mean()),
        dropped=sampler.dropped,
    )


def _on_the_way(bridge: Bridge, begin: Array, straight: Array, apart: Array, rng: np.random.Generator) -> list[Array]:
    """Draw where particles were between the steps, given by how much their ends are apart from the predictions."""
    num = bridge.gain.shape[1]
    aside = np.einsum("ikl,nil->nki", bridge.root, rng.standard_normal((len(begin), 3, num)))
    return [begin + (k + 1) * straight + bridge.gain[:, k] * apart + aside[:, k] for k in range(num)]


class _Prediction(NamedTuple):
    """Predictions with the known height taken in.

    Attributes
    ----------
    mean : ndarray of shape (n, 3), m
    variance : ndarray of shape (3,), m2
    log_height : ndarray of shape (n,)
        Logarithm of the height's integral over each.
    """

    mean: Array
    variance: Array
    log_height: Array


class _Taken(NamedTuple):
    """Predictions into which a component of each measurement was taken.

    Attributes
    ----------
    mean, root : ndarray of shape (n, 3), m, and (n, 3, 3), m
        Gaussian over the new position, with the Cholesky factor of its covariance.
    chosen : list of tuples of ndarrays
        The components, as of :func:`.path_kernels.propose`.
    log_chosen : ndarray of shape (n,)
        Logarithm of the probability with which these were drawn; 0 where they were given, -inf where these could not
        have been drawn or have no Gaussian.
    log_joint : ndarray of shape (n,)
        Log density of report and components to first order, -inf as before.
    """

    mean: Array
    root: Array
    chosen: list[Component]
    log_chosen: Array
    log_joint: Array


class _Settled(NamedTuple):
    """What a report is at positions.

    Attributes
    ----------
    log_components, log_all : ndarray of shape (n,)
        Log density of the report and its components, and of the report alone.
    learned : list of tuples of two ndarrays of shape (n, 3)
        Means and variances of each measurement's drifts.
    chosen : list of tuples of ndarrays
        The components.
    """

    log_components: Array
    log_all: Array
    learned: list[tuple[Array, Array]]
    chosen: list[Component]


class _Drawn(NamedTuple):
    """Positions, the particles they come from, their log weights, and what they tell of the drifts."""

    origin: NDArray[np.int64]
    end: Array
    log_weight: Array
    learned: list[tuple[Array, Array]]


class _Sampler:
    """Draws positions for a report, of the mixture of both ways.

    Parameters
    ----------
    home : ndarray of shape (n, 3), m
        Particles before the report.
    prediction : _Prediction
    measured : sequence of Measured
    drifts : sequence of tuples of ndarrays
        Of each measurement.
    """

    def __init__(
        self,
        home: Array,
        prediction: _Prediction,
        measured: Sequence[Measured],
        drifts: Sequence[DriftOf],
        rng: np.random.Generator,
    ) -> None:
        self._home, self._prediction, self._rng = home, prediction, rng
        self._measured, self._drifts = measured, drifts
        self._proposed = self._taken(np.arange(len(home)), None)
        log_first = self._proposed.log_joint - self._proposed.log_chosen
        usable = np.isfinite(log_first)
        self.dropped = int(np.count_nonzero(~usable))
        top = float(log_first[usable].max()) if usable.any() else 0.0
        self._first = np.exp(log_first - top)
        self._log_mean_first = top + math.log(self._first.mean()) if usable.any() else -math.inf

    def draw(self, count: int) -> _Drawn:
        """Draw positions, half of them in either way."""
        num_proposed = (count + 1) // 2 if self._first.any() else 0
        parts = []
        if num_proposed:
            parts.append(self._draw_proposed(num_proposed, num_proposed / count))
        if num_proposed < count:
            parts.append(self._draw_predicted(count - num_proposed, num_proposed / count))
        return parts[0] if len(parts) == 1 else _joined(*parts)

    def _draw_proposed(self, count: int, share: float) -> _Drawn:
        """Draw from the proposals."""
        proposed = self._proposed
        origin = systematic(self._first, count, self._rng)
        noise = self._rng.standard_normal((count, 3))
        end = proposed.mean[origin] + np.einsum("nij,nj->ni", proposed.root[origin], noise)
        chosen = [tuple(column[origin] for column in each) for each in proposed.chosen]
        settled = _settled(end, origin, self._measured, self._drifts, chosen, self._rng)
        taken = proposed.mean[origin], proposed.root[origin], proposed.log_joint[origin]
        return _Drawn(origin, end, self._log_weight(end, origin, settled, taken, share), settled.learned)

    def _draw_predicted(self, count: int, share: float) -> _Drawn:
        """Draw from the predictions; then see with what probability the proposals would have been these."""
        prediction = self._prediction
        origin = systematic(np.ones(len(prediction.mean)), count, self._rng)
        noise = self._rng.standard_normal((count, 3))
        end = prediction.mean[origin] + np.sqrt(prediction.variance) * noise
        settled = _settled(end, origin, self._measured, self._drifts, None, self._rng)
        again = self._taken(origin, settled.chosen)
        taken = again.mean, again.root, again.log_joint
        return _Drawn(origin, end, self._log_weight(end, origin, settled, taken, share), settled.learned)

    def _log_weight(
        self,
        end: Array,
        origin: NDArray[np.int64],
        settled: _Settled,
        taken: tuple[Array, Array, Array],
        share: float,
    ) -> Array:
        """Log weights of draws of which this share were proposed.

        With the weights a and b that a draw would have by one way alone, it is ``1 / (share / a + (1 - share) / b)``.
        """
        mean, root, log_joint = taken
        prediction = self._prediction
        log_height = prediction.log_height[origin]
        apart = end - prediction.mean[origin]
        log_before = log_height - 0.5 * (apart**2 / prediction.variance + np.log(prediction.variance)).sum(axis=1)
        log_predicted = log_height + settled.log_all
        if share == 0.0:
            return log_predicted
        log_proposal = log_joint - self._log_mean_first + _log_gaussian(end - mean, root)
        possible = np.isfinite(settled.log_components)
        log_proposed = log_before + np.where(possible, settled.log_components, 0.0) - log_proposal
        if share == 1.0:
            return np.where(possible, log_proposed, -np.inf)
        both = np.logaddexp(math.log(share) - log_proposed, math.log1p(-share) - log_predicted)
        return np.where(possible, -both, -np.inf)

    def _taken(self, origin: NDArray[np.int64], given: list[Component] | None) -> _Taken:
        """Take the report in twice: to first order about the predictions as they become better, and about the result.

        Parameters
        ----------
        origin : ndarray of int64, shape (n,)
            Particles.
        given : list of tuples of ndarrays, optional
            Components; drawn where left out.
        """
        count, prediction = len(origin), self._prediction
        start = np.diag(prediction.variance)
        drifts = [tuple(column[origin] for column in drift) for drift in self._drifts]
        mean, cov = prediction.mean[origin], np.tile(start, (count, 1, 1))
        chosen = [_components(count) for _ in self._measured] if given is None else given
        log_chosen, out = np.zeros(count), np.empty(count)
        for each, drift, components in zip(self._measured, drifts, chosen, strict=True):
            uniform = self._rng.random(count) if given is None else np.empty(0)
            propose(mean, cov, self._home[origin], tuple(each.around), each.values, drift, uniform, components, out)
            log_chosen += out
        about = mean
        mean, cov = prediction.mean[origin], np.tile(start, (count, 1, 1))
        log_joint = prediction.log_height[origin]
        found = np.isfinite(log_chosen)
        for each, drift, components in zip(self._measured, drifts, chosen, strict=True):
            refine(mean, cov, about, each.map.geometry, each.values, drift, components, out)
            log_joint = log_joint + np.where(found, out, -np.inf)
        root, definite = cholesky_factors(cov)
        root = np.where(definite[:, None, None], root, np.eye(3))
        return _Taken(mean, root, chosen, log_chosen, np.where(definite & found, log_joint, -np.inf))


def _predicted(middle: Array, step: Step, height: KnownHeight | None) -> _Prediction:
    """Take the known height into predictions."""
    mean, variance = middle.copy(), step.variance.copy()
    log_height = np.zeros(len(middle))
    if height is not None:
        told = 1.0 + height.precision * variance[2]
        off = mean[:, 2] - height.mean
        log_height = -0.5 * (height.precision * off**2 / told + math.log(told))
        mean[:, 2] -= off * height.precision * variance[2] / told
        variance[2] /= told
    return _Prediction(mean, variance, log_height)


def _settled(
    end: Array,
    origin: NDArray[np.int64],
    measured: Sequence[Measured],
    drifts: Sequence[DriftOf],
    given: list[Component] | None,
    rng: np.random.Generator,
) -> _Settled:
    """Evaluate the report at positions with components that are given or drawn there, and learn of the drifts."""
    count = len(end)
    log_components, log_all, learned = np.zeros(count), np.zeros(count), []
    chosen = [_components(count) for _ in measured] if given is None else given
    out = np.empty(count), np.empty(count)
    for each, drift, components in zip(measured, drifts, chosen, strict=True):
        mine = tuple(column[origin] for column in drift)
        settle(end, tuple(each.map), each.values, mine, rng.random((count, 2)), given is not None, components, out)
        log_components += out[0]
        log_all += out[1]
        learned.append((mine[0], mine[1]))
    return _Settled(log_components, log_all, learned, chosen)


def _joined(one: _Drawn, other: _Drawn) -> _Drawn:
    """All draws of both."""
    return _Drawn(
        np.concatenate([one.origin, other.origin]),
        np.concatenate([one.end, other.end]),
        np.concatenate([one.log_weight, other.log_weight]),
        [
            (np.concatenate([mean, other_mean]), np.concatenate([variance, other_variance]))
            for (mean, variance), (other_mean, other_variance) in zip(one.learned, other.learned, strict=True)
        ],
    )


def _log_gaussian(apart: Array, root: Array) -> Array:
    """Log density of Gaussians but for ``-1.5 log(2 pi)``, given the Cholesky factors of their covariances."""
    first = apart[:, 0] / root[:, 0, 0]
    second = (apart[:, 1] - root[:, 1, 0] * first) / root[:, 1, 1]
    third = (apart[:, 2] - root[:, 2, 0] * first - root[:, 2, 1] * second) / root[:, 2, 2]
    return np.asarray(-0.5 * (first**2 + second**2 + third**2) - np.log(root[:, 0, 0] * root[:, 1, 1] * root[:, 2, 2]))


def _drift_of(drifts: Drifts, each: Measured) -> DriftOf:
    """Return what particles know of a station's drifts, in arrays that may be changed."""
    mean, variance, share = drifts.of(each.key, each.process, each.whole)
    return np.ascontiguousarray(mean), np.ascontiguousarray(variance), np.ascontiguousarray(share)


def _components(count: int) -> Component:
    return (
        np.full(count, -1, np.int64),
        np.zeros(count),
        np.zeros(count),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
    )


def _weights(logs: Sequence[Array]) -> tuple[Array, float]:
    """Weights relative to the largest, and its logarithm."""
    log = np.concatenate(logs)
    top = float(log.max())
    return (np.exp(log - top) if math.isfinite(top) else np.zeros(len(log))), top
