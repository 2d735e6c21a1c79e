"""The motion model against a Kalman filter over position and velocity."""

import numpy as np
import pytest

from rayfix_service.tracking.motion import MotionModel, step_of


@pytest.mark.parametrize("seconds", [(0.2, 0.2, 0.2), (0.05, 1.5, 0.3)])
def test_the_velocity_is_that_of_a_kalman_filter_that_sees_positions_without_noise(seconds: tuple[float, ...]):
    rng = np.random.default_rng(1)
    model = MotionModel()
    position, velocity, variance = np.zeros(3), np.zeros(3), model.first_velocity_variance
    means = np.zeros((3, 2))
    covs = [np.diag([0.0, v]) for v in variance]
    for t in seconds:
        step = step_of(model, variance, t)
        measured = position + rng.normal(size=3)
        expected_variance = []
        for axis in range(3):
            transition = np.array([[1.0, t], [0.0, 1.0]])
            noise = model.density[axis] * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
            mean, cov = transition @ means[axis], transition @ covs[axis] @ transition.T + noise
            expected_variance.append(cov[0, 0])
            gain = cov[:, 0] / cov[0, 0]
            means[axis] = mean + gain * (measured[axis] - mean[0])
            covs[axis] = cov - np.outer(gain, cov[0])
        np.testing.assert_allclose(step.variance, expected_variance, rtol=1e-12)
        velocity = velocity + step.gain * (measured - (position + t * velocity))
        position, variance = measured, step.velocity_variance
        np.testing.assert_allclose(velocity, means[:, 1], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(variance, [cov[1, 1] for cov in covs], rtol=1e-10)


def test_two_short_predictions_spread_as_one_long():
    """Without anything seen between, positions after 2 s vary as much as the sum of the parts' own covariances."""
    model = MotionModel()
    variance = np.array([0.3, 0.2, 0.1])
    once = step_of(model, variance, 2.0)
    first = step_of(model, variance, 1.0)
    # Of x2 = x1 + v1 + e: the velocity after the first step goes with its position by the gain.
    both = (1.0 + first.gain) ** 2 * first.variance + step_of(model, first.velocity_variance, 1.0).variance
    np.testing.assert_allclose(both, once.variance, rtol=1e-12)
