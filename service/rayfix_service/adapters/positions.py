"""The single position of a fix or of its track, for output formats that cannot express several candidates."""

from rayfix_service.fusion.posterior.credible import CredibleRegions
from rayfix_service.fusion.posterior.fix import Candidate, Fix
from rayfix_service.tracking.track import TrackedPosition
from rayfix_tables.errors import ReportError

_MOST_REASONS = 10


def best_candidate(fix: Fix, track: TrackedPosition | None = None) -> tuple[Candidate, CredibleRegions]:
    """Return the most probable candidate and the regions around it: the track's where there is one.

    Raises
    ------
    ReportError
        When there is none.
    """
    if track is not None:
        found = track.estimate
        place = Candidate(probability=found.probability, position=found.position, covariance=found.covariance)
        return place, track.regions
    if fix.candidates and fix.regions is not None:
        return fix.candidates[0], fix.regions
    unused = [(n, outcome.reason) for n, outcome in enumerate(fix.outcomes) if not outcome.used]
    reasons = "; ".join(f"measurements[{n}]: {reason}" for n, reason in unused[:_MOST_REASONS])
    if len(unused) > _MOST_REASONS:
        reasons += f"; and {len(unused) - _MOST_REASONS} more"
    raise ReportError(
        f"the report gives no position (status '{fix.status}'), and the output format cannot express that; "
        f"ask for the native one to see more{reasons and ': '}{reasons}"
    )
