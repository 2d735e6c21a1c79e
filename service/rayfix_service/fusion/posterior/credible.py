"""Credible regions: ellipsoids, circles and layers around a position that hold the UE with a stated probability.

The posterior has several modes and is cut to the free space, so no covariance tells how far a region must reach. Points
drawn evenly from the whole posterior do: the region of probability p is as large as it takes to hold a share p of them.
Where the best candidate is less probable than p, the region reaches to its rivals.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.posterior.cholesky import cholesky
from rayfix_service.fusion.posterior.order_statistics import nth_smallest
from rayfix_service.fusion.posterior.points import Points
from rayfix_service.fusion.posterior.principal_axes import semi_axes


@dataclass(frozen=True, kw_only=True)
class Ellipsoid:
    """All x with ``(x - centre) . shape^-1 (x - centre) <= 1``.

    Attributes
    ----------
    centre : ndarray of shape (3,), m
    shape : ndarray of shape (3, 3), m2
    probability : float
        That the UE lies in it: as asked for, but never more than the share of the regions that it is one of.
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
        Probability that the UE is where the points are. If all measurements are outliers it is anywhere, and no region
        is credible beyond this share.
    """

    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    points: Points
    share: float

    def moved(self, by: NDArray[np.float64]) -> "CredibleRegions":
        """Return the same regions elsewhere, moved by a vector of shape (3,), m."""
        return replace(self, position=self.position + by, points=self.points.moved(by))

    def accuracies(self, probability: float) -> "Accuracies":
        """Circle, layer and ellipsoid that each hold the UE with a probability, in one go."""
        places, held = self.points.places(), self._held(probability)
        radius, half_height, shape = _accuracies(_rows(places), self.position, self.covariance, held)
        ellipsoid = Ellipsoid(centre=self.position, shape=shape, probability=min(probability, self.share))
        return Accuracies(radius, half_height, ellipsoid)

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
        return Ellipsoid(centre=self.position, shape=shape, probability=min(probability, self.share))

    def horizontal_radius(self, probability: float) -> float:
        """Radius, m, of the horizontal circle that holds the UE with a probability."""
        return self.accuracies(probability).horizontal_radius

    def vertical_half_height(self, probability: float) -> float:
        """Half the height, m, of the layer that holds the UE with a probability."""
        return self.accuracies(probability).vertical_half_height

    def _held(self, probability: float) -> float:
        """Share of the points that a region of a probability holds; above 1 where no region is as probable."""
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


def _rows(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give the coordinates of places one after the other, shape (3, k)."""
    return np.ascontiguousarray(places.T)


@numba.njit(cache=True, nogil=True)
def _accuracies(places: Any, position: Any, covariance: Any, held: Any) -> Any:
    """Radius of the circle, half the height of the layer, and shape of the smaller ellipsoid.

    Parameters
    ----------
    places : ndarray of shape (3, k), m
        Of the points.
    position, covariance : ndarray
        As in :class:`CredibleRegions`.
    held : float
        Share of the points that each of them holds.
    """
    apart = _apart(places, position)
    place = _place(held, apart.shape[1])
    x, y, z = apart
    radius = math.sqrt(nth_smallest(x * x + y * y, place))
    half_height = nth_smallest(np.abs(z), place)
    best = _scale(_squared_distances(apart, covariance), place) * covariance
    whole = _second_moment(apart) + 1e-9 * covariance
    other = _scale(_squared_distances(apart, whole), place) * whole
    return radius, half_height, other if _determinant(other) < _determinant(best) else best


@numba.njit(cache=True, nogil=True)
def _reaching(places: Any, position: Any, shape: Any, held: Any) -> Any:
    """Make an ellipsoid of some shape as large as it must be; the other arguments are those of :func:`_accuracies`."""
    apart = _apart(places, position)
    return _scale(_squared_distances(apart, shape), _place(held, apart.shape[1])) * shape


@numba.njit(cache=True, nogil=True)
def _apart(places: Any, position: Any) -> Any:
    """Count places, shape (3, k), from a position."""
    apart = np.empty_like(places)
    for i in range(3):
        apart[i] = places[i] - position[i]
    return apart


@numba.njit(cache=True, nogil=True)
def _place(held: Any, count: Any) -> Any:
    """Place, in the order of the values of points, of the least up to which a share of them lies; else the last."""
    return max(math.ceil(min(1.0, held) * count), 1) - 1


@numba.njit(cache=True, nogil=True)
def _scale(squared_distances: Any, place: Any) -> Any:
    """Factor that makes an ellipsoid reach to the point at a place."""
    return max(nth_smallest(squared_distances, place), 1e-12)


@numba.njit(cache=True, nogil=True)
def _determinant(a: Any) -> Any:
    return (
        a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
        - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
        + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
    )


@numba.njit(cache=True, nogil=True)
def _second_moment(apart: Any) -> Any:
    """Second moment of points about the place from which they are counted, shape (3, 3), m2."""
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
    """Squares of the Mahalanobis distances of points from the place from which they are counted, shape (k,).

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
