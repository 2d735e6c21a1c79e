"""Compiled kernels of the fusion's products. :mod:`rayfix_service.fusion.reference` holds their plain NumPy twins.

A *factor* is what one path of the report says of the state ``z = (x, clock offsets)``: an alternative of it is
``exp(log_scale + eta . z - z . information . z / 2)``, for one component of the table's cell. An alternative that says
nothing of the position is constant over the whole free space, and says nothing of the clocks either; one that says
nothing of a clock is constant over the clock's range.
"""

from typing import Any

import numba
import numpy as np

LOG_2PI = 1.8378770664093453


@numba.njit(cache=True, nogil=True)
def condition_on_angle(
    log_weight: Any,
    u_mean: Any,
    u_cov: Any,
    x_mean: Any,
    jacobian: Any,
    x_cov: Any,
    begins: Any,
    ends: Any,
    rest_mean: Any,
    rest_cov: Any,
    log_factor: Any,
    out_log: Any,
    out_mean: Any,
    out_cov: Any,
) -> None:
    """Condition the components of cells on the rest of the measured angle.

    Parameters
    ----------
    log_weight, u_mean, u_cov, x_mean, jacobian, x_cov : ndarray
        Fields of a :class:`~rayfix_tables.mixture.TubeMixture`.
    begins, ends : ndarray of int64, shape (n,)
        Components of cell ``c`` are those from ``begins[c]`` to ``ends[c]``.
    rest_mean : ndarray of shape (n, 2), rad
    rest_cov : ndarray of shape (n, 3), rad2
        Packed: horizontal variance, covariance, vertical variance.
    log_factor : ndarray of shape (n,)
        Added to the logarithms of all weights of a cell.
    out_log : ndarray of shape (k,)
        Log evidence of each component, cell after cell.
    out_mean : ndarray of shape (k, 4), m
        Mean of (x, path length).
    out_cov : ndarray of shape (k, 4, 4), m2
    """
    u = np.empty(3)
    cov = np.empty((3, 3))
    cross = np.empty((3, 3))
    place = 0
    for c in range(len(begins)):
        for k in range(begins[c], ends[c]):
            p00, p01, p02 = np.float64(u_cov[k, 0]), np.float64(u_cov[k, 1]), np.float64(u_cov[k, 2])
            p11, p12, p22 = np.float64(u_cov[k, 3]), np.float64(u_cov[k, 4]), np.float64(u_cov[k, 5])
            s11, s12, s22 = p11 + rest_cov[c, 0], p12 + rest_cov[c, 1], p22 + rest_cov[c, 2]
            det = s11 * s22 - s12 * s12
            i11, i12, i22 = s22 / det, -s12 / det, s11 / det
            r1 = rest_mean[c, 0] - u_mean[k, 1]
            r2 = rest_mean[c, 1] - u_mean[k, 2]
            g1 = i11 * r1 + i12 * r2
            g2 = i12 * r1 + i22 * r2
            out_log[place] = log_factor[c] + log_weight[k] - 0.5 * (r1 * g1 + r2 * g2 + np.log(det)) - LOG_2PI
            column1 = (p01, p11, p12)
            column2 = (p02, p12, p22)
            prior = ((p00, p01, p02), (p01, p11, p12), (p02, p12, p22))
            for i in range(3):
                u[i] = column1[i] * g1 + column2[i] * g2
                k1 = column1[i] * i11 + column2[i] * i12
                k2 = column1[i] * i12 + column2[i] * i22
                for j in range(3):
                    cov[i, j] = prior[i][j] - k1 * column1[j] - k2 * column2[j]
            for i in range(3):
                moved = np.float64(x_mean[k, i])
                for j in range(3):
                    moved += jacobian[k, i, j] * u[j]
                    total = 0.0
                    for m in range(3):
                        total += jacobian[k, i, m] * cov[m, j]
                    cross[i, j] = total
                out_mean[place, i] = moved
            out_mean[place, 3] = u_mean[k, 0] + u[0]
            packed = 0
            for i in range(3):
                for j in range(i, 3):
                    total = np.float64(x_cov[k, packed])
                    packed += 1
                    for m in range(3):
                        total += cross[i, m] * jacobian[k, j, m]
                    out_cov[place, i, j] = total
                    out_cov[place, j, i] = total
                out_cov[place, i, 3] = cross[i, 0]
                out_cov[place, 3, i] = cross[i, 0]
            out_cov[place, 3, 3] = cov[0, 0]
            place += 1


