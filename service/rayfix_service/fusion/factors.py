"""Turn an observation into a factor: alternatives for what the measured path may be."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.kernels import condition_on_angle, condition_on_length, to_information
from rayfix_service.fusion.lookup import Lookup, look_up
from rayfix_service.fusion.observations import ClockReading, Observation
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.table import StationPart

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
    part: StationPart,
    *,
    num_clocks: int,
    max_path_length: float,
    log_volume: float,
    settings: FusionSettings,
) -> Factor | None:
    """Alternatives of one observation, or None where no ray of the table comes.

    Parameters
    ----------
    max_path_length : float, m
        A time that is an outlier may be anything up to this, and noise.
    log_volume : float
        Natural logarithm of the free space's volume [m3].
    """
    log_evidence, mean, cov = _condition(look_up(part.levels, observation.direction))
    if not len(log_evidence):
        return None
    readings = observation.readings
    variances = [*(variance for _, variance in observation.lengths), *(r.variance for r in readings)]
    # Noise counts, so that a measurement with very much of it does not look like an outlier.
    log_any_time = -sum(math.log(max_path_length + math.sqrt(2.0 * math.pi * v)) for v in variances)
    log_good, log_bad = math.log1p(-settings.outlier_probability), math.log(settings.outlier_probability)
    log_outlier = log_bad + log_any_time - _log_angle_range(observation)
    # Readings are not in the evidence yet; what each clock will cost, whatever it shows, is its even prior.
    log_clocks = -len({reading.clock for reading in readings}) * math.log(max_path_length)
    parts = []
    if observation.angle_index is not None and variances:
        parts.append(_Part(TIME_OUTLIER, log_evidence + (log_good + log_bad + log_any_time), mean, cov, 0.0))
        log_evidence, mean, cov = log_evidence + 2.0 * log_good, mean.copy(), cov.copy()
    else:
        log_evidence += log_good
    for length, variance in observation.lengths:
        condition_on_length(log_evidence, mean, cov, length, variance)
    parts.insert(0, _Part(ALL_GOOD, log_evidence, mean, cov, log_clocks))
    top = max(log_outlier + log_volume, *(float(part.log_evidence.max()) + part.log_clocks for part in parts))
    floor = top + math.log(settings.component_floor)
    keeps = [np.flatnonzero(part.log_evidence + part.log_clocks > floor) for part in parts]
    return _alternatives(parts, keeps, readings, log_outlier, 3 + num_clocks)


class _Part(NamedTuple):
    """Alternatives of one kind, before the readings of clocks, and the logarithm of what those will cost at least."""

    kind: int
    log_evidence: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]
    log_clocks: float


def _alternatives(
    parts: list[_Part],
    keeps: list[NDArray[np.int64]],
    readings: tuple[ClockReading, ...],
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
        taken = readings if part.kind == ALL_GOOD else ()
        out = slice(begin, begin + len(keep))
        to_information(
            keep,
            part.log_evidence,
            part.mean,
            part.cov,
            np.array([r.clock for r in taken], np.int64),
            np.array([r.offset for r in taken], np.float64),
            np.array([r.variance for r in taken], np.float64),
            information[out],
            eta[out],
            log_scale[out],
        )
        outlier[out] = part.kind
        begin = out.stop
    return Factor(information=information, eta=eta, log_scale=log_scale, outlier=outlier)


def _condition(lookup: Lookup) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Log evidence, mean and covariance of (x, path length) of every component of the cells looked up."""
    level = lookup.level
    begins, ends = level.cell_offsets[lookup.cells], level.cell_offsets[lookup.cells + 1]
    total = int((ends - begins).sum())
    log_evidence, mean, cov = np.empty(total), np.empty((total, 4)), np.empty((total, 4, 4))
    mixture = level.mixture
    condition_on_angle(
        mixture.log_weight,
        mixture.u_mean,
        mixture.u_cov,
        mixture.x_mean,
        mixture.jacobian,
        mixture.x_cov,
        begins,
        ends,
        lookup.rest_mean,
        lookup.rest_cov,
        lookup.log_factor + level.cell_log_mass[lookup.cells],
        log_evidence,
        mean,
        cov,
    )
    return log_evidence, mean, cov


def _log_angle_range(observation: Observation) -> float:
    """Logarithm of the range over which an angle that is an outlier is spread evenly, in the units of the factor."""
    if observation.angle_index is None:
        return 0.0
    return math.log(2.0 * math.pi if observation.direction.zenith is None else 4.0 * math.pi)
