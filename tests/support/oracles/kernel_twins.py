"""Plain NumPy twins of the compiled kernels, which the tests compare them with.

They are written for the eye, from the definitions where the kernels take short cuts, and return what the kernels write
into their last arguments. Nothing but the tests calls them.
"""

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.freespace import FreeSpace
from rayfix_tables.mixture import TubeMixture, unpack

Array = NDArray[np.float64]


def condition_on_angle(
    components: TubeMixture, rest_mean: Array, rest_cov: Array, log_factor: float
) -> tuple[Array, Array, Array]:
    """Condition the components of one cell on the rest of the measured angle.

    The ray coordinates u are Gaussian. The position's moments are sums over Gauss-Hermite nodes of u, which are exact
    for the products that a widening tube makes.

    Parameters
    ----------
    components : TubeMixture
        Of k components.
    rest_mean : ndarray of shape (2,), rad
    rest_cov : ndarray of shape (3,), rad2
        Packed: horizontal variance, covariance, vertical variance.
    log_factor : float
        Added to the logarithms of all weights.

    Returns
    -------
    log_evidence : ndarray of shape (k,)
    mean : ndarray of shape (k, 4), m
        Mean of (x, path length).
    cov : ndarray of shape (k, 4, 4), m2
    """
    u_mean, u_cov = components.u_mean.astype(float), unpack(components.u_cov).astype(float)
    noise = np.array([[rest_cov[0], rest_cov[1]], [rest_cov[1], rest_cov[2]]])
    log_likelihood, mean, cov = _condition(u_mean, u_cov, np.eye(3)[[1, 2]], rest_mean, noise)
    log_evidence = components.log_weight.astype(float) + log_likelihood + log_factor
    roots, shares = np.polynomial.hermite_e.hermegauss(4)
    nodes = np.stack(np.meshgrid(roots, roots, roots), axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", shares, shares, shares).ravel() / shares.sum() ** 3
    d = (mean - u_mean)[:, None] + nodes @ np.linalg.cholesky(cov).transpose(0, 2, 1)
    products = d[:, :, :1] * d[:, :, 1:] - u_cov[:, None, 0, 1:]
    jacobian = components.jacobian.astype(float)
    widening = products @ jacobian[:, :, 1:].transpose(0, 2, 1) / u_mean[:, :1, None]
    position = components.x_mean[:, None] + d @ jacobian.transpose(0, 2, 1) + widening
    points = np.concatenate([position, u_mean[:, None, :1] + d[:, :, :1]], axis=2)
    moments = np.einsum("n,kni->ki", weights, points)
    apart = points - moments[:, None]
    spread = np.einsum("n,kni,knj->kij", weights, apart, apart)
    spread[:, :3, :3] += unpack(components.x_cov)
    return log_evidence, moments, spread


def condition_on_length(
    log_evidence: Array, mean: Array, cov: Array, length: float, variance: float
) -> tuple[Array, Array, Array]:
    """Condition Gaussians over (x, path length) on a measured path length.

    Parameters
    ----------
    log_evidence : ndarray of shape (k,)
    mean : ndarray of shape (k, 4), m
    cov : ndarray of shape (k, 4, 4), m2
    length : float, m
    variance : float, m2

    Returns
    -------
    log_evidence, mean, cov : ndarray
        Of the same shapes.
    """
    measured, noise = np.array([length]), np.array([[variance]])
    log_likelihood, mean, cov = _condition(mean, cov, np.eye(4)[[3]], measured, noise)
    return log_evidence + log_likelihood, mean, cov


def to_information(
    log_evidence: Array,
    mean: Array,
    cov: Array,
    clocks: NDArray[np.int64],
    offsets: Array,
    variances: Array,
    dimension: int,
) -> tuple[Array, Array, Array]:
    """Turn Gaussians over (x, path length) into factors over (x, clock offsets), with times of arrival taken in.

    Given x the path length is Gaussian, so a time of arrival is a linear measurement of x and its clock, and all times
    of arrival share the path length's noise.

    Parameters
    ----------
    log_evidence : ndarray of shape (k,)
    mean : ndarray of shape (k, 4), m
    cov : ndarray of shape (k, 4, 4), m2
    clocks : ndarray of int64, shape (t,)
    offsets : ndarray of shape (t,), m
    variances : ndarray of shape (t,), m2
    dimension : int
        d, of the state.

    Returns
    -------
    information : ndarray of shape (k, d, d), 1 / m2
    eta : ndarray of shape (k, d), 1 / m
    log_scale : ndarray of shape (k,)
    """
    count, times = len(log_evidence), len(clocks)
    information, eta = np.zeros((count, dimension, dimension)), np.zeros((count, dimension))
    log_scale = np.empty(count)
    for k in range(count):
        centre, precision = mean[k, :3], np.linalg.inv(cov[k, :3, :3])
        slope = cov[k, 3, :3] @ precision
        length_variance = cov[k, 3, 3] - slope @ cov[k, :3, 3]
        rows = np.zeros((times, dimension))
        rows[:, :3] = slope
        rows[np.arange(times), 3 + clocks] = 1.0
        measured = offsets - mean[k, 3] + slope @ centre
        noise = np.diag(variances) + length_variance
        information[k] = rows.T @ np.linalg.solve(noise, rows)
        information[k, :3, :3] += precision
        eta[k] = rows.T @ np.linalg.solve(noise, measured)
        eta[k, :3] += precision @ centre
        log_scale[k] = (
            log_evidence[k]
            - 0.5 * (centre @ precision @ centre + np.linalg.slogdet(2.0 * np.pi * cov[k, :3, :3])[1])
            - 0.5 * (measured @ np.linalg.solve(noise, measured) + np.linalg.slogdet(2.0 * np.pi * noise)[1])
        )
    return information, eta, log_scale


def log_integral(information: Array, eta: Array, log_scale: Array, log_volume: float, log_range: float) -> Array:
    """Logarithms of the integrals of factors over the state.

    Parameters
    ----------
    information : ndarray of shape (..., d, d), 1 / m2
    eta : ndarray of shape (..., d), 1 / m
    log_scale : ndarray of shape (...)
    log_volume : float
        Natural logarithm of the free space's volume [m3], which stands for a position that nothing constrains.
    log_range : float
        Natural logarithm of the range [m] of a clock that nothing constrains.

    Returns
    -------
    ndarray of shape (...)
    """
    unknown = np.diagonal(information, axis1=-2, axis2=-1) <= 0.0
    filled = information + unknown[..., None] * np.eye(eta.shape[-1])
    peak = 0.5 * (eta * np.linalg.solve(filled, eta[..., None])[..., 0]).sum(axis=-1)
    log_det = np.linalg.slogdet(filled)[1]
    known = np.count_nonzero(~unknown, axis=-1)
    extents = unknown[..., 0] * log_volume + np.count_nonzero(unknown[..., 3:], axis=-1) * log_range
    return np.asarray(log_scale + peak + 0.5 * (known * np.log(2.0 * np.pi) - log_det) + extents)


def extend_beam(
    information: Array,
    eta: Array,
    log_scale: Array,
    factor_information: Array,
    factor_eta: Array,
    factor_scale: Array,
    log_volume: float,
    log_range: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Multiply every hypothesis by every alternative of a factor and keep all products.

    Parameters
    ----------
    information : ndarray of shape (h, d, d)
    eta : ndarray of shape (h, d)
    log_scale : ndarray of shape (h,)
    factor_information : ndarray of shape (k, d, d)
    factor_eta : ndarray of shape (k, d)
    factor_scale : ndarray of shape (k,)
    log_volume, log_range : float
        As in :func:`log_integral`.

    Returns
    -------
    parent, choice : ndarray of int64, shape (h k,)
        Hypothesis and alternative of each product, the best first.
    score : ndarray of shape (h k,)
        Log evidence of each product.
    """
    score = np.concatenate(
        [
            log_integral(factor_information + p, factor_eta + e, factor_scale + s, log_volume, log_range)
            for p, e, s in zip(information, eta, log_scale, strict=True)
        ]
    )
    order = np.argsort(-score, kind="stable")
    parent, choice = np.divmod(order, len(factor_scale))
    return parent, choice, score[order]


def mixture_log_density(points: Array, log_weight: Array, mean: Array, cov: Array) -> Array:
    """Log density of a Gaussian mixture at points of shape (n, 3), one Gaussian after the other."""
    total = np.zeros(len(points))
    for weight, centre, spread in zip(np.exp(log_weight), mean, cov, strict=True):
        apart = points - centre
        square = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(spread), apart)
        total += weight * np.exp(-0.5 * square) / np.sqrt(np.linalg.det(2.0 * np.pi * spread))
    return np.asarray(np.log(total))


def cut_gaussian(mean: Array, cov: Array, points: Array, free_space: FreeSpace) -> tuple[Array, Array, float]:
    """Cut one Gaussian to the free space; returns its mean, covariance and share of points that are free."""
    spread = mean + points @ np.linalg.cholesky(cov).T
    inside = spread[free_space.contains(spread)]
    share = len(inside) / len(points)
    if share in (0.0, 1.0):
        return mean, cov, share
    cut_mean = inside.mean(axis=0)
    if len(inside) > 8:
        cov = 0.9 * np.cov(inside.T, bias=True) + 0.1 * cov
    return cut_mean, cov, share


def draw_points(log_weight: Array, mean: Array, cov: Array, free_space: FreeSpace, normal_points: Array) -> Array:
    """Points of a mixture of Gaussians cut to the free space.

    The n-th normal point is of the Gaussian whose stretch of the summed weights holds (n + 1/2) / count. One with a
    singular covariance leaves its points to the next one.
    """
    weight = np.exp(log_weight - log_weight.max())
    proper = np.linalg.eigvalsh(cov)[:, 0] > 0.0
    place = (np.arange(len(normal_points)) + 0.5) / len(normal_points)
    places = np.empty_like(normal_points)
    ends = np.cumsum(weight / weight.sum())
    for n, point in enumerate(normal_points):
        owner = next(h for h in range(len(ends)) if proper[h] and (place[n] <= ends[h] or h == len(ends) - 1))
        places[n] = mean[owner] + np.linalg.cholesky(cov[owner]) @ point
    return places[free_space.contains(places)]


def climb(log_density: Array, mean: Array, precision: Array, start: Array) -> tuple[Array, Array]:
    """Climb to a mode of a Gaussian mixture by the fixed point of its stationarity condition.

    Parameters
    ----------
    log_density : ndarray of shape (h,)
        Log weight plus half the log determinant of the precision.
    mean : ndarray of shape (h, 3), m
    precision : ndarray of shape (h, 3, 3), 1 / m2
    start : ndarray of shape (3,), m

    Returns
    -------
    mode : ndarray of shape (3,), m
    curvature : ndarray of shape (3, 3), 1 / m2
        Mean precision of the hypotheses there.
    """
    x, curvature = start, np.zeros((3, 3))
    for _ in range(500):
        apart = x - mean
        logs = log_density - 0.5 * np.einsum("hi,hij,hj->h", apart, precision, apart)
        share = np.exp(logs - logs.max())
        share /= share.sum()
        curvature = np.einsum("h,hij->ij", share, precision)
        before, x = x, np.linalg.solve(curvature, np.einsum("h,hij,hj->i", share, precision, mean))
        if np.abs(x - before).max() < 1e-6:
            break
    return x, curvature


def _condition(mean: Array, cov: Array, rows: Array, measured: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Condition Gaussians on ``rows @ z = measured`` plus noise; returns log likelihoods, means and covariances."""
    predicted = rows @ cov @ rows.T + noise
    gain = cov @ rows.T @ np.linalg.inv(predicted)
    apart = measured - mean @ rows.T
    square = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(predicted), apart)
    log_likelihood = -0.5 * (square + np.linalg.slogdet(2.0 * np.pi * predicted)[1])
    return log_likelihood, mean + np.einsum("kij,kj->ki", gain, apart), cov - gain @ rows @ cov
