"""Points that represent a standard normal: a set with exact moments, and a uniform sequence of any length."""

from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

SQUARES = (2.0, 3.0, 7.0)
"""The points of :func:`normal_points` are multiples of the square roots of these primes."""


@cache
def unit_points(count: int = 128) -> NDArray[np.float64]:
    """Points of a standard normal in three dimensions, shape (count, 3), with exactly mean 0 and covariance 1."""
    # An additive recurrence in three dimensions on the generalised golden ratio, mapped to the sphere and the radius.
    ratio = 1.2207440846057596
    index = np.arange(1, count // 2 + 1)
    uniform = (0.5 + index[:, None] * ratio ** -np.arange(1.0, 4.0)) % 1.0
    normal = np.sqrt(-2.0 * np.log(uniform[:, :1])) * np.stack(
        [np.cos(2.0 * np.pi * uniform[:, 1]), np.sin(2.0 * np.pi * uniform[:, 1])], axis=1
    )
    third = np.sqrt(-2.0 * np.log(np.roll(uniform[:, 0], count // 4))) * np.cos(2.0 * np.pi * uniform[:, 2])
    points = np.concatenate([normal, third[:, None]], axis=1)
    points = np.concatenate([points, -points])
    root = np.linalg.cholesky(np.cov(points.T, bias=True))
    unit = np.ascontiguousarray(np.linalg.solve(root, points.T).T)
    unit.flags.writeable = False
    return unit


@cache
def normal_points(count: int) -> NDArray[np.float64]:
    """Quasi-random points of a standard normal in three dimensions, shape (count, 3); any consecutive part is one too.

    Quantiles of multiples of irrational numbers, which fill the unit cube more uniformly than random numbers
    (R. D. Richtmyer, "The evaluation of definite integrals, and a quasi-Monte-Carlo method based on the properties of
    algebraic numbers", 1951).
    With 1,024 points, the radii of the spheres that contain 50 to 99 % of them are exact to 0.5 %.
    """
    uniform = (0.5 + np.arange(1, count + 1)[:, None] * np.sqrt(SQUARES)) % 1.0
    quantile = NormalDist().inv_cdf
    points = np.array([[quantile(value) for value in row] for row in uniform.tolist()])
    points.flags.writeable = False
    return points
