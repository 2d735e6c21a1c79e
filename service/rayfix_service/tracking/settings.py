"""Settings of the tracking."""

from dataclasses import dataclass, field
from typing import Annotated

from rayfix_service.tracking.drift import DriftModel
from rayfix_service.tracking.motion import MotionModel, Positive
from rayfix_tables.validation.limits import Limits, check_limits

Count = Annotated[int, Limits(least=1)]


@dataclass(frozen=True, kw_only=True)
class TrackingSettings:
    """Assumptions of the tracking, and bounds on its work and memory.

    Attributes
    ----------
    motion : MotionModel
    drift : DriftModel or None
        How the errors of stations hang together over time; None takes all errors for independent.
    num_particles : int
        Of each target; a target takes some 50 bytes for each, and 24 more for each station that it was heard by.
    restart_probability : float
        Prior probability that a report has nothing to do with the track before it: the tag was carried through a door
        that the model does not have, or given to someone else.
    longest_gap : float, s
        After a longer time without a report the target is a new one.
    longest_step : float, s
        Longer times are predicted in steps, so that paths may lead around corners.
    height_seconds : float, s
        The known height of a target counts once in this time: all of its reports carry the same prior.
    max_targets : int
        Targets that are kept; of more, those with the oldest reports are forgotten.
    max_age : float, s
        Targets without a report for this time, by the service's own clock, are forgotten.
    seed : int
        Of the random numbers, of which every target has its own.

    Raises
    ------
    SettingsError
        When a value is out of its range.
    """

    motion: MotionModel = field(default_factory=MotionModel)
    drift: DriftModel | None = field(default_factory=DriftModel)
    num_particles: Count = 512
    restart_probability: Annotated[float, Limits(above=0.0, below=1.0)] = 1e-4
    longest_gap: Positive = 5.0
    longest_step: Positive = 0.5
    height_seconds: Positive = 10.0
    max_targets: Count = 1000
    max_age: Positive = 60.0
    seed: Annotated[int, Limits(least=0)] = 1

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_limits(self)