@numba.njit(cache=True, nogil=True)
def condition_on_length(log_evidence: Any, mean: Any, cov: Any, length: Any, variance: Any) -> None:
    """Condition Gaussians over (x, path length) on a measured path length, in place.

    Parameters
    ----------
    log_evidence : ndarray of shape (k,)
    mean : ndarray of shape (k, 4), m
    cov : ndarray of shape (k, 4, 4), m2
    length : float, m
    variance : float, m2
    """
    gain = np.empty(4)
    for k in range(len(log_evidence)):
        total = cov[k, 3, 3] + variance
        apart = length - mean[k, 3]
        log_evidence[k] -= 0.5 * (apart * apart / total + np.log(total) + LOG_2PI)
        for i in range(4):
            gain[i] = cov[k, i, 3]
        for i in range(4):
            mean[k, i] += gain[i] * apart / total
            for j in range(4):
                cov[k, i, j] -= gain[i] * gain[j] / total


@numba.njit(cache=True, nogil=True)
def cholesky(matrix: Any, lower: Any) -> Any:
    """Cholesky factor into ``lower``; False when the matrix is not positive definite."""
    size = len(matrix)
    for j in range(size):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= lower[j, k] * lower[j, k]
        if not pivot > 0.0:
            return False
        root = np.sqrt(pivot)
        lower[j, j] = root
        for i in range(j + 1, size):
            value = matrix[i, j]
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            lower[i, j] = value / root
    return True


@numba.njit(cache=True, nogil=True)
def invert(lower: Any, inverse: Any) -> None:
    """Inverse of a matrix from its Cholesky factor, into ``inverse``."""
    size = len(lower)
    column = np.empty(size)
    for c in range(size):
        for i in range(size):
            value = 1.0 if i == c else 0.0
            for k in range(i):
                value -= lower[i, k] * column[k]
            column[i] = value / lower[i, i]
        for i in range(size - 1, -1, -1):
            value = column[i]
            for k in range(i + 1, size):
                value -= lower[k, i] * column[k]
            column[i] = value / lower[i, i]
        for i in range(size):
            inverse[i, c] = column[i]


@numba.njit(cache=True, nogil=True)
def to_information(
    keep: Any,
    log_evidence: Any,
    mean: Any,
    cov: Any,
    clocks: Any,
    offsets: Any,
    variances: Any,
    out_information: Any,
    out_eta: Any,
    out_scale: Any,
) -> None:
    """Turn Gaussians over (x, path length) into factors over (x, clock offsets), with times of arrival taken in.

    A time of arrival says ``offset = path length + clock + noise``; the path length is integrated out.

    Parameters
    ----------
    keep : ndarray of int64, shape (n,)
        Gaussians to turn.
    log_evidence : ndarray of shape (k,)
    mean : ndarray of shape (k, 4), m
    cov : ndarray of shape (k, 4, 4), m2
    clocks : ndarray of int64, shape (t,)
        Clock of each time of arrival; its offset is entry ``3 + clock`` of the state.
    offsets : ndarray of shape (t,), m
        Times of arrival, as lengths.
    variances : ndarray of shape (t,), m2
    out_information : ndarray of shape (n, d, d), 1 / m2
    out_eta : ndarray of shape (n, d), 1 / m
    out_scale : ndarray of shape (n,)
    """
    dimension = out_eta.shape[1]
    size = 4 if len(clocks) else 3
    lower = np.empty((size, size))
    inverse = np.empty((size, size))
    full = np.empty((dimension + 1, dimension + 1))
    linear = np.empty(dimension + 1)
    for n in range(len(keep)):
        k = keep[n]
        if not cholesky(cov[k, :size, :size], lower):
            # What the table's rounding has made of a very flat Gaussian: an alternative of no weight.
            out_information[n] = np.eye(dimension)
            out_eta[n] = 0.0
            out_scale[n] = -np.inf
            continue
        invert(lower, inverse)
        full[:] = 0.0
        linear[:] = 0.0
        # The path length comes last, after the clocks.
        scale = log_evidence[k] - 0.5 * size * LOG_2PI
        for i in range(size):
            scale -= np.log(lower[i, i])
        square = 0.0
        for i in range(size):
            a = i if i < 3 else dimension
            for j in range(size):
                b = j if j < 3 else dimension
                full[a, b] = inverse[i, j]
                linear[a] += inverse[i, j] * mean[k, j]
            square += linear[a] * mean[k, i]
        scale -= 0.5 * square
        for t in range(len(clocks)):
            c = 3 + clocks[t]
            precision = 1.0 / variances[t]
            full[c, c] += precision
            full[c, dimension] += precision
            full[dimension, c] += precision
            full[dimension, dimension] += precision
            linear[c] += precision * offsets[t]
            linear[dimension] += precision * offsets[t]
            scale -= 0.5 * (offsets[t] * offsets[t] * precision + np.log(variances[t]) + LOG_2PI)
        if size == 4:
            pivot = full[dimension, dimension]
            scale += 0.5 * (linear[dimension] * linear[dimension] / pivot + LOG_2PI - np.log(pivot))
            for i in range(dimension):
                out_eta[n, i] = linear[i] - full[i, dimension] * linear[dimension] / pivot
                for j in range(dimension):
                    out_information[n, i, j] = full[i, j] - full[i, dimension] * full[dimension, j] / pivot
        else:
            for i in range(dimension):
                out_eta[n, i] = linear[i]
                for j in range(dimension):
                    out_information[n, i, j] = full[i, j]
        out_scale[n] = scale


