"""Weights of direct and of reflected paths, from a receiver's line-of-sight indication.

Some receivers indicate, from the shape of the signal, the probability that its path is direct. The shape is evidence
beside angle and time, and the indication assumes prior odds of one to one: a probability p multiplies the odds of a
direct path by p / (1 - p), whatever the table and the other stations make them. Components of direct paths get 2 p,
those of reflected ones 2 (1 - p), so that 1/2 changes nothing, not even the evidence; where the measurement is
an outlier, the indication has no effect either. (J. Pearl, Probabilistic Reasoning in Intelligent Systems, 1988, calls
it virtual evidence.)
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

from rayfix_service.fusion.measurements.report import Angle, Measurement, Range, TimeOfArrival

_JUDGED = (Angle, Range, TimeOfArrival)
"""Measurements that may carry a line-of-sight indication."""


class LineOfSightWeights(NamedTuple):
    """Logarithms of what the weights of direct and of reflected paths are multiplied by."""

    log_direct: float
    log_reflected: float


def line_of_sight_weights(los_probability: float, least_error: float) -> LineOfSightWeights:
    """Weights of an indication that is wrong with a probability of at least ``least_error``, whatever it is."""
    probability = min(max(los_probability, least_error), 1.0 - least_error)
    return LineOfSightWeights(math.log(2.0 * probability), math.log(2.0 * (1.0 - probability)))


def los_probability(measurements: Iterable[Measurement]) -> float | None:
    """Mean indication of the measurements of one path, None where there is none.

    They are of one signal, whose shape must not count once for each of them.
    """
    indicated = [m.los_probability for m in measurements if isinstance(m, _JUDGED) and m.los_probability is not None]
    return sum(indicated) / len(indicated) if indicated else None
