"""How well a site explains reports: their log evidence before and after a calibration."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rayfix_service.fusion.fusion import Fusion
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.posterior.fixes import make_fix
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

__all__ = ["Evidence", "compare_evidence"]

_MOST = 300


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Mean log evidence of a report, before and after, and of how many."""

    before: float
    after: float
    count: int


def compare_evidence(reports: Sequence[Report], table: Table, site: SiteInfo) -> Evidence:
    """Locate some of the reports with the table's site and with another one, and compare their log evidence.

    Parameters
    ----------
    reports : sequence of Report
    table : Table
    site : SiteInfo
        With other biases, orientations and deviations.
    """
    settings = FusionSettings()
    fusion = Fusion(table, settings)
    step = max(1, -(-len(reports) // _MOST))
    found = []
    for report in reports[::step]:
        try:
            pair = [
                make_fix(report, fusion.product(report, site=each), table, settings).log_evidence
                for each in (table.site, site)
            ]
        except ReportError:
            continue
        if np.isfinite(pair).all():
            found.append(pair)
    before, after = np.mean(found, axis=0) if found else (np.nan, np.nan)
    return Evidence(before=float(before), after=float(after), count=len(found))
