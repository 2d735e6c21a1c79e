"""Turn an observation into a factor: alternatives for what the measured path may be."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.clocks import ClockReading
from rayfix_service.fusion.heard import HeardStation
from rayfix_service.fusion.kernels import condition_on_length, to_information
from rayfix_service.fusion.likelihood import Term, product, total_variance
from rayfix_service.fusion.lookup import Direction
from rayfix_service.fusion.merging import merge_alternatives
from rayfix_service.fusion.observations import Observation
from rayfix_service.fusion.prior import Prior
from rayfix_service.fusion.settings import FusionSettings

_RELAXED = math.log(8.0)
"""Alternatives of a kind that is improbable are merged at up to this many times the divergence (its logarithm)."""

ALL_GOOD, TIME_OUTLIER, ALL_OUTLIER = 0, 1, 2
"""What an alternative takes for an outlier: nothing, the observation's times, or all of it."""


@dataclass(frozen=True, kw_only=True)
class Factor:
    """Alternatives ``exp(log_scale + eta . z - z . information . z / 2)`` over z = (x, clock offsets).

    Attributes
    ----------
    information : ndarray of shape (k, d, d)
    eta : ndarray of shape (k, d)
    log_scale : ndarray of shape (k,)
    outlier : ndarray of int8, shape (k,)
        ALL_GOOD, TIME_OUTLIER or ALL_OUTLIER; the last alternative is always ALL_OUTLIER.
    """

    information: NDArray[np.float64]
    eta: NDArray[np.float64]
    log_scale: NDArray[np.float64]
    outlier: NDArray[np.int8]

    def __len__(self) -> int:
        """Return the number of alternatives."""
        return len(self.log_scale)


def make_factor(
    observation: Observation,
    station: HeardStation,
    *,
    num_clocks: int,
    max_path_length: float,
    prior: Prior,
    settings: FusionSettings,
) -> Factor | None:
    """Alternatives of one observation, or None where no ray of the table comes.

    Parameters
    ----------
    max_path_length : float, m
        A time that is an outlier may be anything up to this, and noise.
    prior : Prior
        Not part of the factor, but of the judgement which alternatives are worth keeping.
    """
    # Noise counts, so that a measurement with very much of it does not look like an outlier.
    log_any_time = -sum(math.log(max_path_length + math.sqrt(2.0 * math.pi * v)) for v in _variances(observation))
    log_good, log_bad = math.log1p(-settings.outlier_probability), math.log(settings.outlier_probability)
    log_outlier = log_bad + log_any_time - _log_angle_range(observation)
    timed = bool(observation.lengths or observation.readings)
    parts: list[_Part] = []
    for log_spread, scale in observation.angle_spreads:
        log_evidence, mean, cov = station.towards(_widened(observation.direction, scale))
        if not len(log_evidence):
            continue
        log_evidence += log_good + log_spread
        if observation.angle_index is None or not timed:
            parts += _good_parts(log_evidence, mean, cov, observation, max_path_length)
            continue
        parts += _good_parts(log_evidence + log_good, mean.copy(), cov.copy(), observation, max_path_length)
        parts.append(_Part(TIME_OUTLIER, log_evidence + (log_bad + log_any_time), mean, cov, (), 0.0))
    if not parts:
        return None
    parts.sort(key=lambda part: part.kind)
    scores = [p.log_evidence + p.log_clocks + prior.log_gain(p.mean, p.cov) for p in parts]
    top = max(log_outlier + prior.log_volume, *(float(score.max()) for score in scores))
    floor = top + math.log(settings.component_floor)
    keeps = []
    for part, score in zip(parts, scores, strict=True):
        # The divergence of all parts together is what counts, though a part may turn out to be the right one.
        allowed = settings.max_divergence * math.exp(min(top - float(score.max()), _RELAXED))
        keep = np.flatnonzero(score > floor)
        keeps.append(merge_alternatives(keep, part.log_evidence, part.mean, part.cov, allowed))
    return _alternatives(parts, keeps, log_outlier, 3 + num_clocks)


