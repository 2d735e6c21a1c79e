"""Settings of the fusion."""

from dataclasses import dataclass
from typing import Annotated

from rayfix_tables.validation.limits import Limits, check_limits

Probability = Annotated[float, Limits(above=0.0, below=1.0)]


@dataclass(frozen=True, kw_only=True)
class FusionSettings:
    """Assumptions of the fusion, and bounds on its work.

    Attributes
    ----------
    outlier_probability : float
        Prior probability that a measurement has nothing to do with the position.
    spurious_paths : float
        Paths that a station that reports several is expected to report although there are none.
    unmodelled_probability : float
        Prior probability that a path whose angles and length are measured is none of the table's, though it comes from
        about where the target is: round an edge, off a rough surface, off what is not in the twin; 0 to leave that out.
    unmodelled_without_length : float
        The same of a path whose angles alone are measured, or with times against an unknown clock.
    unmodelled_spread : float, rad
        Deviation, along either angle, of the direction of such a path from that of the straight one.
    unmodelled_detour : float, m
        Mean of what such a path is longer than the straight one; its density is exponential.
    sight_error : float
        Least probability that a receiver's line-of-sight indication is wrong, whatever the indication is.
    beam_width : int
        Hypotheses that are kept from one station to the next, before similar ones are merged.
    most_alternatives : int
        Alternatives that are kept of one path of the report, the most probable ones; with clocks, fewer.
    most_considered : int
        Alternatives that are evaluated over all paths of a report, before the improbable ones are left out. Where the
        combinations of errors that are not Gaussian make more, the less probable ones are left out. A table whose
        stations have very many components allows for more: ``considered_tables`` times those of its largest.
    considered_tables : int
    most_products : int
        Products of hypotheses and alternatives that a report may take; with clocks, each counts for more, as it takes
        longer. Where there would be more, the less probable hypotheses are left out.
    max_divergence : float
        What merging two hypotheses may cost, nats.
    component_floor : float
        Components that have less than this fraction of their station's evidence are left out. Since weights are
        probabilities, it is also about the probability that is left out.
    hypothesis_floor : float
        Hypotheses whose posterior probability is below this are left out of the answer.
    ambiguous_below : float
        A best candidate less probable than this makes the fix ``ambiguous``.
    most_rivals : int
        An ambiguous fix is ``insufficient`` if its best candidates, at most so many, are together less probable than
        that.
    insufficient_above : float, m
        A best candidate whose largest standard deviation is above this makes the fix ``insufficient``.
    insufficient_share : float
        So does one that is wider than this share of the same deviation of a position anywhere in the free space.
    inconsistent_stretch : float
        By how many times the regions of an inconsistent fix are larger than its posterior says.
    most_turn_fixes : int
        Further fixes that an inconsistent report may take to find stations whose angles are turned; 0 for no search.

    Raises
    ------
    SettingsError
        When a value is out of its range.
    """

    outlier_probability: Probability = 0.01
    spurious_paths: Annotated[float, Limits(above=0.0, most=100.0)] = 0.3
    unmodelled_probability: Annotated[float, Limits(least=0.0, below=0.5)] = 0.1
    unmodelled_without_length: Annotated[float, Limits(least=0.0, below=0.5)] = 0.0
    unmodelled_spread: Annotated[float, Limits(above=0.0, most=3.2)] = 0.3
    unmodelled_detour: Annotated[float, Limits(above=0.0)] = 2.5
    sight_error: Annotated[float, Limits(above=0.0, most=0.5)] = 0.05
    beam_width: Annotated[int, Limits(least=1, most=1_000_000)] = 2048
    most_alternatives: Annotated[int, Limits(least=1)] = 8192
    most_considered: Annotated[int, Limits(least=1)] = 2**23
    considered_tables: Annotated[int, Limits(least=0)] = 64
    most_products: Annotated[int, Limits(least=1)] = 2**28
    max_divergence: Annotated[float, Limits(least=0.0)] = 5e-3
    component_floor: Probability = 1e-6
    hypothesis_floor: Probability = 1e-5
    ambiguous_below: Probability = 0.7
    most_rivals: Annotated[int, Limits(least=1)] = 3
    insufficient_above: Annotated[float, Limits(above=0.0)] = 3.0
    insufficient_share: Annotated[float, Limits(above=0.0)] = 0.7
    inconsistent_stretch: Annotated[float, Limits(least=1.0)] = 1.5
    most_turn_fixes: Annotated[int, Limits(least=0, most=1000)] = 16

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_limits(self)
