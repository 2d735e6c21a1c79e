"""Credible regions: ellipsoids, circles and layers around a position that hold the UE with a stated probability.

The posterior has several hills and is cut to the free space, so no covariance tells how far a region must reach. Points
drawn evenly from the whole posterior do: the region of probability p is as large as it takes to hold a share p of them.
Where the best candidate is less probable than p, the region reaches to its rivals.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.axes import semi_axes
from rayfix_service.fusion.kernels import cholesky, log_sum
from rayfix_service.fusion.selection import nth_smallest
from rayfix_service.fusion.voxels import is_free
from rayfix_tables.freespace import FreeSpace


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
    points : ndarray of shape (n, 3), m
        Stand for the posterior, all alike.
    share : float
        Probability that the UE is where the points are. If all measurements are outliers it is anywhere, and no region
        is credible beyond this share.
    """

    position: NDArray[np.float64]
    covariance: NDArray[np.float64]
    points: NDArray[np.float64]
    share: float

    def accuracies(self, probability: float) -> "Accuracies":
        """Circle, layer and ellipsoid that each hold the UE with a probability, in one go."""
        radius, half_height, shape = _accuracies(self.points, self.position, self.covariance, self._place(probability))
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
        return self._scaled(upright, probability)

    def horizontal_radius(self, probability: float) -> float:
        """Radius, m, of the horizontal circle that holds the UE with a probability."""
        return self.accuracies(probability).horizontal_radius

    def vertical_half_height(self, probability: float) -> float:
        """Half the height, m, of the layer that holds the UE with a probability."""
        return self.accuracies(probability).vertical_half_height

    def _scaled(self, shape: NDArray[np.float64], probability: float) -> Ellipsoid:
        squares = _squared_distances(self.points, self.position, shape)
        return Ellipsoid(
            centre=self.position,
            shape=_scale(squares, self._place(probability)) * shape,
            probability=min(probability, self.share),
        )

    def _place(self, probability: float) -> int:
        """Place, among the points' values in their order, of the least up to which they are as probable.

        The last where they never are.
        """
        count = math.ceil(min(1.0, probability / max(self.share, 1e-9)) * len(self.points))
        return max(count, 1) - 1


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


def posterior_points(
    log_weight: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    free_space: FreeSpace,
    normal_points: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Points that stand for a mixture of Gaussians cut to the free space.

    Each Gaussian gets a share of the points as its weight is (systematic resampling); those in solids are left out.

    Parameters
    ----------
    log_weight : ndarray of shape (h,)
        Of the Gaussians before they are cut.
    mean : ndarray of shape (h, 3), m
    cov : ndarray of shape (h, 3, 3), m2
    normal_points : ndarray of shape (n, 3)
        Fill a standard normal evenly, and so does any run of them.

    Returns
    -------
    ndarray of shape (m, 3), m
        All n of them when none is in the free space.
    """
    places = np.empty_like(normal_points)
    count = _spread(
        log_weight,
        mean,
        cov,
        free_space.origin,
        free_space.voxel_size,
        free_space.free,
        normal_points,
        places,
    )
    return places[:count] if count else _all_points(mean[0], cov[0], normal_points)


def _all_points(
    mean: NDArray[np.float64], cov: NDArray[np.float64], normal_points: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(mean + normal_points @ np.linalg.cholesky(cov).T)


@numba.njit(cache=True, nogil=True)
def _accuracies(points: Any, position: Any, covariance: Any, place: Any) -> Any:
    """Radius of the circle, half the height of the layer, and shape of the smaller ellipsoid."""
    horizontal = np.empty(len(points))
    vertical = np.empty(len(points))
    for n in range(len(points)):
        x, y = points[n, 0] - position[0], points[n, 1] - position[1]
        horizontal[n] = x * x + y * y
        vertical[n] = abs(points[n, 2] - position[2])
    radius = math.sqrt(nth_smallest(horizontal, place))
    half_height = nth_smallest(vertical, place)
    best = _scale(_squared_distances(points, position, covariance), place) * covariance
    whole = _second_moment(points, position) + 1e-9 * covariance
    other = _scale(_squared_distances(points, position, whole), place) * whole
    return radius, half_height, other if _determinant(other) < _determinant(best) else best


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
def _second_moment(points: Any, centre: Any) -> Any:
    """Second moment of points about a centre, shape (3, 3), m2."""
    moment = np.zeros((3, 3))
    for n in range(len(points)):
        x, y, z = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        moment[0, 0] += x * x
        moment[1, 0] += y * x
        moment[1, 1] += y * y
        moment[2, 0] += z * x
        moment[2, 1] += z * y
        moment[2, 2] += z * z
    moment[0, 1], moment[0, 2], moment[1, 2] = moment[1, 0], moment[2, 0], moment[2, 1]
    return moment / len(points)


@numba.njit(cache=True, nogil=True)
def _squared_distances(points: Any, centre: Any, cov: Any) -> Any:
    """Squares of the Mahalanobis distances of points from a centre, shape (n,)."""
    lower = np.empty((3, 3))
    cholesky(cov, lower)
    xx, yx, yy, zx, zy, zz = lower[0, 0], lower[1, 0], lower[1, 1], lower[2, 0], lower[2, 1], lower[2, 2]
    squares = np.empty(len(points))
    for n in range(len(points)):
        x = (points[n, 0] - centre[0]) / xx
        y = (points[n, 1] - centre[1] - yx * x) / yy
        z = (points[n, 2] - centre[2] - zx * x - zy * y) / zz
        squares[n] = x * x + y * y + z * z
    return squares


@numba.njit(cache=True, nogil=True)
def _spread(
    log_weight: Any, mean: Any, cov: Any, origin: Any, voxel_size: Any, free: Any, normal_points: Any, places: Any
) -> Any:
    """Fill ``places`` and tell how many there are."""
    weight = np.exp(log_weight - log_sum(log_weight))
    lower = np.zeros((3, 3))
    x0, y0, z0 = origin
    total = len(normal_points)
    count = 0
    drawn = 0
    reached = 0.0
    for h in range(len(weight)):
        reached += weight[h]
        last = h == len(weight) - 1
        if drawn >= total or (not last and (drawn + 0.5) / total > reached):
            continue
        if not cholesky(cov[h], lower):
            continue
        while drawn < total and (last or (drawn + 0.5) / total <= reached):
            p, q, r = normal_points[drawn, 0], normal_points[drawn, 1], normal_points[drawn, 2]
            drawn += 1
            x = mean[h, 0] + lower[0, 0] * p
            y = mean[h, 1] + lower[1, 0] * p + lower[1, 1] * q
            z = mean[h, 2] + lower[2, 0] * p + lower[2, 1] * q + lower[2, 2] * r
            if is_free(free, (x - x0) / voxel_size, (y - y0) / voxel_size, (z - z0) / voxel_size):
                places[count, 0], places[count, 1], places[count, 2] = x, y, z
                count += 1
    return count
