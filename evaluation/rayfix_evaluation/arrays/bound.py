"""The Cramer-Rao bound of direction cosines."""

import numpy as np

from rayfix_evaluation.arrays.planar import Array, PlanarArray


def cosine_bound(array: PlanarArray, cosines: Array, power: Array, *, noise: float, num_snapshots: int) -> Array:
    """Cramer-Rao bound on the covariance of unbiased estimates of the direction cosines of uncorrelated random waves.

    Parameters
    ----------
    cosines : ndarray of shape (n, 2)
    power : ndarray of shape (n,)
        Power of each wave at one antenna.
    noise : float
        Power of the noise at one antenna.
    num_snapshots : int

    Returns
    -------
    ndarray of shape (2 n, 2 n)
        First the cosines along y of all waves, then those along z.

    Notes
    -----
    P. Stoica, E. G. Larsson, A. B. Gershman, "The stochastic CRB for array processing: a textbook derivation", IEEE
    Signal Processing Letters 8 (2001), equation (10), with two parameters for each wave.
    """
    steering = array.steering(cosines)
    source = np.diag(power).astype(np.complex128)
    cov = steering @ source @ steering.conj().T + noise * np.eye(len(array))
    slopes = [2j * np.pi * array.spacing * array.places[:, [axis]] * steering for axis in range(2)]
    slope = np.concatenate(slopes, axis=1)
    projector = np.eye(len(array)) - steering @ np.linalg.pinv(steering)
    inner = source @ steering.conj().T @ np.linalg.solve(cov, steering @ source)
    information = (slope.conj().T @ projector @ slope) * np.tile(inner, (2, 2)).T
    return np.asarray(np.linalg.inv(2.0 * num_snapshots / noise * information.real))
