"""How a target moves: nearly constant velocity, each axis on its own.

The acceleration is white noise of spectral density q. Over a time t the position x and the velocity v become

    x' = x + t v + e_x,   v' = v + e_v,   cov(e_x, e_v) = q [[t^3 / 3, t^2 / 2], [t^2 / 2, t]]

(Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, 6.2.2;
Stone Soup's ``ConstantVelocity``). Of a particle the position is known and the velocity is Gaussian. Nothing of that
Gaussian's variance depends on where the particle went, so it is the same for all particles: three numbers.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.validation.limits import Limits, check_limits

Array = NDArray[np.float64]
Positive = Annotated[float, Limits(above=0.0)]


@dataclass(frozen=True, kw_only=True)
class MotionModel:
    """How a target may move.

    Attributes
    ----------
    acceleration_density, vertical_acceleration_density : float, m2 / s3
        Spectral density of the white acceleration along x and y, and along z: after a second the velocity has changed
        by a Gaussian of this variance.
    speed_stdev, vertical_speed_stdev : float, m / s
        Of each component of the velocity of a target that has just been located for the first time.

    Raises
    ------
    SettingsError
        When a value is out of its range.
    """

    acceleration_density: Positive = 0.5
    vertical_acceleration_density: Positive = 0.02
    speed_stdev: Positive = 1.0
    vertical_speed_stdev: Positive = 0.2

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_limits(self)

    @property
    def density(self) -> Array:
        """Spectral densities of the acceleration along x, y and z, shape (3,), m2 / s3."""
        return np.array([self.acceleration_density, self.acceleration_density, self.vertical_acceleration_density])

    @property
    def first_velocity_variance(self) -> Array:
        """Variances of the velocity of a new target along x, y and z, shape (3,), m2 / s2."""
        return np.array([self.speed_stdev, self.speed_stdev, self.vertical_speed_stdev]) ** 2


@dataclass(frozen=True, kw_only=True)
class Step:
    """What a particle does within a time, along each axis.

    Attributes
    ----------
    seconds : float
    variance : ndarray of shape (3,), m2
        Of the new position about ``position + seconds * velocity``.
    gain : ndarray of shape (3,), 1 / s
        By which the velocity follows the new position's distance from there.
    velocity_variance : ndarray of shape (3,), m2 / s2
        Of the velocity once the new position is known.
    """

    seconds: float
    variance: Array
    gain: Array
    velocity_variance: Array


def step_of(model: MotionModel, velocity_variance: Array, seconds: float) -> Step:
    """Predict, and condition the velocity on the position as a Kalman filter does that measures it without noise.

    T. Schon, F. Gustafsson, P.-J. Nordlund, "Marginalized particle filters for mixed linear/nonlinear state-space
    models", IEEE Trans. Signal Processing 53 (7), 2005: the position is the nonlinear part of the state, the velocity
    the linear one.

    Parameters
    ----------
    model : MotionModel
    velocity_variance : ndarray of shape (3,), m2 / s2
        Before the step.
    seconds : float
        Positive.
    """
    density = model.density
    variance = seconds**2 * velocity_variance + density * seconds**3 / 3.0
    both = seconds * velocity_variance + density * seconds**2 / 2.0
    gain = both / variance
    return Step(
        seconds=seconds,
        variance=variance,
        gain=gain,
        velocity_variance=velocity_variance + density * seconds - gain * both,
    )


@dataclass(frozen=True, kw_only=True)
class Bridge:
    """Where a particle was on the way to a known end, at equal steps, along each axis.

    Attributes
    ----------
    gain : ndarray of shape (3, k)
        By which a place on the way follows the end's distance from its prediction.
    root : ndarray of shape (3, k, k), m
        Cholesky factors of the places' covariance about that.
    """

    gain: Array
    root: Array


def bridge_of(model: MotionModel, velocity_variance: Array, seconds: float, num_steps: int) -> Bridge:
    """Condition the places between ``num_steps`` steps on the position at the end.

    For times s <= t, with the variance V of the velocity, ``cov(x(s), x(t)) = s t V + q (s^2 t / 2 - s^3 / 6)``.

    Parameters
    ----------
    velocity_variance : ndarray of shape (3,), m2 / s2
        Before the first step.
    seconds : float
        Of all steps together.
    """
    times = seconds * np.arange(1, num_steps + 1) / num_steps
    early, late = np.minimum(times[:, None], times), np.maximum(times[:, None], times)
    cov = early * late * velocity_variance[:, None, None]
    cov = cov + model.density[:, None, None] * (early**2 * late / 2.0 - early**3 / 6.0)
    gain = cov[:, :-1, -1] / cov[:, -1:, -1]
    left = cov[:, :-1, :-1] - gain[:, :, None] * cov[:, None, :-1, -1]
    return Bridge(gain=gain, root=np.asarray(np.linalg.cholesky(left)))
