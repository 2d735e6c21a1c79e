"""The likelihood of positions given sets of measured paths, from the path map.

A station reports each of the paths k to x with a probability p_k, and spurious ones besides. Measured path j is of one
of them or spurious, and no two are of one path, which is what keeps a path from being counted twice. With the
assignments a of measured paths to different paths, and the offset b of the UE's clock,

    p(Y | x) = int db / W sum_a prod_{j spurious} kappa_j prod_{j of k} p_k f_j(y_j; k, x, b) prod_{k missed} (1 - p_k)

Both probabilities enter with the exponent ``_TOGETHER``. Poisson sets are the limit of small p_k, where the product of
all (1 - p_k) is exp(-Lambda). A station may report only its strongest paths: where m measured ones are not spurious,
the m strongest to x are those that may count as missed. For each point the sum is built up by a beam: measured path
after measured path, each hypothesis branches into "spurious" and the paths that are still free; its offset is a
Gaussian, so that the integral over b is in closed form. Hypotheses of the same paths and offset are one; the best ones
are kept.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.quadrature.detection import detected_at
from rayfix_service.fusion.quadrature.factor import _angle_of

MOST_MEASURED = 62
"""Measured paths of a report: each is a bit of a hypothesis."""

_BEAM, _COARSE_BEAM = 24, 4
"""Hypotheses of a point that are kept, and of one that stands for a large block, which only tells where to look."""

_MOST_CANDIDATES = 62
"""Paths to a point that are taken into account, those most probable to be reported; each is a bit."""

_FAINT = 1e-3
"""Paths that are less probably reported are never what was measured."""

_FAR = 40.0
"""Squared deviation, in variances, from which on a path has nothing to do with the measured one."""

_LOW = 8.0
"""Hypotheses that are less probable than the best one by more, nats, are left out."""

_HOPELESS = 1.0
"""A measured path is not of one whose density is below that of a spurious one by more, nats."""

_TOGETHER = 0.5
"""Exponent of the probabilities to be reported: what hides one path of a station often hides others, so that their
evidence is not independent."""

_SAME = 0.1
"""Squared difference of two offsets, in variances, up to which hypotheses are joined."""

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
    points: Any,
    blocks: Any,
    spread: Any,
    resolution: Any,
    together: Any,
    paths: Any,
    detection: Any,
    geometry: Any,
    measured: Any,
    beams: Any,
) -> None:
    """Take the measured paths of one station into the hypotheses of points.

    Parameters
    ----------
    points : ndarray of shape (n, 3), m
    blocks : ndarray of int64, shape (n,)
        Block of each point. Points of one block that follow each other share the search for paths that may match.
    spread, resolution : float
        As in :func:`rayfix_service.fusion.quadrature.factor.evaluate`.
    together : float
        Measured paths that tell of the same direction. The mean over a block of a product of so many densities is not
        the product of their means, which would be lower by tens of nats away from the middle: each is blurred so many
        times as wide, and normalised by its root.
    paths, detection, geometry : tuple
        Of :class:`.blocks.BlockPaths`, whose weights are the probabilities to be reported; of
        :class:`.detection.Detection`; images and mirrors.
    measured : tuple
        Of :class:`MeasuredSet`.
    beams : tuple
        Of :class:`Beams`; changed in place.
    """
    offsets, sequence, weight, excess, _ = paths
    audible, corners, origin, size = detection
    detailed, passes = len(corners) > 0, len(excess) > 0
    images, mirrors = geometry
    turn, _, zenith, cov, measured_length, length_variance, log_spurious, bit, on_clock, log_range = measured
    count, log_weight, offset, variance, told, spurious = beams
    num_measured = len(zenith)
    hopeless, sines, cosines = np.empty(num_measured), np.sin(zenith), np.cos(zenith)
    log_sharp, most_gained = np.empty(num_measured), np.empty(num_measured)
    root, wider = 1.0 / together, together * spread
    for j in range(num_measured):
        log_sharp[j] = np.log(cov[j, 0] * cov[j, 2] - cov[j, 1] ** 2 if np.isfinite(cov[j, 2]) else cov[j, 0])
        # What the length adds at best is not in a match yet where there is a clock.
        most_gained[j] = 0.0
        if on_clock and length_variance[j] < np.inf:
            most_gained[j] = max(-0.5 * np.log(2.0 * np.pi * length_variance[j]), -log_range)
        hopeless[j] = log_spurious[j] - _HOPELESS - most_gained[j]
    width = _BEAM if detailed else _COARSE_BEAM
    near, fits = np.empty(_MOST_CANDIDATES, np.int64), np.empty((_MOST_CANDIDATES, num_measured), np.bool_)
    matches, match_path = np.zeros(num_measured, np.int64), np.empty((num_measured, _MOST_CANDIDATES), np.int64)
    match, of_angle = np.empty((num_measured, _MOST_CANDIDATES)), np.empty((num_measured, _MOST_CANDIDATES))
    lengths, log_not = np.empty(_MOST_CANDIDATES), np.empty(num_measured)
    at_rank = np.empty(num_measured, np.int64)
    new = np.empty((_BEAM * (_MOST_CANDIDATES + 1), 4))
    new_bits, used = np.empty((len(new), 2), np.int64), np.zeros(_BEAM, np.int64)
    best = np.empty(_BEAM)
    num_near, u, v, w = 0, 0.0, 0.0, 0.0
    for n in range(len(points)):
        begin, end = offsets[blocks[n]], offsets[blocks[n] + 1]
        x, y, z = points[n]
        if detailed:
            u, v, w = (x - origin[0]) / size, (y - origin[1]) / size, (z - origin[2]) / size
            middle, radius = (np.floor(u), np.floor(v), np.floor(w)), 0.9 * size
            u, v, w = u - middle[0], v - middle[1], w - middle[2]
            if n == 0 or blocks[n] != blocks[n - 1]:
                at = (
                    origin[0] + size * (middle[0] + 0.5),
                    origin[1] + size * (middle[1] + 0.5),
                    origin[2] + size * (middle[2] + 0.5),
                )
                num_near = _search(at, radius, wider, begin, end, paths, geometry, measured, near, fits)
        else:
            num_near = _search((x, y, z), 0.0, wider, begin, end, paths, geometry, measured, near, fits)
        log_missed = 0.0
        at_rank[:] = -1
        for j in range(min(num_measured, end - begin)):
            p = detected_at(audible[begin + j], corners[begin + j], u, v, w) if detailed else float(weight[begin + j])
            log_not[j] = _TOGETHER * np.log1p(-min(p, 0.999))
            log_missed += log_not[j]
        matches[:] = 0
        for k in range(num_near):
            path = near[k]
            p = min(detected_at(audible[path], corners[path], u, v, w) if detailed else float(weight[path]), 0.999)
            log_odds = _TOGETHER * np.log(max(p, 1e-300))
            if path - begin < num_measured:
                log_odds -= log_not[path - begin]
                at_rank[path - begin] = k
            s = sequence[path]
            square, length, a, b, c = _arrival(x, y, z, s, spread, images, mirrors)
            lengths[k] = length + (excess[path] if passes else 0.0)
            for j in range(num_measured):
                if not fits[k, j]:
                    continue
                with_angle, with_zenith = np.isfinite(cov[j, 0]), np.isfinite(cov[j, 2])
                information = 1.0 / length_variance[j]
                if with_angle:
                    least = min(cov[j, 0], cov[j, 2]) if with_zenith else cov[j, 0]
                    information += 1.0 / (least * square)
                blur = wider if spread * information > resolution else 0.0
                log_density = log_odds
                if not on_clock and length_variance[j] < np.inf:
                    wide = length_variance[j] + blur
                    apart = lengths[k] - measured_length[j]
                    log_density -= 0.5 * apart * apart / wide + _log_root(length_variance[j], wide, root)
                if with_angle:
                    along = turn[j, 0, 0] * a + turn[j, 0, 1] * b + turn[j, 0, 2] * c
                    aside = turn[j, 1, 0] * a + turn[j, 1, 1] * b + turn[j, 1, 2] * c
                    horizontal = max(along * along + aside * aside, 1e-9 * square)
                    across = np.sqrt(horizontal)
                    azimuth_error = _angle_of(along, aside, across)
                    aa = cov[j, 0] + blur / horizontal
                    if with_zenith:
                        up = turn[j, 2, 0] * a + turn[j, 2, 1] * b + turn[j, 2, 2] * c
                        zenith_error = _angle_of(
                            up * cosines[j] + across * sines[j], across * cosines[j] - up * sines[j], length
                        )
                        az, zz = cov[j, 1], cov[j, 2] + blur / square
                        determinant = aa * zz - az * az
                        distance = (
                            zz * azimuth_error**2 - 2.0 * az * azimuth_error * zenith_error + aa * zenith_error**2
                        ) / determinant
                        log_area = log_sharp[j] + (root * (np.log(determinant) - log_sharp[j]) if blur > 0.0 else 0.0)
                        log_density -= 0.5 * (distance + log_area) + np.log(2.0 * np.pi * sines[j])
                    else:
                        log_density -= 0.5 * azimuth_error**2 / aa + _log_root(cov[j, 0], aa, root)
                if log_density > hopeless[j]:
                    m = matches[j]
                    match[j, m], match_path[j, m], of_angle[j, m] = log_density, k, information
                    matches[j] += 1
        h = count[n]
        used[:h] = 0
        for j in range(num_measured):
            total, least = 0, -np.inf
            timed = on_clock and length_variance[j] < np.inf
            best[:width] = -np.inf
            for old in range(h):
                value = log_weight[n, old] + log_spurious[j]
                if value > least:
                    least = _put(new, total, value, offset[n, old], variance[n, old], told[n, old], best, width)
                    new_bits[total, 0], new_bits[total, 1] = spurious[n, old] | (np.int64(1) << bit[j]), used[old]
                    total += 1
                last, log_norm = np.inf, 0.0
                for m in range(matches[j]):
                    k = match_path[j, m]
                    if used[old] & (np.int64(1) << k):
                        continue
                    value, centre, wide = log_weight[n, old] + match[j, m], offset[n, old], variance[n, old]
                    if timed:
                        if value + most_gained[j] <= least:
                            continue
                        shift = measured_length[j] - lengths[k]
                        own = length_variance[j] + (wider if spread * of_angle[j, m] > resolution else 0.0)
                        if wide == np.inf:
                            value -= log_range
                            centre, wide = shift, own
                        else:
                            both = wide + own
                            if both != last:
                                last, log_norm = both, 0.5 * np.log(2.0 * np.pi * both)
                                if own > length_variance[j]:
                                    log_norm -= 0.5 * (1.0 - root) * np.log(own / length_variance[j])
                            value -= 0.5 * (shift - centre) ** 2 / both + log_norm
                            centre += wide / both * (shift - centre)
                            wide *= own / both
                    if value > least:
                        least = _put(new, total, value, centre, wide, told[n, old] + of_angle[j, m], best, width)
                        new_bits[total, 0], new_bits[total, 1] = spurious[n, old], used[old] | (np.int64(1) << k)
                        total += 1
            h = 0
            for k in range(total):
                if new[k, 0] <= least:
                    continue
                same = 0  # measured paths that were exchanged: the same paths are taken, and the same offset found
                while same < h and (
                    used[same] != new_bits[k, 1]
                    or spurious[n, same] != new_bits[k, 0]
                    or not _alike(offset[n, same], variance[n, same], new[k, 1], new[k, 2])
                ):
                    same += 1
                if same < h:
                    _join(
                        same, new[k, 0], new[k, 1], new[k, 2], new[k, 3], log_weight[n], offset[n], variance[n], told[n]
                    )
                elif h < width:
                    log_weight[n, h], offset[n, h] = new[k, 0], new[k, 1]
                    variance[n, h], told[n, h] = new[k, 2], new[k, 3]
                    spurious[n, h], used[h] = new_bits[k, 0], new_bits[k, 1]
                    h += 1
        log_weight[n, :h] += log_missed
        for k in range(h):
            # Spurious paths take the places of the weakest ones, which are not missed then.
            expected = num_measured
            for j in range(num_measured):
                if spurious[n, k] & (np.int64(1) << bit[j]):
                    expected -= 1
            for rank in range(expected, min(num_measured, end - begin)):
                if at_rank[rank] < 0 or not used[k] & (np.int64(1) << at_rank[rank]):
                    log_weight[n, k] -= log_not[rank]
        count[n] = _merged(h, log_weight[n], offset[n], variance[n], told[n], spurious[n])


@numba.njit(cache=True, nogil=True, inline="always")
def _log_root(sharp: Any, wide: Any, root: Any) -> Any:
    """Logarithm of the norm of a Gaussian of the variance ``sharp`` that is widened to ``wide``, by a root of that."""
    found = 0.5 * np.log(2.0 * np.pi * sharp)
    return found + (0.5 * root * np.log(wide / sharp) if wide > sharp else 0.0)


@numba.njit(cache=True, nogil=True, inline="always")
def _arrival(x: Any, y: Any, z: Any, s: Any, spread: Any, images: Any, mirrors: Any) -> Any:
    """Squared length and length of a path to a point, and its direction at the station times the length."""
    x, y, z = x - images[s, 0], y - images[s, 1], z - images[s, 2]
    square = max(x * x + y * y + z * z, spread, 1e-6)
    return (
        square,
        np.sqrt(square),
        mirrors[s, 0, 0] * x + mirrors[s, 1, 0] * y + mirrors[s, 2, 0] * z,
        mirrors[s, 0, 1] * x + mirrors[s, 1, 1] * y + mirrors[s, 2, 1] * z,
        mirrors[s, 0, 2] * x + mirrors[s, 1, 2] * y + mirrors[s, 2, 2] * z,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _search(
    at: Any,
    radius: Any,
    spread: Any,
    begin: Any,
    end: Any,
    paths: Any,
    geometry: Any,
    measured: Any,
    near: Any,
    fits: Any,
) -> Any:
    """Find the paths that measured ones may be of, within a radius of a place; return how many there are."""
    _, sequence, weight, excess, _ = paths
    images, mirrors = geometry
    _, toward, _, cov, measured_length, length_variance, _, _, on_clock, _ = measured
    found = 0
    for path in range(begin, end):
        if found == len(near) or weight[path] < _FAINT:
            break
        s = sequence[path]
        square, length, a, b, c = _arrival(at[0], at[1], at[2], s, spread, images, mirrors)
        some = False
        for j in range(len(cov)):
            fit = True
            if not np.isnan(toward[j, 0]):
                # Twice the area between the directions, over the length, is the chord.
                chord_square = 2.0 * (length - (a * toward[j, 0] + b * toward[j, 1] + c * toward[j, 2])) * length
                limit = _FAR * (max(cov[j, 0], cov[j, 2]) * square + spread)
                fit = chord_square <= limit or np.sqrt(chord_square) <= np.sqrt(limit) + radius
            if fit and not on_clock and length_variance[j] < np.inf:
                apart = abs(length + (excess[path] if len(excess) else 0.0) - measured_length[j])
                fit = apart <= np.sqrt(_FAR * (length_variance[j] + spread)) + radius
            fits[found, j] = fit
            some = some or fit
        if some:
            near[found] = path
            found += 1
    return found


@numba.njit(cache=True, nogil=True)
def _merged(count: Any, log_weight: Any, offset: Any, variance: Any, told: Any, spurious: Any) -> Any:
    """Join hypotheses whose offsets hardly differ, whatever paths they take; return how many are left."""
    kept = 0
    for h in range(count):
        k = 0
        while k < kept and (spurious[k] != spurious[h] or not _alike(offset[k], variance[k], offset[h], variance[h])):
            k += 1
        if k < kept:
            _join(k, log_weight[h], offset[h], variance[h], told[h], log_weight, offset, variance, told)
        else:
            log_weight[kept], offset[kept], variance[kept] = log_weight[h], offset[h], variance[h]
            told[kept], spurious[kept] = told[h], spurious[h]
            kept += 1
    return kept


@numba.njit(cache=True, nogil=True, inline="always")
def _alike(offset: Any, variance: Any, other: Any, other_variance: Any) -> Any:
    """Whether two offsets hardly differ, or both are unknown."""
    if variance == np.inf or other_variance == np.inf:
        return variance == other_variance
    limit = _SAME * min(variance, other_variance)
    return (offset - other) ** 2 <= limit and abs(variance - other_variance) <= limit


@numba.njit(cache=True, nogil=True)
def _join(
    at: Any,
    value: Any,
    other: Any,
    other_variance: Any,
    other_told: Any,
    log_weight: Any,
    offset: Any,
    variance: Any,
    told: Any,
) -> None:
    """Add a hypothesis to another one, by their moments."""
    ratio = np.exp(-abs(log_weight[at] - value))
    own = (1.0 if value >= log_weight[at] else ratio) / (1.0 + ratio)
    log_weight[at] = max(log_weight[at], value) + np.log1p(ratio)
    told[at] += own * (other_told - told[at])
    if variance[at] < np.inf:
        apart = other - offset[at]
        variance[at] += own * (other_variance - variance[at]) + own * (1.0 - own) * apart * apart
        offset[at] += own * apart


@numba.njit(cache=True, nogil=True, inline="always")
def _put(new: Any, at: Any, value: Any, offset: Any, variance: Any, told: Any, best: Any, width: Any) -> Any:
    """Write a hypothesis, sort its weight among the best ones, and return the least that one is to be kept for."""
    new[at, 0], new[at, 1], new[at, 2], new[at, 3] = value, offset, variance, told
    if value > best[width - 1]:
        n = width - 1
        while n > 0 and best[n - 1] < value:
            best[n] = best[n - 1]
            n -= 1
        best[n] = value
    return max(best[0] - _LOW, best[width - 1] - 1e-12)


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
