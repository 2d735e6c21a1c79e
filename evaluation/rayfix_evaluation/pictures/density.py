"""Gaussian mixtures on a grid of two coordinates, and contours that contain a fraction of their mass."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def marginal_density(
    weight: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    coordinates: tuple[int, int],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Density of a mixture over two of its coordinates, the others integrated out.

    Parameters
    ----------
    weight : ndarray of shape (n,)
    mean : ndarray of shape (n, 3), m
    cov : ndarray of shape (n, 3, 3), m2
    coordinates : tuple of 2 ints
    x, y : ndarray of shape (nx,) and (ny,), m
        Coordinates of the grid, in the order of ``coordinates``.

    Returns
    -------
    ndarray of shape (ny, nx), 1/m2
    """
    pick = list(coordinates)
    density = np.zeros((len(y), len(x)))
    for share, middle, spread in zip(weight, mean[:, pick], cov[:, pick][:, :, pick], strict=True):
        precision = np.linalg.inv(spread)
        dx, dy = x[None, :] - middle[0], y[:, None] - middle[1]
        square = precision[0, 0] * dx**2 + 2.0 * precision[0, 1] * dx * dy + precision[1, 1] * dy**2
        density += share * np.sqrt(np.linalg.det(precision)) / (2.0 * np.pi) * np.exp(-0.5 * square)
    return density


def credible_levels(density: NDArray[np.float64], shares: Sequence[float]) -> list[float]:
    """Density levels that enclose given fractions of the mass on the grid, ascending, without duplicates.

    Parameters
    ----------
    density : ndarray
        On a uniform grid.
    shares : sequence of float
        Between 0 and 1.
    """
    ordered = np.sort(density, axis=None)[::-1]
    total = ordered.sum()
    if not total > 0.0:
        return []
    mass = np.cumsum(ordered) / total
    return sorted({float(ordered[min(int(np.searchsorted(mass, share)), len(ordered) - 1)]) for share in shares})
