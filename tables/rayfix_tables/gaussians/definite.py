"""Covariances that are positive definite.

Code that makes a covariance guarantees that it is positive definite; otherwise it drops the component with its weight
and counts it. Code that uses a covariance relies on that.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cholesky_factors(cov: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Cholesky factors of covariances.

    Parameters
    ----------
    cov : ndarray of shape (n, d, d)

    Returns
    -------
    factors : ndarray of shape (n, d, d)
        Lower triangular; zero where a covariance is not positive definite.
    definite : ndarray of bool, shape (n,)
        Whether a covariance is positive definite.
    """
    definite: NDArray[np.bool_] = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    if definite.all():
        try:
            return np.asarray(np.linalg.cholesky(cov), np.float64), definite
        except np.linalg.LinAlgError:
            pass
    factors = np.zeros(cov.shape)
    for n in np.flatnonzero(definite):
        try:
            factors[n] = np.linalg.cholesky(cov[n])
        except np.linalg.LinAlgError:
            definite[n] = False
    return factors, definite


def inverses(matrices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Inverses of covariances, or of information matrices.

    Parameters
    ----------
    matrices : ndarray of shape (n, d, d)

    Returns
    -------
    inverses : ndarray of shape (n, d, d)
        Zero where a matrix or its inverse is not positive definite.
    definite : ndarray of bool, shape (n,)
        Whether both are.
    """
    definite = is_definite(matrices)
    found = np.zeros(matrices.shape)
    found[definite] = np.linalg.inv(matrices[definite])
    definite[definite] = is_definite(found[definite])
    found[~definite] = 0.0
    return found, definite


def is_definite(cov: Array) -> NDArray[np.bool_]:
    """Whether covariances of shape (n, d, d) are positive definite, shape (n,)."""
    return cholesky_factors(cov)[1]


def rounded_definite(cov: Array) -> Array:
    """Round covariances to single precision; those that are positive definite remain positive definite.

    Rounding can make a covariance with a large condition number singular. Its variances are then raised by a few units
    in the last place.

    Parameters
    ----------
    cov : ndarray of shape (n, d, d)

    Returns
    -------
    ndarray of shape (n, d, d)
        Numbers of single precision, as float64.
    """
    rounded = cov.astype(np.float32).astype(np.float64)
    lost = np.flatnonzero(~is_definite(rounded))
    lost = lost[is_definite(cov[lost])]
    raised = 4.0 * float(np.finfo(np.float32).eps)
    diagonal = np.arange(cov.shape[-1])
    while len(lost):
        variances = cov[lost[:, None], diagonal, diagonal] * (1.0 + raised)
        rounded[lost[:, None], diagonal, diagonal] = variances.astype(np.float32)
        lost = lost[~is_definite(rounded[lost])]
        raised *= 2.0
    return rounded
