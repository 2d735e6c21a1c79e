"""The steps of the filter: birth, prediction and update of particles.

A particle is a position with a Gaussian over the velocity (Rao-Blackwellised, see :mod:`.motion`). A report's
likelihood is a sum of Gaussians, so the best proposal is known in closed form: pairs of a particle and a hypothesis are
drawn by the probability of the report given both, and the new position from the product of the prediction and the
hypothesis (the fully adapted filter of M. K. Pitt, N. Shephard, "Filtering via simulation: auxiliary particle filters",
J. American Statistical Association 94 (446), 1999). What remains are the walls: a particle whose way is blocked is
dropped and another drawn.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.tracking.drift import Drifts, joined
from rayfix_service.tracking.likelihood import Likelihood
from rayfix_service.tracking.motion import MotionModel, Step, step_of
from rayfix_service.tracking.walls import Walls
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.definite import cholesky_factors, inverses

_ROUNDS = 8
"""Attempts to find as many particles as are wanted whose ways are not blocked."""

Array = NDArray[np.float64]
_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True, kw_only=True, eq=False)
class Particles:
    """Equally probable states of a target.

    Attributes
    ----------
    position : ndarray of shape (n, 3), m
    velocity : ndarray of shape (n, 3), m / s
        Means.
    velocity_variance : ndarray of shape (3,), m2 / s2
        Of each component about its mean, the same for all particles.
    drifts : Drifts, optional
        Of the stations' errors; None where these are taken for independent.
    """

    position: Array
    velocity: Array
    velocity_variance: Array
    drifts: Drifts | None = None

    def __len__(self) -> int:
        """Return the number of particles."""
        return len(self.position)


@dataclass(frozen=True, kw_only=True, eq=False)
class Updated:
    """Particles after a report.

    Attributes
    ----------
    particles : Particles
    log_evidence : float
        Natural logarithm of the probability density of the report, given the track before it.
    dropped : int
        Hypotheses of the report that were left out because covariances are not positive definite: their own, or those
        of their products with the prediction.
    """

    particles: Particles
    log_evidence: float
    dropped: int = 0


def birth(
    hypotheses: Hypotheses, free_space: FreeSpace, model: MotionModel, count: int, rng: np.random.Generator
) -> Particles | None:
    """Draw particles from a report alone; None where all of its hypotheses lie in solids.

    A hypothesis whose covariance is not positive definite has no weight; None, too, where there is no other.
    """
    roots, definite = cholesky_factors(hypotheses.cov)
    if not definite.any():
        return None
    weight = np.where(definite, np.exp(hypotheses.log_weight - hypotheses.log_weight[definite].max()), 0.0)
    kept = np.empty((0, 3))
    for _ in range(_ROUNDS):
        pick = systematic(weight, count, rng)
        drawn = hypotheses.mean[pick] + np.einsum("nij,nj->ni", roots[pick], rng.standard_normal((count, 3)))
        kept = np.concatenate([kept, drawn[free_space.contains(drawn)]])
        if len(kept) >= count:
            break
    if not len(kept):
        return None
    return Particles(
        position=_exactly(kept, count, rng),
        velocity=np.zeros((count, 3)),
        velocity_variance=model.first_velocity_variance,
    )


def predict(
    particles: Particles, model: MotionModel, seconds: float, walls: Walls, rng: np.random.Generator
) -> Particles | None:
    """Move particles without a report; None where all ways are blocked."""
    step = step_of(model, particles.velocity_variance, seconds)
    middle = particles.position + seconds * particles.velocity
    count = len(particles)

    def draw(num_kept: int) -> tuple[NDArray[np.int64], Array]:
        origin = rng.integers(count, size=count) if num_kept else np.arange(count)
        return origin, middle[origin] + np.sqrt(step.variance) * rng.standard_normal((count, 3))

    ways = _free_ways(particles, walls, draw, rng)
    return None if ways is None else _moved(particles, step, ways, middle)


def update(
    particles: Particles,
    likelihood: Likelihood,
    model: MotionModel,
    seconds: float,
    walls: Walls,
    rng: np.random.Generator,
) -> Updated | None:
    """Predict particles to the time of a report and take the report in; None where all ways are blocked.

    Parameters
    ----------
    seconds : float
        Time since the particles' last step, positive.
    """
    step = step_of(model, particles.velocity_variance, seconds)
    middle = particles.position + seconds * particles.velocity
    # Product of the prediction N(middle, S) with each hypothesis; S is the same for all particles.
    inverse = np.diag(1.0 / step.variance)
    cov, definite = inverses(inverse + likelihood.information)
    if not definite.all():
        likelihood, cov = likelihood.those(definite), cov[definite]
    log_pair = _pair_evidences(middle, step, likelihood, cov)
    top = float(log_pair.max())
    weight = np.exp(log_pair - top)
    count, alternatives = weight.shape
    log_sum = top + math.log(weight.sum()) - math.log(count)
    roots = cholesky_factors(cov)[0]

    def draw(num_kept: int) -> tuple[NDArray[np.int64], Array]:
        origin, chosen = np.divmod(systematic(weight.ravel(), count, rng), alternatives)
        mean = middle[origin]
        pull = likelihood.slope[chosen] - np.einsum(
            "nij,nj->ni", likelihood.information[chosen], mean - likelihood.mean[chosen]
        )
        noise = rng.standard_normal((count, 3))
        return origin, mean + np.einsum("nij,nj->ni", cov[chosen], pull) + np.einsum("nij,nj->ni", roots[chosen], noise)

    ways = _free_ways(particles, walls, draw, rng)
    if ways is None:
        return None
    return Updated(
        particles=_moved(particles, step, ways, middle),
        log_evidence=log_sum + math.log(ways.free_share),
        dropped=likelihood.dropped,
    )


def mixed(track: Particles, newborn: Particles, share: float, rng: np.random.Generator) -> Particles:
    """Replace a fraction of a track's particles by newborn ones; if all are replaced, it is a new track.

    A Gaussian over the velocity is a mixture of narrower ones, so the newborn ones get velocities drawn from their own
    Gaussians and then the track's variance.
    """
    count = len(track)
    num_new = math.floor(share * count + rng.random())
    if num_new >= count:
        return newborn
    if num_new <= 0:
        return track
    stay, come = rng.choice(count, count - num_new, replace=False), rng.choice(count, num_new, replace=False)
    spread = np.sqrt(np.maximum(newborn.velocity_variance - track.velocity_variance, 0.0))
    drawn = newborn.velocity[come] + spread * rng.standard_normal((num_new, 3))
    return Particles(
        position=np.concatenate([track.position[stay], newborn.position[come]]),
        velocity=np.concatenate([track.velocity[stay], drawn]),
        velocity_variance=track.velocity_variance,
        drifts=_both(track.drifts, stay, newborn.drifts, come),
    )


def _both(
    track: Drifts | None, stay: NDArray[np.int64], newborn: Drifts | None, come: NDArray[np.int64]
) -> Drifts | None:
    """Drifts of the particles that stay and of those that come."""
    return None if track is None or newborn is None else joined(track.those(stay), newborn.those(come))


def _pair_evidences(middle: Array, step: Step, likelihood: Likelihood, cov: Array) -> Array:
    """Logarithm of the integral of each prediction times each hypothesis, shape (n, h).

    With ``d`` from the hypothesis' mean to the prediction's middle and ``r = slope - information d``, it is
    ``log_scale + slope . d - d . information d / 2 + r . cov r / 2 - log det(1 + S information) / 2``: a quadratic form
    of ``middle``, which one product of matrices evaluates for all.
    """
    information, slope = likelihood.information, likelihood.slope
    # Counted from the middle of the particles, squares keep their precision.
    centre = middle.mean(axis=0)
    x, mean = middle - centre, likelihood.mean - centre
    towards = information @ cov
    quadratic = information - towards @ information
    linear = slope - np.einsum("hij,hj->hi", towards, slope)
    constant = likelihood.log_scale + 0.5 * np.einsum("hi,hij,hj->h", slope, cov, slope)
    constant += 0.5 * (np.linalg.slogdet(cov)[1] - np.log(step.variance).sum())
    # Expand about the common centre.
    at_mean = np.einsum("hij,hj->hi", quadratic, mean)
    constant -= np.einsum("hi,hi->h", linear, mean) + 0.5 * np.einsum("hi,hi->h", mean, at_mean)
    features = np.concatenate([x, x[:, [0, 1, 2]] * x[:, [0, 1, 2]], x[:, [0, 0, 1]] * x[:, [1, 2, 2]]], axis=1)
    factors = np.concatenate(
        [linear + at_mean, -0.5 * np.einsum("hii->hi", quadratic), -quadratic[:, [0, 0, 1], [1, 2, 2]]], axis=1
    )
    return np.asarray(features @ factors.T + constant)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Ways:
    """Ways through the free space, as many as there are particles.

    Attributes
    ----------
    origin : ndarray of int64, shape (n,)
        Particle that each way begins at.
    end : ndarray of shape (n, 3), m
    free_share : float
        Of the ways that were tried, those that nothing blocks.
    """

    origin: NDArray[np.int64]
    end: Array
    free_share: float


def _free_ways(
    particles: Particles,
    walls: Walls,
    draw: Callable[[int], tuple[NDArray[np.int64], Array]],
    rng: np.random.Generator,
) -> _Ways | None:
    """Draw ways until as many are free as there are particles; None where all are blocked.

    Parameters
    ----------
    draw : callable
        Takes the number of free ways so far and draws the origins and ends of as many ways as there are particles.
    """
    count = len(particles)
    origins, ends, tried = np.empty(0, np.int64), np.empty((0, 3)), 0
    for _ in range(_ROUNDS):
        origin, end = draw(len(origins))
        free = walls.passable(particles.position[origin], end)
        tried += count
        origins, ends = np.concatenate([origins, origin[free]]), np.concatenate([ends, end[free]])
        if len(origins) >= count:
            break
    if not len(origins):
        return None
    chosen = _exactly(np.arange(len(origins)), count, rng)
    return _Ways(origin=origins[chosen], end=ends[chosen], free_share=len(origins) / tried)


def _moved(particles: Particles, step: Step, ways: _Ways, middle: Array) -> Particles:
    """Particles at the ends of their ways, their velocities conditioned on these."""
    return Particles(
        position=ways.end,
        velocity=particles.velocity[ways.origin] + step.gain * (ways.end - middle[ways.origin]),
        velocity_variance=step.velocity_variance,
        drifts=None if particles.drifts is None else particles.drifts.those(ways.origin),
    )


def systematic(weight: Array, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw indices by weight with one random number (systematic resampling: J. Carpenter et al., 1999)."""
    reached = np.cumsum(weight)
    levels = (np.arange(count) + rng.random()) * (reached[-1] / count)
    return np.asarray(np.minimum(np.searchsorted(reached, levels, side="right"), len(weight) - 1))


def _exactly(found: NDArray[_T], count: int, rng: np.random.Generator) -> NDArray[_T]:
    """As many as are wanted: all, and some of them again, or the first."""
    if len(found) >= count:
        return found[rng.permutation(len(found))[:count]]
    return np.concatenate([found, found[rng.integers(len(found), size=count - len(found))]])
