"""Compiled kernels of :mod:`rayfix_service.fusion.product.factors`; their NumPy twins are in ``reference.py``."""

from typing import Any, NamedTuple

import numba
import numpy as np

from rayfix_service.fusion.product.information_form import integrate_last, invert_all
from rayfix_service.fusion.product.merging import NO_NOISE, merge_gaussians
from rayfix_tables.gaussians.constants import LOG_2PI
from rayfix_tables.gaussians.triangles import triangle

ALL_GOOD, TIME_OUTLIER, ALL_OUTLIER = 0, 1, 2
"""What an alternative takes for an outlier: nothing, the observation's times, or all of it."""

PART = np.dtype(
    [
        ("outlier", np.int64),
        ("begin", np.int64),
        ("stop", np.int64),
        ("log_weight", np.float64),
        ("length", np.float64),
        ("length_variance", np.float64),
        ("log_clocks", np.float64),
        ("first_reading", np.int64),
        ("last_reading", np.int64),
    ]
)
"""Alternatives of one kind: what they take for an outlier, and what the Gaussians from ``begin`` to ``stop`` become.

They get a weight, are conditioned on a path length [m] unless its variance [m2] is infinite, and take in the readings
of clocks from ``first_reading`` to ``last_reading``; ``log_clocks`` is what those will cost at least.
"""

READING = np.dtype([("clock", np.int64), ("offset", np.float64), ("variance", np.float64)])
"""A time of arrival as a length [m]: path length + offset of a clock + noise of a variance [m2]."""

RELAXED = float(np.log(8.0))
"""Alternatives of a kind that is improbable are merged at up to this many times the divergence (its logarithm)."""


class AlternativeLimits(NamedTuple):
    """Which alternatives of an observation are kept.

    Attributes
    ----------
    log_outlier : float
        Scale of the outlier.
    log_floor : float
        Log evidence, relative to the best alternative's, of what is left out.
    max_divergence : float
        What merging two may cost, nats.
    most : int
        Alternatives that are kept besides the last, those with the highest evidence.
    """

    log_outlier: float
    log_floor: float
    max_divergence: float
    most: int


