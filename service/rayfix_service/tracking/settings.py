"""Settings of the tracking."""

from dataclasses import dataclass, field

from rayfix_service.tracking.motion import MotionModel


@dataclass(frozen=True, kw_only=True)
class TrackingSettings:
    """What the tracking assumes, how hard it tries, and how much it keeps.

    Attributes
    ----------
    motion : MotionModel
    num_particles : int
        Of each target; a target takes some 50 bytes for each.
    restart_probability : float
        Prior probability that a report has nothing to do with the track before it: the tag was carried through a door
        that the model does not have, or given to someone else.
    longest_gap : float, s
        After a longer time without a report the target is a new one.
    longest_step : float, s
        Longer times are gone through in steps, so that ways may lead around corners.
    height_seconds : float, s
        What reports tell beforehand of the target's height counts once in this time: they all tell the same.
    max_targets : int
        Targets that are kept; of more, those not heard of for longest are forgotten.
    max_age : float, s
        Targets not heard of for this time, of the service's own clock, are forgotten.
    seed : int
        Of the random numbers, of which every target has its own.
    """

    motion: MotionModel = field(default_factory=MotionModel)
    num_particles: int = 512
    restart_probability: float = 1e-4
    longest_gap: float = 5.0
    longest_step: float = 0.5
    height_seconds: float = 10.0
    max_targets: int = 1000
    max_age: float = 60.0
    seed: int = 1
