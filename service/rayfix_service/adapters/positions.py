"""What formats that know one position alone take from a fix."""

from rayfix_service.fusion.report import Candidate, Fix
from rayfix_tables.errors import ReportError


def best_candidate(fix: Fix) -> Candidate:
    """Return the most probable candidate.

    Raises
    ------
    ReportError
        When the fix has none.
    """
    if fix.candidates:
        return fix.candidates[0]
    reasons = "; ".join(
        f"measurements[{n}]: {outcome.reason}" for n, outcome in enumerate(fix.outcomes) if not outcome.used
    )
    raise ReportError(
        f"the report gives no position (status '{fix.status}'), and the output format cannot say so; "
        f"ask for the native one to see more{reasons and ': '}{reasons}"
    )