@numba.njit(cache=True, nogil=True)
def make_alternatives(
    gaussians: Any, parts: Any, readings: Any, num_clocks: Any, prior: Any, limits: Any, stop: Any
) -> Any:
    """Make the alternatives of one observation, the last of them that all of it is an outlier.

    Parameters
    ----------
    gaussians : tuple
        The fields of a ``StationMixture``. Plain tuples, since it takes numba 4 us to find out what a named one is.
    parts : record array of PART, shape (p,)
    readings : record array of READING
    num_clocks : int
        Of the state.
    prior : tuple
        The fields of a ``Prior``, which is not part of the alternatives, but of the judgement which are worth keeping.
    limits : tuple
        The fields of :class:`AlternativeLimits`.
    stop : ndarray of uint8, shape (1,)
        As in :class:`~rayfix_service.fusion.stopping.Stop`, looked at before each part.

    Returns
    -------
    columns : ndarray of shape (rows, n)
        As :mod:`rayfix_service.fusion.product.information_form` has them.
    outlier : ndarray of int8, shape (n,)
    omitted : int
        How many more there would be than ``most``.
    dropped : int
        Alternatives that were left out because rounding made their covariances singular.
    """
    _, mean, cov = gaussians
    log_volume = prior[0]
    limits = AlternativeLimits(*limits)
    offsets = np.zeros(len(parts) + 1, np.int64)
    for p in range(len(parts)):
        offsets[p + 1] = offsets[p] + parts[p]["stop"] - parts[p]["begin"]
    logs, scores = np.empty(offsets[-1]), np.empty(offsets[-1])
    tops = np.empty(len(parts))
    for p in range(len(parts)):
        own = slice(offsets[p], offsets[p + 1])
        tops[p] = weigh(gaussians, parts[p], prior, logs[own], scores[own])
    top = max(limits.log_outlier + log_volume, tops.max())
    dimension = 3 + num_clocks
    most = limits.most
    room = min(offsets[-1], most + np.diff(offsets).max()) + 1
    columns, outlier, value = (
        np.empty((triangle(dimension) + dimension + 1, room)),
        np.empty(room, np.int8),
        np.empty(room),
    )
    done, omitted, dropped = 0, 0, 0
    for p in range(len(parts)):
        if stop[0] != 0:
            break
        part = parts[p]
        keep = np.flatnonzero(scores[offsets[p] : offsets[p + 1]] > top + limits.log_floor)
        own_log, own_mean, own_cov = logs[offsets[p] + keep], mean[part["begin"] + keep], cov[part["begin"] + keep]
        if part["length_variance"] < np.inf:
            condition_on_length(own_mean, own_cov, part["length"], part["length_variance"])
        # The divergence of all parts together is what counts, though a part may turn out to be the right one.
        allowed = limits.max_divergence * np.exp(min(top - tops[p], RELAXED))
        left = merge_gaussians(own_log, own_mean, own_cov, NO_NOISE, allowed)
        own_readings = readings[part["first_reading"] : part["last_reading"]]
        out = slice(done, done + len(left))
        to_columns(own_log[left], own_mean[left], own_cov[left], own_readings, dimension, columns[:, out])
        proper = np.flatnonzero(columns[-1, out] > -np.inf)
        if len(proper) < len(left):
            dropped += len(left) - len(proper)
            for row in range(len(columns)):
                columns[row, done : done + len(proper)] = columns[row, done + proper]
            left = left[proper]
            out = slice(done, done + len(left))
        outlier[out] = part["outlier"]
        value[out] = own_log[left] + part["log_clocks"]
        done = out.stop
        if done > most:
            is_best = np.zeros(done, np.bool_)
            is_best[np.argsort(-value[:done], kind="mergesort")[:most]] = True
            best = np.flatnonzero(is_best)
            for row in range(len(columns)):
                columns[row, :most] = columns[row, best]
            outlier[:most], value[:most] = outlier[best], value[best]
            omitted += done - most
            done = most
    columns[:-1, done] = 0.0
    columns[-1, done] = limits.log_outlier
    outlier[done] = ALL_OUTLIER
    return columns[:, : done + 1].copy(), outlier[: done + 1].copy(), omitted, dropped


@numba.njit(cache=True, nogil=True)
def weigh(gaussians: Any, part: Any, prior: Any, out_log: Any, out_score: Any) -> Any:
    """Give the log evidences of a part's alternatives, and scores: these with what prior and clocks will make of them.

    Parameters
    ----------
    gaussians, prior : tuple
        As in :func:`make_alternatives`.
    part : record of PART
    out_log, out_score : ndarray of shape (n,)
        Of the Gaussians from ``part.begin`` on.

    Returns
    -------
    float
        The highest score.
    """
    log_evidence, mean, cov = gaussians
    _, precision, eta = prior
    highest = -np.inf
    for n in range(len(out_log)):
        k = part["begin"] + n
        log = log_evidence[k] + part["log_weight"]
        z, variance = mean[k, 2], cov[k, 2, 2]
        if part["length_variance"] < np.inf:
            total = cov[k, 3, 3] + part["length_variance"]
            apart = part["length"] - mean[k, 3]
            log -= 0.5 * (apart * apart / total + np.log(total) + LOG_2PI)
            z += cov[k, 2, 3] * apart / total
            variance -= cov[k, 2, 3] * cov[k, 2, 3] / total
        out_log[n] = log
        out_score[n] = log + part["log_clocks"] + height_gain(z, variance, precision, eta)
        highest = max(highest, out_score[n])
    return highest


@numba.njit(cache=True, nogil=True)
def height_gain(z: Any, variance: Any, precision: Any, eta: Any) -> Any:
    """Logarithm of the integral of a Gaussian over z times ``exp(eta z - precision z^2 / 2)``."""
    if precision == 0.0:
        return 0.0
    # Completing the square; (eta - precision z) is the pull towards the known height.
    shrunk = 1.0 + precision * variance
    pull = eta - precision * z
    return z * (eta - 0.5 * precision * z) + 0.5 * (pull * pull * variance / shrunk - np.log(shrunk))


