"""The filter's update with a report of errors that drift.

Unlike :func:`.particles.update` it takes no Gaussians over the position: each particle meets the report with drifts of
its own, so the likelihood comes straight from the path map. For each particle one component of each measurement is
drawn (a path and a Gaussian of its errors, or the outlier) and taken into the prediction to first order; that is the
proposal, from which a position is drawn and weighted with the exact density. Particles are chosen before by how well
their proposals explain the report (Pitt, Shephard 1999; A. Doucet, S. Godsill, C. Andrieu, "On sequential Monte Carlo
sampling methods for Bayesian filtering", Statistics and Computing 10, 2000: local linearisation).
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

_ENOUGH = 0.5
"""Effective number of them, in particles, at which it ends."""

Array = NDArray[np.float64]
DriftOf = tuple[Array, Array, Array]


class KnownHeight(NamedTuple):
    """Gaussian over the height, ``exp(-precision (z - mean)^2 / 2)``: m, 1 / m2."""

    mean: float
    precision: float


def with_drifts(
    particles: Particles, measured: Sequence[Measured], model: DriftModel, rng: np.random.Generator
) -> Particles:
    """Let new particles know what the report that they were drawn from tells of the drifts."""
    count = len(particles)
    drifts = no_drifts(count, rng)
    found = []
    for each in measured:
        drift = _drift_of(drifts, each)
        out = np.empty(count)
        settle(
            particles.position, *each.map, each.factor, each.whole[2], drift, rng.random(count), _components(count), out
        )
        found.append((each.key, drift[0], drift[1]))
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
    drifts = [_drift_of(particles.drifts, each) for each in measured]
    proposal = _propose(particles, measured, drifts, step, middle, height, rng)
    roots, definite = cholesky_factors(proposal.cov)
    log_first = np.where(definite, proposal.log_first, -np.inf)
    top = float(log_first.max())
    if not math.isfinite(top):
        return None
    first = np.exp(log_first - top)
    log_root = np.log(np.where(definite[:, None], np.einsum("nii->ni", roots), 1.0)).sum(axis=1)
    bridge = bridge_of(motion, particles.velocity_variance, seconds, num_steps) if num_steps > 1 else None
    drawn: list[_Drawn] = []
    while True:
        origin = systematic(first, count, rng)
        noise = rng.standard_normal((count, 3))
        end = proposal.mean[origin] + np.einsum("nij,nj->ni", roots[origin], noise)
        log_density, learned = _settled(end, origin, measured, drifts, proposal.chosen)
        apart = end - middle[origin]
        log_weight = log_density - 0.5 * (apart**2 / step.variance + np.log(step.variance)).sum(axis=1)
        if height is not None:
            log_weight -= 0.5 * height.precision * (end[:, 2] - height.mean) ** 2
        log_weight += 0.5 * (noise**2).sum(axis=1) + log_root[origin]
        log_weight -= proposal.log_chosen[origin] + log_first[origin]
        corners = [particles.position[origin], end]
        if bridge is not None:
            straight = seconds / num_steps * particles.velocity[origin]
            corners[1:1] = _on_the_way(bridge, corners[0], straight, apart, rng)
        free = np.ones(count, np.bool_)
        for begin, stop in pairwise(corners):
            free &= walls.passable(begin, stop)
        drawn.append(_Drawn(origin, end, np.where(free, log_weight, -np.inf), learned))
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
        log_evidence=top + math.log(first.mean()) + log_top + math.log(weight.mean()),
        dropped=int(count - np.count_nonzero(definite)),
    )


def _on_the_way(bridge: Bridge, begin: Array, straight: Array, apart: Array, rng: np.random.Generator) -> list[Array]:
    """Draw where particles were between the steps, given by how much their ends are apart from the predictions."""
    num = bridge.gain.shape[1]
    aside = np.einsum("ikl,nil->nki", bridge.root, rng.standard_normal((len(begin), 3, num)))
    return [begin + (k + 1) * straight + bridge.gain[:, k] * apart + aside[:, k] for k in range(num)]


class _Proposal(NamedTuple):
    """Proposals, one for each particle.

    Attributes
    ----------
    mean, cov : ndarray of shape (n, 3), m, and (n, 3, 3), m2
        Gaussian over the new position.
    chosen : list of tuples of ndarrays
        Component of each measurement that it was made with.
    log_chosen : ndarray of shape (n,)
        Logarithm of the probability with which these were drawn.
    log_first : ndarray of shape (n,)
        Log weight to first order.
    """

    mean: Array
    cov: Array
    chosen: list[tuple[NDArray[Any], ...]]
    log_chosen: Array
    log_first: Array


class _Drawn(NamedTuple):
    """Positions, the particles they come from, their log weights, and what they tell of the drifts."""

    origin: NDArray[np.int64]
    end: Array
    log_weight: Array
    learned: list[tuple[Array, Array]]


def _propose(
    particles: Particles,
    measured: Sequence[Measured],
    drifts: Sequence[DriftOf],
    step: Step,
    middle: Array,
    height: KnownHeight | None,
    rng: np.random.Generator,
) -> _Proposal:
    """Take the report in twice: to first order about the predictions as they become better, and about the result."""
    count = len(particles)
    mean, cov, log_height = _predicted(middle, step, height)
    chosen, log_chosen, out = [], np.zeros(count), np.empty(count)
    for each, drift in zip(measured, drifts, strict=True):
        components = _components(count)
        uniform = rng.random(count)
        propose(
            mean, cov, particles.position, *each.around, each.factor, each.whole[2], drift, uniform, components, out
        )
        log_chosen += out
        chosen.append(components)
    about = mean
    mean, cov, log_height = _predicted(middle, step, height)
    log_first = log_height - log_chosen
    for each, drift, components in zip(measured, drifts, chosen, strict=True):
        refine(mean, cov, about, each.map.geometry, each.factor, each.whole[2], drift, components, out)
        log_first += out
    return _Proposal(mean, cov, chosen, log_chosen, log_first)


def _predicted(middle: Array, step: Step, height: KnownHeight | None) -> tuple[Array, Array, Array]:
    """Predictions, with the known height taken in, and the logarithm of its integral over each."""
    mean, variance = middle.copy(), step.variance.copy()
    log_height = np.zeros(len(middle))
    if height is not None:
        told = 1.0 + height.precision * variance[2]
        off = mean[:, 2] - height.mean
        log_height = -0.5 * (height.precision * off**2 / told + math.log(told))
        mean[:, 2] -= off * height.precision * variance[2] / told
        variance[2] /= told
    return mean, np.tile(np.diag(variance), (len(middle), 1, 1)), log_height


def _settled(
    end: Array,
    origin: NDArray[np.int64],
    measured: Sequence[Measured],
    drifts: Sequence[DriftOf],
    chosen: Sequence[tuple[NDArray[Any], ...]],
) -> tuple[Array, list[tuple[Array, Array]]]:
    """Log density of the report at positions, and what the drifts are there."""
    total, out, learned = np.zeros(len(end)), np.empty(len(end)), []
    for each, drift, components in zip(measured, drifts, chosen, strict=True):
        mine = tuple(column[origin] for column in drift)
        taken = tuple(column[origin] for column in components)
        settle(end, *each.map, each.factor, each.whole[2], mine, np.empty(0), taken, out)
        total += out
        learned.append((mine[0], mine[1]))
    return total, learned


def _drift_of(drifts: Drifts, each: Measured) -> DriftOf:
    """Return what particles know of a station's drifts, in arrays that may be changed."""
    mean, variance, share = drifts.of(each.key, each.process, each.whole)
    return np.ascontiguousarray(mean), np.ascontiguousarray(variance), np.ascontiguousarray(share)


def _components(count: int) -> tuple[NDArray[Any], ...]:
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