@numba.njit(cache=True, nogil=True)
def log_integral(
    information: Any, eta: Any, log_scale: Any, log_volume: Any, log_range: Any, work: Any, solved: Any
) -> Any:
    """Logarithm of the integral of a factor over the state; -inf when it has none.

    Parameters
    ----------
    information : ndarray of shape (d, d)
        Only the lower triangle is read.
    log_volume : float
        Natural logarithm of the free space's volume [m3], which stands for a position that nothing constrains.
    log_range : float
        Natural logarithm of the range [m] of a clock that nothing constrains.
    work : ndarray of shape (d, d)
        Scratch.
    solved : ndarray of shape (d,)
        Scratch.
    """
    size = len(eta)
    if information[0, 0] <= 0.0:
        return log_scale + log_volume + (size - 3) * log_range
    # L D L' of the position, which any factor constrains in all three coordinates or not at all.
    a00, a10, a20 = information[0, 0], information[1, 0], information[2, 0]
    l10, l20 = a10 / a00, a20 / a00
    d1 = information[1, 1] - l10 * a10
    t21 = information[2, 1] - l20 * a10
    l21 = t21 / d1 if d1 > 0.0 else 0.0
    d2 = information[2, 2] - l20 * a20 - l21 * t21
    if not (d1 > 0.0 and d2 > 0.0):
        return -np.inf
    s0 = eta[0]
    s1 = eta[1] - l10 * s0
    s2 = eta[2] - l20 * s0 - l21 * s1
    total = log_scale + 1.5 * LOG_2PI
    square = s0 * s0 / a00 + s1 * s1 / d1 + s2 * s2 / d2
    det = a00 * d1 * d2
    if size > 3:
        # Below the diagonal of ``work`` is L, above it D L', on it D.
        work[0, 0], work[1, 1], work[2, 2] = a00, d1, d2
        work[1, 0], work[2, 0], work[2, 1] = l10, l20, l21
        work[0, 1], work[0, 2], work[1, 2] = a10, a20, t21
        solved[0], solved[1], solved[2] = s0, s1, s2
    for j in range(3, size):
        pivot = information[j, j]
        value = eta[j]
        if pivot <= 0.0:
            total += log_range
            work[j, j] = 1.0
            solved[j] = 0.0
            for k in range(j):
                work[j, k] = 0.0
                work[k, j] = 0.0
            continue
        for k in range(j):
            entry = information[j, k]
            for m in range(k):
                entry -= work[j, m] * work[m, k]
            work[k, j] = entry
            work[j, k] = entry / work[k, k]
            pivot -= entry * work[j, k]
            value -= work[j, k] * solved[k]
        if not pivot > 0.0:
            return -np.inf
        work[j, j] = pivot
        solved[j] = value
        square += value * value / pivot
        det *= pivot
        total += 0.5 * LOG_2PI
    return total + 0.5 * (square - np.log(det))


@numba.njit(cache=True, nogil=True)
def _sift_down(scores: Any, order: Any, count: Any) -> None:
    """Restore the heap whose least score is at ``order[0]``, after that entry has changed."""
    i = 0
    while True:
        least = i
        for child in (2 * i + 1, 2 * i + 2):
            if child < count and scores[order[child]] < scores[order[least]]:
                least = child
        if least == i:
            return
        order[i], order[least] = order[least], order[i]
        i = least


