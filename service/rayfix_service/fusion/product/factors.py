"""Turn an observation into a factor: alternatives for the path that was measured."""

import itertools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.clocks import ClockReading
from rayfix_service.fusion.measurements.directions import Direction
from rayfix_service.fusion.measurements.likelihood import Term, product, total_variance
from rayfix_service.fusion.measurements.line_of_sight import line_of_sight_weights
from rayfix_service.fusion.measurements.observations import Observation
from rayfix_service.fusion.product.beam_kernels import product_costs
from rayfix_service.fusion.product.factor_kernels import (
    ALL_GOOD,
    ALL_OUTLIER,
    PART,
    READING,
    TIME_OUTLIER,
    AlternativeLimits,
    make_alternatives,
)
from rayfix_service.fusion.product.prior import Prior
from rayfix_service.fusion.product.station_mixture import StationMixtures, join
from rayfix_service.fusion.product.unmodelled import unmodelled_columns, unmodelled_path
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.fusion.stopping import NEVER, Stop

_ANY_LENGTH = Term(0.0, 0.0, math.inf)
"""Likelihood of a path length that was not measured."""


@dataclass(frozen=True, kw_only=True)
class Factor:
    """Alternatives for the likelihood of the state z = (x, clock offsets) given one path of the report.

    Attributes
    ----------
    columns : ndarray of shape (rows, k)
        One alternative each, as :mod:`rayfix_service.fusion.product.information_form` has them.
    outlier : ndarray of int8, shape (k,)
        ALL_GOOD, TIME_OUTLIER or ALL_OUTLIER; the last alternative is always ALL_OUTLIER.
    considered : int
        Alternatives that were evaluated for it.
    omitted : bool
        Whether it has fewer alternatives than it would have without a bound on them.
    dropped : int
        Alternatives that were left out because rounding made their covariances singular.
    """

    columns: NDArray[np.float64]
    outlier: NDArray[np.int8]
    considered: int = 0
    omitted: bool = False
    dropped: int = 0

    def __len__(self) -> int:
        """Return the number of alternatives."""
        return len(self.outlier)


def make_factor(
    observation: Observation,
    station: StationMixtures,
    *,
    num_clocks: int,
    max_path_length: float,
    prior: Prior,
    settings: FusionSettings,
    most_considered: int | None = None,
    stop: Stop = NEVER,
) -> Factor | None:
    """Alternatives of one observation, or None where no ray of the table comes.

    Parameters
    ----------
    max_path_length : float, m
        A time that is an outlier may be anything up to this, and noise.
    prior : Prior
        Not part of the factor, but of the judgement which alternatives are worth keeping.
    most_considered : int, optional
        Alternatives to evaluate, though at least those of one combination of errors; all by default.
    stop : Stop
        Ends it early.

    Raises
    ------
    FixStoppedError
        When it was.
    """
    indicated = observation.los_probability
    weights = None if indicated is None else line_of_sight_weights(indicated, settings.sight_error)
    mixtures, bounds = [], [0]
    for spread in observation.angle_spreads:
        mixtures.append(station.towards(_widened(observation.direction, spread.scale), weights))
        bounds.append(bounds[-1] + len(mixtures[-1]))
    if bounds[-1] == 0:
        return None
    kinds, readings, log_outlier = kinds_of(observation, settings.outlier_probability, max_path_length)
    lengths = [kind[1:4] for kind in kinds if kind.outlier == ALL_GOOD]
    unmodelled = unmodelled_path(
        observation, lengths, station.position, any_time(observation, max_path_length), settings
    )
    log_good = math.log1p(-settings.outlier_probability - (unmodelled.probability if unmodelled else 0.0))
    parts = [
        (kind.outlier, bounds[n], bounds[n + 1], log_good + spread.log_weight + kind.log_weight, *kind[2:])
        for kind in kinds
        for n, spread in enumerate(observation.angle_spreads)
    ]
    considered = bounds[-1] * len(kinds)
    taken = parts
    if most_considered is not None and considered > most_considered:
        taken, considered = _within(parts, considered, most_considered)
    most = settings.most_alternatives
    if num_clocks:
        most = int(most / math.sqrt(product_costs(3 + num_clocks)[0]))
    columns, outlier, omitted, dropped = make_alternatives(
        tuple(join(mixtures)),
        np.array(taken, PART),
        np.array(readings, READING),
        num_clocks,
        tuple(prior),
        tuple(
            AlternativeLimits(
                log_outlier=log_outlier,
                log_floor=math.log(settings.component_floor),
                max_divergence=float(settings.max_divergence),
                most=most,
            )
        ),
        stop.cell,
    )
    stop.check()
    if unmodelled is not None:
        added = unmodelled_columns(tuple(unmodelled), max_path_length, 3 + num_clocks)
        columns = np.concatenate([columns[:, :-1], added, columns[:, -1:]], axis=1)
        outlier = np.concatenate([outlier[:-1], np.full(added.shape[1] + 1, ALL_OUTLIER, np.int8)])
    return Factor(
        columns=columns,
        outlier=outlier,
        considered=max(bounds[-1], considered),
        omitted=omitted > 0 or len(taken) < len(parts),
        dropped=dropped,
    )


