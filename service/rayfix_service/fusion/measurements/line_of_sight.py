"""What a receiver's own judgement whether a path is direct says of the paths of the table.

Some receivers tell, from the shape of the signal, how probable it is that it came straight. The shape is evidence
beside angle and time, and the judgement is meant for even odds beforehand: a probability p multiplies the odds of a
direct path by p / (1 - p), whatever the table and the other stations make them. Components of direct paths get 2 p,
those of reflected ones 2 (1 - p), so that 1/2 changes nothing, not even the evidence; where the measurement has nothing
to do with the position, neither has the judgement. (J. Pearl, Probabilistic Reasoning in Intelligent Systems, 1988,
calls it virtual evidence.)
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

from rayfix_service.fusion.measurements.report import Angle, Measurement, Range, TimeOfArrival

_JUDGED = (Angle, Range, TimeOfArrival)
"""Measurements of which a receiver may say whether their path is direct."""


class LineOfSightWeights(NamedTuple):
    """Logarithms of what the weights of direct and of reflected paths are multiplied by."""

    log_direct: float
    log_reflected: float


def line_of_sight_weights(los_probability: float, least_error: float) -> LineOfSightWeights:
    """Weigh a judgement that is wrong with a probability of ``least_error`` at least, however sure it seems."""
    probability = min(max(los_probability, least_error), 1.0 - least_error)
    return LineOfSightWeights(math.log(2.0 * probability), math.log(2.0 * (1.0 - probability)))


def los_probability(measurements: Iterable[Measurement]) -> float | None:
    """Mean of what the measurements of one path say of it, None where they say nothing.

    They are of one signal, so that its shape must not count once for each of them.
    """
    said = [m.los_probability for m in measurements if isinstance(m, _JUDGED) and m.los_probability is not None]
    return sum(said) / len(said) if said else None
