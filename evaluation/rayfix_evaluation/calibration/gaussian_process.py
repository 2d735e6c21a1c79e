"""Gaussian-process regression of a station's errors on the true direction, with errors that are correlated in time.

The systematic error is a constant or a small rotation, which are linear in unknown numbers, plus a smooth function of
azimuth and zenith. The rest has a white part and one that decays exponentially with the time between measurements
(Gauss-Markov). Where nothing was measured the smooth part falls back to zero.

C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, chapters 2.7 and 5.4.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import minimize

__all__ = ["Hyperparameters", "Process", "Samples", "fit_process"]

Array = NDArray[np.float64]

_SPREAD = 0.7
"""Standard deviation of the logarithm of each hyperparameter about its usual value."""

_JITTER = 1e-4


@dataclass(frozen=True, kw_only=True)
class Hyperparameters:
    """Scales of a process; angles in deg, ranges in m.

    Attributes
    ----------
    linear : float
        Standard deviation of the unknown constants.
    amplitude : float
        Standard deviation of the smooth part; 0 for none.
    azimuth_scale, zenith_scale : float, deg
        Directions apart by which it changes.
    correlated, white : float
        Standard deviations of the two parts of the remaining error.
    time : float, s
        In which the correlated part falls to 37 %.
    """

    linear: float = 1.5
    amplitude: float = 5.0
    azimuth_scale: float = 25.0
    zenith_scale: float = 40.0
    correlated: float = 4.0
    white: float = 2.0
    time: float = 15.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Errors of one quantity of a station, n of them.

    Attributes
    ----------
    direction : ndarray of shape (n, 2), deg
        True azimuth and zenith, in the frame of the reports.
    features : ndarray of shape (n, m)
        Derivatives of the error by the m unknown constants.
    error : ndarray of shape (n,)
        Measured minus true.
    seconds : ndarray of shape (n,), s
    weight : ndarray of shape (n,)
        Measurements that each of them is the mean of.
    """

    direction: Array
    features: Array
    error: Array
    seconds: Array
    weight: Array

    def only(self, chosen: NDArray[np.bool_]) -> "Samples":
        """Select some."""
        return Samples(
            direction=self.direction[chosen],
            features=self.features[chosen],
            error=self.error[chosen],
            seconds=self.seconds[chosen],
            weight=self.weight[chosen],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Process:
    """A process conditioned on samples.

    Attributes
    ----------
    scales : Hyperparameters
    samples : Samples
    log_evidence : float
    """

    scales: Hyperparameters
    samples: Samples
    factor: Array
    solved: Array
    log_evidence: float

    @property
    def constants(self) -> tuple[Array, Array]:
        """Mean, shape (m,), and covariance, shape (m, m), of the unknown constants."""
        prior = self.scales.linear**2
        cross = prior * self.samples.features.T
        mean = cross @ self.solved
        covariance = prior * np.eye(len(cross)) - cross @ cho_solve((self.factor, True), cross.T)
        return mean, 0.5 * (covariance + covariance.T)

    def predict(self, direction: Array, features: Array) -> tuple[Array, Array, Array]:
        """Systematic error at directions.

        Returns
        -------
        smooth : ndarray of shape (k,)
            The smooth part of it.
        whole, stdev : ndarray of shape (k,)
            With the constants, and how well that is known.
        """
        smooth = _smooth(direction, self.samples.direction, self.scales)
        cross = smooth + self.scales.linear**2 * features @ self.samples.features.T
        before = self.scales.amplitude**2 + self.scales.linear**2 * np.square(features).sum(axis=1)
        variance = before - np.einsum("ij,ji->i", cross, cho_solve((self.factor, True), cross.T))
        return smooth @ self.solved, cross @ self.solved, np.sqrt(np.maximum(variance, 0.0))


def fit_process(samples: Samples, usual: Hyperparameters, *, free: tuple[str, ...], steps: int = 220) -> Process:
    """Choose the scales by the evidence and their usual values, and condition the process.

    Parameters
    ----------
    samples : Samples
    usual : Hyperparameters
        Medians of log-normal priors.
    free : tuple of str
        Names of those to choose; the others keep their usual values.
    steps : int
        Evaluations of the evidence at most.
    """
    start = np.log([getattr(usual, name) for name in free])

    def scales(logs: Array) -> Hyperparameters:
        return replace(usual, **{name: float(np.exp(value)) for name, value in zip(free, logs, strict=True)})

    def cost(logs: Array) -> float:
        if np.abs(logs - start).max() > 4.0:
            return 1e12
        unusual = 0.5 * float(np.square((logs - start) / _SPREAD).sum())
        try:
            return unusual - _condition(samples, scales(logs)).log_evidence
        except np.linalg.LinAlgError:
            return 1e12

    if not free:
        return _condition(samples, usual)
    options = {"maxfev": steps, "xatol": 0.03, "fatol": 0.05}
    found = minimize(cost, start, method="Nelder-Mead", options=options)
    return _condition(samples, scales(found.x))


def _condition(samples: Samples, scales: Hyperparameters) -> Process:
    covariance = _smooth(samples.direction, samples.direction, scales)
    covariance += scales.linear**2 * samples.features @ samples.features.T
    apart = np.abs(samples.seconds[:, None] - samples.seconds[None, :])
    covariance += scales.correlated**2 * np.exp(-apart / scales.time)
    covariance[np.diag_indices_from(covariance)] += scales.white**2 / samples.weight + _JITTER * scales.white**2
    factor = cholesky(covariance, lower=True, check_finite=False)
    solved = cho_solve((factor, True), samples.error, check_finite=False)
    evidence = -0.5 * samples.error @ solved - np.log(np.diag(factor)).sum() - 0.5 * len(solved) * np.log(2.0 * np.pi)
    return Process(scales=scales, samples=samples, factor=factor, solved=solved, log_evidence=float(evidence))


def _smooth(one: Array, other: Array, scales: Hyperparameters) -> Array:
    """Covariance of the smooth part between directions."""
    if scales.amplitude == 0.0:
        return np.zeros((len(one), len(other)))
    # The chord and not the arc: of arcs around the circle this would be no covariance.
    chord = np.rad2deg(2.0 * np.sin(0.5 * np.deg2rad(one[:, None, 0] - other[None, :, 0])))
    azimuth = chord / scales.azimuth_scale
    zenith = (one[:, None, 1] - other[None, :, 1]) / scales.zenith_scale
    return np.asarray(scales.amplitude**2 * np.exp(-0.5 * (azimuth**2 + zenith**2)))