_Part = tuple[int, int, int, float, float, float, float, int, int]
"""What becomes a record of :data:`PART`."""


def _within(parts: list[_Part], size: int, most: int) -> tuple[list[_Part], int]:
    """Leave out the less probable combinations of errors until there are at most so many alternatives, or one is left.

    Alternatives whose times are outliers stay: they are what else a time may be that the combinations left do not fit.
    Also gives how many alternatives there are then; ``size`` is how many there were.
    """
    good = sorted((n for n, part in enumerate(parts) if part[0] == ALL_GOOD), key=lambda n: parts[n][3])
    out = set[int]()
    for n in good[:-1]:
        if size <= most:
            break
        out.add(n)
        size -= parts[n][2] - parts[n][1]
    return [part for n, part in enumerate(parts) if n not in out], size


class Kind(NamedTuple):
    """Alternatives of one kind, as :data:`PART` has them, for Gaussians of any spread."""

    outlier: int
    log_weight: float
    length: float
    length_variance: float
    log_clocks: float = 0.0
    first_reading: int = 0
    last_reading: int = 0


def kinds_of(
    observation: Observation, outlier_probability: float, max_path_length: float
) -> tuple[list[Kind], list[tuple[int, float, float]], float]:
    """Alternatives of an observation but for the one that all of it is an outlier.

    Also gives the readings of clocks that these take in, as :data:`READING` has them, and the log density of the
    outlier.
    """
    log_any_time = any_time(observation, max_path_length)
    log_good, log_bad = math.log1p(-outlier_probability), math.log(outlier_probability)
    may_be_late = observation.angle_index is not None and bool(observation.lengths or observation.readings)
    kinds, readings = _good_kinds(observation, log_good if may_be_late else 0.0, max_path_length)
    if may_be_late:
        kinds.append(Kind(TIME_OUTLIER, log_bad + log_any_time, *_ANY_LENGTH[1:]))
    return kinds, readings, log_bad + log_any_time - _log_angle_range(observation)


def any_time(observation: Observation, max_path_length: float) -> float:
    """Log density of an observation's times where they may be any."""
    # Noise counts, so that a measurement with very much of it does not look like an outlier.
    log_density = 0.0
    for variance in _time_variances(observation):
        log_density -= math.log(max_path_length + math.sqrt(2.0 * math.pi * variance))
    return log_density


def _good_kinds(
    observation: Observation, log_times_good: float, max_path_length: float
) -> tuple[list[Kind], list[tuple[int, float, float]]]:
    """Alternatives for which all times are what they seem, of each combination of the Gaussians of their errors.

    Also gives the readings of clocks that these take in, as :data:`READING` has them.
    """
    # Readings are not in the evidence yet; each clock's uniform prior lowers it, whatever the clock shows.
    log_clocks = -len({reading.clock for reading in observation.readings}) * math.log(max_path_length)
    kinds = []
    readings: list[tuple[int, float, float]] = []
    for log_readings, joint in _joint_readings(observation.readings):
        first, last = len(readings), len(readings) + len(joint)
        readings += joint
        for length in _joint_lengths(observation):
            log_weight = log_times_good + log_readings + length.log_weight
            kinds.append(Kind(ALL_GOOD, log_weight, length.value, length.variance, log_clocks, first, last))
    return kinds, readings


def _joint_lengths(observation: Observation) -> list[Term]:
    """Gaussians over the path length that all measured lengths together make."""
    if not observation.lengths:
        return [_ANY_LENGTH]
    return [product(terms, observation.length_bias_variance) for terms in itertools.product(*observation.lengths)]


def _joint_readings(readings: tuple[ClockReading, ...]) -> list[tuple[float, list[tuple[int, float, float]]]]:
    """Combine the Gaussians that readings may be of, each time with the logarithm of the probability."""
    if not readings:
        return [(0.0, [])]
    return [
        (
            sum([spread.log_weight for spread in spreads]),
            [(r.clock, r.offset, r.variance * s.scale**2) for r, s in zip(readings, spreads, strict=True)],
        )
        for spreads in itertools.product(*(reading.spreads for reading in readings))
    ]


def _time_variances(observation: Observation) -> list[float]:
    """Variance of each time of an observation, m2, whichever Gaussian it is of."""
    lengths = [total_variance(terms) + observation.length_bias_variance for terms in observation.lengths]
    readings = [
        r.variance * sum([math.exp(spread.log_weight) * spread.scale**2 for spread in r.spreads])
        for r in observation.readings
    ]
    return lengths + readings


def _widened(measured: Direction, scale: float) -> Direction:
    return measured if scale == 1.0 else replace(measured, cov=scale**2 * measured.cov)


def _log_angle_range(observation: Observation) -> float:
    """Logarithm of the range over which an angle that is an outlier is uniform, in the units of the factor."""
    if observation.angle_index is None:
        return 0.0
    return math.log(2.0 * math.pi if observation.direction.zenith is None else 4.0 * math.pi)