@numba.njit(cache=True, nogil=True)
def extend_beam(
    information: Any,
    eta: Any,
    log_scale: Any,
    factor_information: Any,
    factor_eta: Any,
    factor_scale: Any,
    width: Any,
    hopeless: Any,
    log_volume: Any,
    log_range: Any,
) -> Any:
    """Multiply every hypothesis by every alternative of a factor and keep the best products.

    Parameters
    ----------
    information : ndarray of shape (h, d, d)
    eta : ndarray of shape (h, d)
    log_scale : ndarray of shape (h,)
    factor_information : ndarray of shape (k, d, d)
    factor_eta : ndarray of shape (k, d)
    factor_scale : ndarray of shape (k,)
    width : int
        Products to keep.
    hopeless : float
        Products this many nats below the best are given up.
    log_volume, log_range : float
        As in :func:`log_integral`.

    Returns
    -------
    parent, choice : ndarray of int64, shape (n,)
        Hypothesis and alternative of each product, the best first.
    score : ndarray of shape (n,)
        Log evidence of each product.
    """
    size = eta.shape[1]
    work = np.empty((size, size))
    solved = np.empty(size)
    product = np.empty((size, size))
    linear = np.empty(size)
    # No product integrates to more than the one's integral times the other's peak, except where the one is constant
    # and the other wider than the range that this constant is taken to have.
    own = np.empty(len(log_scale))
    bound = np.empty(len(log_scale))
    for h in range(len(log_scale)):
        own[h] = log_integral(information[h], eta[h], log_scale[h], log_volume, log_range, work, solved)
        bound[h] = own[h] if information[h, 0, 0] > 0.0 else np.inf
    least_precision = 4.0 * np.pi * np.exp(-2.0 * log_range)
    peak = np.empty(len(factor_scale))
    for k in range(len(factor_scale)):
        peak[k] = _log_peak(factor_information[k], factor_eta[k], factor_scale[k], work, solved)
        for c in range(3, size):
            if 0.0 < factor_information[k, c, c] < least_precision:
                peak[k] = np.inf
    parent = np.empty(width, np.int64)
    choice = np.empty(width, np.int64)
    score = np.empty(width)
    heap = np.empty(width, np.int64)
    count = 0
    top = -np.inf
    for h in np.argsort(-own):
        for k in range(len(factor_scale)):
            most = bound[h] + peak[k]
            if most < top - hopeless or (count == width and most <= score[heap[0]]):
                continue
            for i in range(size):
                linear[i] = eta[h, i] + factor_eta[k, i]
                for j in range(i + 1):
                    product[i, j] = information[h, i, j] + factor_information[k, i, j]
            value = log_integral(product, linear, log_scale[h] + factor_scale[k], log_volume, log_range, work, solved)
            if value < top - hopeless:
                continue
            top = max(top, value)
            if count < width:
                parent[count], choice[count], score[count] = h, k, value
                # Sift up.
                place = count
                heap[place] = count
                while place > 0 and score[heap[(place - 1) // 2]] > score[heap[place]]:
                    up = (place - 1) // 2
                    heap[up], heap[place] = heap[place], heap[up]
                    place = up
                count += 1
            elif value > score[heap[0]]:
                slot = heap[0]
                parent[slot], choice[slot], score[slot] = h, k, value
                _sift_down(score, heap, count)
    order = np.argsort(-score[:count])
    while count > 1 and score[order[count - 1]] < score[order[0]] - hopeless:
        count -= 1
    order = order[:count]
    return parent[order], choice[order], score[order]


@numba.njit(cache=True, nogil=True)
def _log_peak(information: Any, eta: Any, log_scale: Any, lower: Any, solved: Any) -> Any:
    """Logarithm of a factor's largest value; the state may be constrained in some directions only."""
    size = len(eta)
    lower[:] = 0.0
    solved[:] = 0.0
    total = log_scale
    for j in range(size):
        pivot = information[j, j]
        value = eta[j]
        for k in range(j):
            pivot -= lower[j, k] * lower[j, k]
            value -= lower[j, k] * solved[k]
        if pivot <= 0.0:
            continue
        root = np.sqrt(pivot)
        lower[j, j] = root
        solved[j] = value / root
        total += 0.5 * solved[j] * solved[j]
        for i in range(j + 1, size):
            rest = information[i, j]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            lower[i, j] = rest / root
    return total