class _Part(NamedTuple):
    """Alternatives of one kind, before the readings of clocks, and the logarithm of what those will cost at least."""

    kind: int
    log_evidence: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]
    readings: tuple[ClockReading, ...]
    log_clocks: float


def _good_parts(
    log_evidence: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    observation: Observation,
    max_path_length: float,
) -> Iterator[_Part]:
    """Alternatives for which all times are what they seem, of each combination of the Gaussians of their errors.

    The arrays may be overwritten.
    """
    combinations = list(itertools.product(_joint_lengths(observation), _joint_readings(observation.readings)))
    # Readings are not in the evidence yet; what each clock will cost, whatever it shows, is its even prior.
    log_clocks = -len({reading.clock for reading in observation.readings}) * math.log(max_path_length)
    for n, (length, (log_weight, readings)) in enumerate(combinations, start=1):
        last = n == len(combinations)
        own = (log_evidence, mean, cov) if last else (log_evidence.copy(), mean.copy(), cov.copy())
        if length is not None:
            condition_on_length(*own, length.value, length.variance)
            log_weight += length.log_weight
        own[0][:] += log_weight
        yield _Part(ALL_GOOD, *own, readings, log_clocks)


def _joint_lengths(observation: Observation) -> list[Term | None]:
    """Gaussians over the path length that all measured lengths together make."""
    if not observation.lengths:
        return [None]
    return [product(terms, observation.length_bias_variance) for terms in itertools.product(*observation.lengths)]


def _joint_readings(readings: tuple[ClockReading, ...]) -> list[tuple[float, tuple[ClockReading, ...]]]:
    """Combine the Gaussians that readings may be of, each with the logarithm of their probability."""
    combinations = itertools.product(*(reading.spreads for reading in readings))
    return [
        (
            sum(spread.log_weight for spread in spreads),
            tuple(replace(r, variance=r.variance * s.scale**2) for r, s in zip(readings, spreads, strict=True)),
        )
        for spreads in combinations
    ]


def _variances(observation: Observation) -> list[float]:
    """Variance of each time of an observation, m2, whichever Gaussian it is of."""
    lengths = [total_variance(terms) + observation.length_bias_variance for terms in observation.lengths]
    readings = [
        r.variance * sum(math.exp(spread.log_weight) * spread.scale**2 for spread in r.spreads)
        for r in observation.readings
    ]
    return lengths + readings


def _widened(measured: Direction, scale: float) -> Direction:
    return measured if scale == 1.0 else replace(measured, cov=scale**2 * measured.cov)


_NO_READINGS = (np.empty(0, np.int64), np.empty(0), np.empty(0))


def _columns(
    readings: tuple[ClockReading, ...],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Clocks, offsets and variances of readings."""
    return (
        np.array([r.clock for r in readings], np.int64),
        np.array([r.offset for r in readings]),
        np.array([r.variance for r in readings]),
    )


def _alternatives(
    parts: list[_Part],
    keeps: list[NDArray[np.int64]],
    log_outlier: float,
    dimension: int,
) -> Factor:
    """Factor of those alternatives of each part that are kept, and the outlier."""
    total = sum(len(keep) for keep in keeps) + 1
    information = np.zeros((total, dimension, dimension))
    eta, log_scale = np.zeros((total, dimension)), np.full(total, log_outlier)
    outlier = np.full(total, ALL_OUTLIER, np.int8)
    begin = 0
    for part, keep in zip(parts, keeps, strict=True):
        out = slice(begin, begin + len(keep))
        to_information(
            keep,
            part.log_evidence,
            part.mean,
            part.cov,
            *(_columns(part.readings) if part.readings else _NO_READINGS),
            information[out],
            eta[out],
            log_scale[out],
        )
        outlier[out] = part.kind
        begin = out.stop
    return Factor(information=information, eta=eta, log_scale=log_scale, outlier=outlier)


def _log_angle_range(observation: Observation) -> float:
    """Logarithm of the range over which an angle that is an outlier is spread evenly, in the units of the factor."""
    if observation.angle_index is None:
        return 0.0
    return math.log(2.0 * math.pi if observation.direction.zenith is None else 4.0 * math.pi)
