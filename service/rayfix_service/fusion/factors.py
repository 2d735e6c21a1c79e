"""Turn an observation into a factor: alternatives for what the measured path may be."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.kernels import condition_on_angle, condition_on_length, to_information
from rayfix_service.fusion.lookup import Lookup, look_up
from rayfix_service.fusion.observations import Observation
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
        A time that is an outlier may be anything up to this.
    log_volume : float
        Natural logarithm of the free space's volume [m3].
    """
    dimension = 3 + num_clocks
    log_evidence, mean, cov = _condition(look_up(part.levels, observation.direction))
    if not len(log_evidence):
        return None
    has_angle = observation.angle_index is not None
    num_times = len(observation.lengths) + len(observation.readings)
    log_good, log_bad = np.log1p(-settings.outlier_probability), np.log(settings.outlier_probability)
    log_any_time = -num_times * np.log(max_path_length)
    parts: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], int]] = []
    if has_angle and num_times:
        parts.append((log_evidence + log_good + log_bad + log_any_time, mean, cov, TIME_OUTLIER))
        log_evidence = log_evidence + 2.0 * log_good
        mean, cov = mean.copy(), cov.copy()
    else:
        log_evidence = log_evidence + log_good
    for length, variance in observation.lengths:
        condition_on_length(log_evidence, mean, cov, length, variance)
    parts.insert(0, (log_evidence, mean, cov, ALL_GOOD))
    log_outlier = log_bad + log_any_time - _log_angle_range(observation)
    top = max(log_outlier + log_volume, *(float(p[0].max()) for p in parts))
    floor = top + np.log(settings.component_floor)
    pieces = [_to_information(*p, observation, dimension, floor) for p in parts]
    return Factor(
        information=np.concatenate([*(p.information for p in pieces), np.zeros((1, dimension, dimension))]),
        eta=np.concatenate([*(p.eta for p in pieces), np.zeros((1, dimension))]),
        log_scale=np.concatenate([*(p.log_scale for p in pieces), [log_outlier]]),
        outlier=np.concatenate([*(p.outlier for p in pieces), [np.int8(ALL_OUTLIER)]]),
    )


def _condition(lookup: Lookup) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Log evidence, mean and covariance of (x, path length) of every component of the cells looked up."""
    level = lookup.level
    begins = level.cell_offsets[lookup.cells]
    ends = level.cell_offsets[lookup.cells + 1]
    places = np.concatenate([[0], np.cumsum(ends - begins)])
    total = int(places[-1])
    log_evidence, mean, cov = np.empty(total), np.empty((total, 4)), np.empty((total, 4, 4))
    mixture = level.mixture
    for n in range(len(lookup.cells)):
        a, b = int(begins[n]), int(ends[n])
        if a == b:
            continue
        out = slice(int(places[n]), int(places[n + 1]))
        condition_on_angle(
            mixture.log_weight[a:b],
            mixture.u_mean[a:b],
            mixture.u_cov[a:b],
            mixture.x_mean[a:b],
            mixture.jacobian[a:b],
            mixture.x_cov[a:b],
            lookup.rest_mean[n],
            lookup.rest_cov[n],
            lookup.log_factor[n] + level.cell_log_mass[lookup.cells[n]],
            log_evidence[out],
            mean[out],
            cov[out],
        )
    return log_evidence, mean, cov


def _to_information(
    log_evidence: NDArray[np.float64],
    mean: NDArray[np.float64],
    cov: NDArray[np.float64],
    outlier: int,
    observation: Observation,
    dimension: int,
    floor: float,
) -> Factor:
    keep = np.flatnonzero(log_evidence > floor)
    readings = observation.readings if outlier == ALL_GOOD else ()
    information = np.empty((len(keep), dimension, dimension))
    eta, log_scale = np.empty((len(keep), dimension)), np.empty(len(keep))
    to_information(
        log_evidence[keep],
        mean[keep],
        cov[keep],
        np.array([r.clock for r in readings], np.int64),
        np.array([r.offset for r in readings], np.float64),
        np.array([r.variance for r in readings], np.float64),
        dimension,
        information,
        eta,
        log_scale,
    )
    return Factor(information=information, eta=eta, log_scale=log_scale, outlier=np.full(len(keep), outlier, np.int8))


def _log_angle_range(observation: Observation) -> float:
    """Logarithm of the range over which an angle that is an outlier is spread evenly, in the units of the factor."""
    if observation.angle_index is None:
        return 0.0
    return float(np.log(2.0 * np.pi if observation.direction.zenith is None else 4.0 * np.pi))
