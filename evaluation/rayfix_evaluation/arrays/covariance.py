"""Covariances of arrays' snapshots, with spatial smoothing to resolve the coherent paths of one transmission."""

import numpy as np

from rayfix_evaluation.arrays.planar import Array, Complex, PlanarArray


def covariance(snapshots: Complex) -> Complex:
    """Sample covariance of snapshots of shape (n_antennas, n), shape (n_antennas, n_antennas)."""
    return np.asarray(snapshots @ snapshots.conj().T / snapshots.shape[1])


def smoothed_covariance(snapshots: Complex, array: PlanarArray, part: PlanarArray) -> Complex:
    """Covariance averaged over all subarrays of a given size, forward and backward.

    Paths of one transmission are coherent and their covariance has rank one: subspace methods cannot resolve them.
    Their phases differ between subarrays, and averaging restores the rank.

    Parameters
    ----------
    snapshots : ndarray of complex of shape (len(array), n)
    part : PlanarArray
        The subarray, with the same spacing.

    Returns
    -------
    ndarray of complex of shape (len(part), len(part))

    Raises
    ------
    ValueError
        If the subarray does not fit.

    Notes
    -----
    S. U. Pillai, B. H. Kwon, "Forward/backward spatial smoothing techniques for coherent signal identification", IEEE
    Transactions on Acoustics, Speech and Signal Processing 37 (1989), along both axes.
    """
    if part.columns > array.columns or part.rows > array.rows or part.spacing != array.spacing:
        raise ValueError(f"{part} is not part of {array}; it must have the same spacing and be no larger")
    grid = snapshots.reshape(array.columns, array.rows, -1)
    total = np.zeros((len(part), len(part)), np.complex128)
    count = 0
    for column in range(array.columns - part.columns + 1):
        for row in range(array.rows - part.rows + 1):
            window = grid[column : column + part.columns, row : row + part.rows].reshape(len(part), -1)
            total += covariance(window)
            count += 1
    forward = total / count
    # Backward average: with the antennas in reverse order, a wave is its conjugate.
    return np.asarray(0.5 * (forward + forward[::-1, ::-1].conj()))


def num_sources(eigenvalues: Array, num_snapshots: int, *, most: int) -> int:
    """Estimate the number of signals by the minimum description length.

    Parameters
    ----------
    eigenvalues : ndarray of shape (n,)
        Eigenvalues of the covariance.
    num_snapshots : int
    most : int
        Largest result; the smallest is 1.

    Notes
    -----
    M. Wax, T. Kailath, "Detection of signals by information theoretic criteria", IEEE Transactions on Acoustics, Speech
    and Signal Processing 33 (1985), equation (17).
    """
    falling = np.maximum(np.sort(eigenvalues)[::-1], 1e-300)
    size = len(falling)
    most = min(most, size - 1)
    lengths = []
    for k in range(most + 1):
        noise = falling[k:]
        flatness = np.log(noise).mean() - np.log(noise.mean())
        lengths.append(-num_snapshots * (size - k) * flatness + 0.5 * k * (2 * size - k) * np.log(num_snapshots))
    return max(1, int(np.argmin(lengths)))