@numba.njit(cache=True, nogil=True)
def condition_on_length(mean: Any, cov: Any, length: Any, variance: Any) -> None:
    """Condition Gaussians over (x, path length) on a measured path length, in place.

    Parameters
    ----------
    mean : ndarray of shape (k, 4), m
    cov : ndarray of shape (k, 4, 4), m2
    length : float, m
    variance : float, m2
    """
    gain = np.empty(4)
    for k in range(len(mean)):
        total = cov[k, 3, 3] + variance
        apart = (length - mean[k, 3]) / total
        for i in range(4):
            gain[i] = cov[k, i, 3]
        for i in range(4):
            mean[k, i] += gain[i] * apart
            for j in range(4):
                cov[k, i, j] -= gain[i] * gain[j] / total


@numba.njit(cache=True, nogil=True)
def to_columns(log_evidence: Any, mean: Any, cov: Any, readings: Any, dimension: Any, out: Any) -> None:
    """Turn Gaussians over (x, path length) into functions of the state, with readings of clocks taken in.

    A reading says ``offset = path length + clock + noise``; the path length is integrated out.

    Parameters
    ----------
    log_evidence : ndarray of shape (n,)
    mean : ndarray of shape (n, 4), m
    cov : ndarray of shape (n, 4, 4), m2
    readings : record array of READING
    dimension : int
        Of the state.
    out : ndarray of shape (rows, n)
        Columns as :mod:`~rayfix_service.fusion.product.information_form` has them. A Gaussian that rounding has made
        singular becomes a function without weight, which the caller leaves out and counts.
    """
    count = len(log_evidence)
    size = 4 if len(readings) else 3
    inverse, det = np.empty((triangle(size), count)), np.empty(count)
    for i in range(size):
        for j in range(i + 1):
            for n in range(count):
                inverse[triangle(i) + j, n] = cov[n, i, j]
    invert_all(inverse, size, det)
    # The path length comes last, after the clocks.
    full = np.zeros((triangle(dimension + 1) + dimension + 2, count))
    first = triangle(dimension + 1)
    for n in range(count):
        full[-1, n] = log_evidence[n] - 0.5 * (size * LOG_2PI + np.log(det[n]) if det[n] > 0.0 else np.inf)
    for i in range(size):
        a = i if i < 3 else dimension
        for j in range(size):
            row = triangle(max(i, j)) + min(i, j)
            if j <= i:
                full[triangle(a) + (j if j < 3 else dimension)] = inverse[row]
            for n in range(count):
                full[first + a, n] += inverse[row, n] * mean[n, j]
        for n in range(count):
            full[-1, n] -= 0.5 * full[first + a, n] * mean[n, i]
    for reading in readings:
        c, weight = 3 + reading["clock"], 1.0 / reading["variance"]
        for n in range(count):
            full[triangle(c) + c, n] += weight
            full[triangle(dimension) + c, n] += weight
            full[triangle(dimension) + dimension, n] += weight
            full[first + c, n] += weight * reading["offset"]
            full[first + dimension, n] += weight * reading["offset"]
            square = weight * reading["offset"] * reading["offset"]
            full[-1, n] -= 0.5 * (square + np.log(reading["variance"]) + LOG_2PI)
    if len(readings):
        pivot = np.ones(count)
        integrate_last(full, dimension + 1, 0.0, pivot, det)
        for n in range(count):
            full[-1, n] -= 0.5 * np.log(pivot[n])
    for row in range(triangle(dimension)):
        out[row] = full[row]
    for i in range(dimension):
        out[triangle(dimension) + i] = full[first + i]
    out[-1] = full[-1]
    for n in range(count):
        if not out[-1, n] > -np.inf:
            out[:, n] = 0.0
            for i in range(dimension):
                out[triangle(i) + i, n] = 1.0
            out[-1, n] = -np.inf
