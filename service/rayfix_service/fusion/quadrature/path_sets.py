"""The likelihood of positions given sets of measured paths, from the path map.

A station reports each of the paths k to x with a probability p_k, and spurious ones besides. Measured path j is of one
of them or spurious, and no two are of one path, which is what keeps a path from being counted twice. With the
assignments a of measured paths to different paths, and the offset b of the UE's clock,

    p(Y | x) = int db / W sum_a prod_{j spurious} kappa_j prod_{j of k} p_k f_j(y_j; k, x, b) prod_{k missed} (1 - p_k)

Both probabilities enter with the exponent ``_TOGETHER``. Poisson sets are the limit of small p_k, where the product of
all (1 - p_k) is exp(-Lambda). A station may report only its strongest paths: of m measured ones, the m strongest to x
are those that may count as missed. For each point the sum is built up by a beam: measured path after measured path,
each hypothesis branches into "spurious" and the paths that are still free; its offset is a Gaussian, so that the
integral over b is in closed form. The best hypotheses are kept.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.quadrature.factor import _angle_of

MOST_MEASURED = 62
"""Measured paths of a report: each is a bit of a hypothesis."""

_BEAM = 24
"""Hypotheses of a point that are kept."""

_MOST_CANDIDATES = 62
"""Paths to a point that are taken into account, those most probable to be reported; each is a bit."""

_FAINT = 1e-3
"""Paths that are less probably reported are never what was measured."""

_FAR = 40.0
"""Squared deviation, in variances, from which on a path has nothing to do with the measured one."""

_LOW = 16.0
"""Hypotheses that are less probable than the best one by more, nats, are left out."""

_TOGETHER = 0.5
"""Exponent of the probabilities to be reported: what hides one path of a station often hides others, so that their
evidence is not independent."""

NO_CLOCK, CLOCK = 0, 1


class MeasuredSet(NamedTuple):
    """Measured paths of one station, as the kernel takes them.

    Attributes
    ----------
    turn : ndarray of shape (m, 3, 3)
        Takes directions of the scene to the frame of the measured angles, turned so that the measured azimuth is 0.
    toward : ndarray of shape (m, 3)
        Measured direction in the scene; NaN where there is no zenith.
    zenith : ndarray of shape (m,), rad
        NaN where it was not measured.
    cov : ndarray of shape (m, 3), rad2
        Variance of the azimuth, covariance, variance of the zenith. Infinite for what was not measured.
    length : ndarray of shape (m,), m
        Path length, or path length plus the offset of the clock.
    length_variance : ndarray of shape (m,), m2
        Infinite where no length was measured.
    log_spurious : ndarray of shape (m,)
        Log density of a spurious path, times the number of spurious ones that is expected.
    bit : ndarray of int64, shape (m,)
        Of each measured path in the hypotheses.
    on_clock : int
        Whether the lengths have the offset of a clock.
    log_range : float
        Natural logarithm of the range of that offset, m.
    """

    turn: NDArray[np.float64]
    toward: NDArray[np.float64]
    zenith: NDArray[np.float64]
    cov: NDArray[np.float64]
    length: NDArray[np.float64]
    length_variance: NDArray[np.float64]
    log_spurious: NDArray[np.float64]
    bit: NDArray[np.int64]
    on_clock: int
    log_range: float


class Beams(NamedTuple):
    """Hypotheses of each point.

    Attributes
    ----------
    number : ndarray of int64, shape (n,)
    log_weight : ndarray of shape (n, h)
    offset, variance : ndarray of shape (n, h), m and m2
        Of the clock's offset; the variance is infinite as long as no path has told of it.
    told : ndarray of shape (n, h), 1 / m2
        Information about the position.
    spurious : ndarray of int64, shape (n, h)
        Bits of the measured paths that are spurious.
    """

    number: NDArray[np.int64]
    log_weight: NDArray[np.float64]
    offset: NDArray[np.float64]
    variance: NDArray[np.float64]
    told: NDArray[np.float64]
    spurious: NDArray[np.int64]


def new_beams(count: int) -> Beams:
    """Beams of one hypothesis each, which nothing has been said of yet."""
    return Beams(
        number=np.ones(count, np.int64),
        log_weight=np.zeros((count, _BEAM)),
        offset=np.zeros((count, _BEAM)),
        variance=np.full((count, _BEAM), np.inf),
        told=np.zeros((count, _BEAM)),
        spurious=np.zeros((count, _BEAM), np.int64),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def extend_beams(
    points: Any, blocks: Any, spread: Any, resolution: Any, paths: Any, geometry: Any, measured: Any, beams: Any
) -> None:
    """Take the measured paths of one station into the hypotheses of points.

    Parameters
    ----------
    points : ndarray of shape (n, 3), m
    blocks : ndarray of int64, shape (n,)
        Block of each point.
    spread, resolution : float
        As in :func:`rayfix_service.fusion.quadrature.factor.evaluate`.
    paths, geometry : tuple
        Of :class:`.blocks.BlockPaths`, whose weights are the probabilities to be reported; images and mirrors.
    measured : tuple
        Of :class:`MeasuredSet`.
    beams : tuple
        Of :class:`Beams`; changed in place.
    """
    offsets, sequence, weight, excess, _ = paths
    passes = len(excess) > 0
    images, mirrors = geometry
    turn, toward, zenith, cov, measured_length, length_variance, log_spurious, bit, on_clock, log_range = measured
    count, log_weight, offset, variance, told, spurious = beams
    num_measured = len(zenith)
    match = np.empty((num_measured, _MOST_CANDIDATES))
    lengths, of_angle = np.empty(_MOST_CANDIDATES), np.empty((num_measured, _MOST_CANDIDATES))
    most = _BEAM * (_MOST_CANDIDATES + 1)
    new = np.empty((most, 4))
    new_bits, used = np.empty((most, 2), np.int64), np.zeros(_BEAM, np.int64)
    for n in range(len(points)):
        block = blocks[n]
        num_candidates, log_missed = 0, 0.0
        for path in range(offsets[block], offsets[block + 1]):
            p = min(float(weight[path]), 0.999)
            if p < _FAINT or num_candidates == _MOST_CANDIDATES:
                break
            log_odds = _TOGETHER * np.log(p)
            if path - offsets[block] < num_measured:
                log_missed += _TOGETHER * np.log1p(-p)
                log_odds -= _TOGETHER * np.log1p(-p)
            s = sequence[path]
            x, y, z = points[n, 0] - images[s, 0], points[n, 1] - images[s, 1], points[n, 2] - images[s, 2]
            square = max(x * x + y * y + z * z, spread, 1e-6)
            length = np.sqrt(square)
            a = mirrors[s, 0, 0] * x + mirrors[s, 1, 0] * y + mirrors[s, 2, 0] * z
            b = mirrors[s, 0, 1] * x + mirrors[s, 1, 1] * y + mirrors[s, 2, 1] * z
            c = mirrors[s, 0, 2] * x + mirrors[s, 1, 2] * y + mirrors[s, 2, 2] * z
            measured_as = length + (excess[path] if passes else 0.0)
            some = False
            for j in range(num_measured):
                match[j, num_candidates] = -np.inf
                with_angle, with_zenith = np.isfinite(cov[j, 0]), np.isfinite(cov[j, 2])
                information = 1.0 / length_variance[j]
                if with_angle:
                    least = min(cov[j, 0], cov[j, 2]) if with_zenith else cov[j, 0]
                    information += 1.0 / (least * square)
                blur = spread if spread * information > resolution else 0.0
                log_density = log_odds
                if not on_clock and length_variance[j] < np.inf:
                    wide = length_variance[j] + blur
                    apart = measured_as - measured_length[j]
                    if apart * apart > _FAR * wide:
                        continue
                    log_density -= 0.5 * (apart * apart / wide + np.log(2.0 * np.pi * wide))
                if with_zenith:
                    along = a * toward[j, 0] + b * toward[j, 1] + c * toward[j, 2]
                    widest = max(cov[j, 0], cov[j, 2])
                    if 2.0 * (length - along) * length > _FAR * (widest * square + blur):
                        continue
                if with_angle:
                    u = turn[j, 0, 0] * a + turn[j, 0, 1] * b + turn[j, 0, 2] * c
                    v = turn[j, 1, 0] * a + turn[j, 1, 1] * b + turn[j, 1, 2] * c
                    horizontal = max(u * u + v * v, 1e-9 * square)
                    across = np.sqrt(horizontal)
                    azimuth_error = _angle_of(u, v, across)
                    aa = cov[j, 0] + blur / horizontal
                    if with_zenith:
                        w = turn[j, 2, 0] * a + turn[j, 2, 1] * b + turn[j, 2, 2] * c
                        sine, cosine = np.sin(zenith[j]), np.cos(zenith[j])
                        zenith_error = _angle_of(w * cosine + across * sine, across * cosine - w * sine, length)
                        az, zz = cov[j, 1], cov[j, 2] + blur / square
                        determinant = aa * zz - az * az
                        distance = (
                            zz * azimuth_error**2 - 2.0 * az * azimuth_error * zenith_error + aa * zenith_error**2
                        ) / determinant
                        log_density -= 0.5 * distance + np.log(2.0 * np.pi * np.sqrt(determinant) * sine)
                    else:
                        distance = azimuth_error**2 / aa
                        log_density -= 0.5 * (distance + np.log(2.0 * np.pi * aa))
                    if distance > _FAR:
                        continue
                match[j, num_candidates] = log_density
                of_angle[j, num_candidates] = information
                some = True
            if some:
                lengths[num_candidates] = measured_as
                num_candidates += 1
        h = count[n]
        used[:h] = 0
        for j in range(num_measured):
            total, best = 0, -np.inf
            for old in range(h):
                value = log_weight[n, old] + log_spurious[j]
                _put(new, total, value, offset[n, old], variance[n, old], told[n, old])
                new_bits[total, 0], new_bits[total, 1] = spurious[n, old] | (np.int64(1) << bit[j]), used[old]
                best = max(best, value)
                total += 1
                for k in range(num_candidates):
                    if match[j, k] == -np.inf or used[old] & (np.int64(1) << k):
                        continue
                    value, middle, wide = log_weight[n, old] + match[j, k], offset[n, old], variance[n, old]
                    if on_clock and length_variance[j] < np.inf:
                        shift = measured_length[j] - lengths[k]
                        own = length_variance[j] + (spread if spread * of_angle[j, k] > resolution else 0.0)
                        if wide == np.inf:
                            value -= log_range
                            middle, wide = shift, own
                        else:
                            both = wide + own
                            if (shift - middle) ** 2 > _FAR * both:
                                continue
                            value -= 0.5 * ((shift - middle) ** 2 / both + np.log(2.0 * np.pi * both))
                            middle += wide / both * (shift - middle)
                            wide *= own / both
                    if value < best - _LOW:
                        continue
                    best = max(best, value)
                    _put(new, total, value, middle, wide, told[n, old] + of_angle[j, k])
                    new_bits[total, 0], new_bits[total, 1] = spurious[n, old], used[old] | (np.int64(1) << k)
                    total += 1
            least = best - _LOW
            if total > _BEAM:
                least = max(least, np.partition(new[:total, 0], total - _BEAM)[total - _BEAM])
            h = 0
            for k in range(total):
                if new[k, 0] >= least and h < _BEAM:
                    log_weight[n, h], offset[n, h] = new[k, 0], new[k, 1]
                    variance[n, h], told[n, h] = new[k, 2], new[k, 3]
                    spurious[n, h], used[h] = new_bits[k, 0], new_bits[k, 1]
                    h += 1
        log_weight[n, :h] += log_missed
        count[n] = h


@numba.njit(cache=True, nogil=True, inline="always")
def _put(new: Any, at: Any, value: Any, offset: Any, variance: Any, told: Any) -> None:
    new[at, 0], new[at, 1], new[at, 2], new[at, 3] = value, offset, variance, told


@numba.njit(cache=True, nogil=True, error_model="numpy")
def collapse_beams(beams: Any, density: Any, told: Any, bits: Any, lost: Any) -> None:
    """Sum over the hypotheses of points, and begin anew.

    Parameters
    ----------
    beams : tuple
        Of :class:`Beams`; the hypotheses end, and each point has a single one again.
    density, told : ndarray of shape (n,)
        Changed in place: the natural logarithm of the likelihood and the information [1 / m2] are added.
    bits : ndarray of int64, shape (m,)
        Of the measured paths that the hypotheses are about.
    lost : ndarray of shape (m, n)
        Changed in place: probability that each of these is spurious.
    """
    count, log_weight, offset, variance, information, spurious = beams
    for n in range(len(count)):
        best, total, sharp = log_weight[n, : count[n]].max(), 0.0, 0.0
        lost[:, n] = 0.0
        for h in range(count[n]):
            share = np.exp(log_weight[n, h] - best)
            total += share
            sharp += share * information[n, h]
            for j in range(len(bits)):
                if spurious[n, h] & (np.int64(1) << bits[j]):
                    lost[j, n] += share
        lost[:, n] /= total
        density[n] += best + np.log(total)
        told[n] += sharp / total
        count[n] = 1
        log_weight[n, 0] = offset[n, 0] = information[n, 0] = 0.0
        variance[n, 0] = np.inf
        spurious[n, 0] = 0
