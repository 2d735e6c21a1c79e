"""Credible regions: ellipsoids, circles and layers around a position that hold the UE with a stated probability.

The posterior has several modes and is cut to the free space, so no covariance determines the size of a region. Points
drawn from the whole posterior do: the region of probability p is the smallest that holds a fraction p of them.
Where the best candidate is less probable than p, the region reaches to its rivals.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.posterior.order_statistics import nth_smallest
from rayfix_service.fusion.posterior.points import Points
from rayfix_service.fusion.posterior.principal_axes import semi_axes
from rayfix_tables.gaussians.cholesky import cholesky


@dataclass(frozen=True, kw_only=True)
class Ellipsoid:
    """All x with ``(x - centre) . shape^-1 (x - centre) <= 1``.

    Attributes
    ----------
    centre : ndarray of shape (3,), m
    shape : ndarray of shape (3, 3), m2
    probability : float
        Probability that the UE lies in it: the requested one, but at most ``share`` of its :class:`CredibleRegions`.
    """

    centre: NDArray[np.float64]
    shape: NDArray[np.float64]
    probability: float

    def holds(self, point: NDArray[np.float64]) -> bool:
        """Whether a point of shape (3,), m, lies in it."""
        apart = point - self.centre
        return bool(apart @ np.linalg.solve(self.shape, apart) <= 1.0)

    @property
    def semi_axes(self) -> NDArray[np.float64]:
        """Vectors from the centre to the ends of the axes, longest first, as rows, shape (3, 3), m."""
        return np.asarray(semi_axes(self.shape))


@dataclass(frozen=True, kw_only=True, eq=False)
class CredibleRegions:
    """Regions around a position.

    Attributes
    ----------
    position : ndarray of shape (3,), m
    covariance : ndarray of shape (3, 3), m2
        Of the best candidate.
    points : Points
        Stand for the posterior.
    share : float
        Probability that the UE is where the points are. If all measurements are outliers it is anywhere, so that no
        region holds it with a higher probability.
    stretch : float
        By how many times regions are larger than the points say, where measurements contradict the model.
    """

    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    points: Points
    share: float
    stretch: float = 1.0

    def moved(self, by: NDArray[np.float64]) -> "CredibleRegions":
        """Return the same regions elsewhere, moved by a vector of shape (3,), m."""
        return replace(self, position=self.position + by, points=self.points.moved(by))

    def accuracies(self, probability: float) -> "Accuracies":
        """Circle, layer and ellipsoid that each hold the UE with a probability, in one go."""
        places, held = self.points.places(), self._held(probability)
        radius, half_height, shape = _accuracies(_rows(places), self.position, self.covariance, held)
        shape = self.stretch**2 * shape
        ellipsoid = Ellipsoid(centre=self.position, shape=shape, probability=min(probability, self.share))
        return Accuracies(self.stretch * radius, self.stretch * half_height, ellipsoid)

    def ellipsoid(self, probability: float) -> Ellipsoid:
        """Ellipsoid that holds the UE with a probability.

        It has the shape of the best candidate's covariance or of the whole posterior's, whichever makes it smaller.
        """
        return self.accuracies(probability).ellipsoid

    def upright_ellipsoid(self, probability: float) -> Ellipsoid:
        """Ellipsoid with one axis vertical that holds the UE with a probability."""
        upright = self.covariance.copy()
        upright[2, :2] = upright[:2, 2] = 0.0
        shape = _reaching(_rows(self.points.places()), self.position, upright, self._held(probability))
        shape = self.stretch**2 * shape
        return Ellipsoid(centre=self.position, shape=shape, probability=min(probability, self.share))

    def horizontal_radius(self, probability: float) -> float:
        """Radius, m, of the horizontal circle that holds the UE with a probability."""
        return self.accuracies(probability).horizontal_radius

    def horizontal_radii(self, probabilities: Sequence[float]) -> list[float]:
        """Radii, m, of the horizontal circles of several probabilities, in one go."""
        apart = np.sort(np.hypot(*(self.points.places() - self.position).T[:2]))
        return [self.stretch * float(apart[_rank(self._held(p), len(apart))]) for p in probabilities]

    def vertical_half_height(self, probability: float) -> float:
        """Half the height, m, of the layer that holds the UE with a probability."""
        return self.accuracies(probability).vertical_half_height

    def _held(self, probability: float) -> float:
        """Fraction of the points that a region of a probability holds; above 1 where no region is as probable."""
        return probability / max(self.share, 1e-9)


class Accuracies(NamedTuple):
    """Regions around a position, each of which holds the UE with the same probability.

    Attributes
    ----------
    horizontal_radius, vertical_half_height : float, m
    ellipsoid : Ellipsoid
    """

    horizontal_radius: float
    vertical_half_height: float
    ellipsoid: Ellipsoid


def _rows(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give the coordinates of positions one after the other, shape (3, k)."""
    return np.ascontiguousarray(positions.T)


@numba.njit(cache=True, nogil=True)
def _accuracies(positions: Any, position: Any, covariance: Any, held: Any) -> Any:
    """Radius of the circle, half the height of the layer, and shape of the smaller ellipsoid.

    Parameters
    ----------
    positions : ndarray of shape (3, k), m
        Of the points.
    position, covariance : ndarray
        As in :class:`CredibleRegions`.
    held : float
        Fraction of the points that each of them holds.
    """
    apart = _apart(positions, position)
    rank = _rank(held, apart.shape[1])
    x, y, z = apart
    radius = math.sqrt(nth_smallest(x * x + y * y, rank))
    half_height = nth_smallest(np.abs(z), rank)
    best = _scale(_squared_distances(apart, covariance), rank) * covariance
    whole = _second_moment(apart) + 1e-9 * covariance
    other = _scale(_squared_distances(apart, whole), rank) * whole
    return radius, half_height, other if _determinant(other) < _determinant(best) else best


@numba.njit(cache=True, nogil=True)
def _reaching(positions: Any, position: Any, shape: Any, held: Any) -> Any:
    """Make an ellipsoid of some shape as large as it must be; the other arguments are those of :func:`_accuracies`."""
    apart = _apart(positions, position)
    return _scale(_squared_distances(apart, shape), _rank(held, apart.shape[1])) * shape


@numba.njit(cache=True, nogil=True)
def _apart(positions: Any, position: Any) -> Any:
    """Differences of positions, shape (3, k), from one position."""
    apart = np.empty_like(positions)
    for i in range(3):
        apart[i] = positions[i] - position[i]
    return apart


@numba.njit(cache=True, nogil=True)
def _rank(held: Any, count: Any) -> Any:
    """Rank, from 0, of the least value that is no smaller than a fraction of all; the last rank where there is none."""
    return max(math.ceil(min(1.0, held) * count), 1) - 1


@numba.njit(cache=True, nogil=True)
def _scale(squared_distances: Any, rank: Any) -> Any:
    """Factor that makes an ellipsoid reach to the point of a rank."""
    return max(nth_smallest(squared_distances, rank), 1e-12)


@numba.njit(cache=True, nogil=True)
def _determinant(a: Any) -> Any:
    return (
        a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
        - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
        + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
    )


@numba.njit(cache=True, nogil=True)
def _second_moment(apart: Any) -> Any:
    """Second moment of differences from a position, shape (3, 3), m2."""
    moment = np.zeros((3, 3))
    for n in range(apart.shape[1]):
        x, y, z = apart[0, n], apart[1, n], apart[2, n]
        moment[0, 0] += x * x
        moment[1, 0] += y * x
        moment[1, 1] += y * y
        moment[2, 0] += z * x
        moment[2, 1] += z * y
        moment[2, 2] += z * z
    moment[0, 1], moment[0, 2], moment[1, 2] = moment[1, 0], moment[2, 0], moment[2, 1]
    return moment / apart.shape[1]


@numba.njit(cache=True, nogil=True)
def _squared_distances(apart: Any, cov: Any) -> Any:
    """Squares of the Mahalanobis lengths of differences from a position, shape (k,).

    They are infinite if the covariance is not positive definite: no ellipsoid of that shape reaches a point.
    """
    lower = np.empty((3, 3))
    if not cholesky(cov, lower):
        return np.full(apart.shape[1], np.inf)
    xx, yx, yy, zx, zy, zz = lower[0, 0], lower[1, 0], lower[1, 1], lower[2, 0], lower[2, 1], lower[2, 2]
    squares = np.empty(apart.shape[1])
    for n in range(len(squares)):
        x = apart[0, n] / xx
        y = (apart[1, n] - yx * x) / yy
        z = (apart[2, n] - zx * x - zy * y) / zz
        squares[n] = x * x + y * y + z * z
    return squares
