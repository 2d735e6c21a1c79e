"""How well a site explains reports: their log evidence before and after a calibration."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.fusion import Fusion
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.posterior.fixes import make_fix
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

__all__ = ["Evidence", "compare_evidence", "log_evidences"]

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
    found = log_evidences(reports, table, [table.site, site], most=_MOST)
    before, after = found.mean(axis=0) if len(found) else (np.nan, np.nan)
    return Evidence(before=float(before), after=float(after), count=len(found))


def log_evidences(
    reports: Sequence[Report], table: Table, sites: Sequence[SiteInfo], *, most: int
) -> NDArray[np.float64]:
    """Locate reports with several sites of one table.

    Parameters
    ----------
    reports : sequence of Report
    table : Table
    sites : sequence of SiteInfo
        With other biases, orientations and deviations.
    most : int
        Reports that are located; of more, some that are spread evenly.

    Returns
    -------
    ndarray of shape (n, n_sites)
        Log evidence of the reports that all sites can use.
    """
    settings = FusionSettings()
    fusion = Fusion(table, settings)
    step = max(1, -(-len(reports) // most))
    found = []
    for report in reports[::step]:
        try:
            row = [make_fix(report, fusion.product(report, site=site), table, settings).log_evidence for site in sites]
        except ReportError:
            continue
        if np.isfinite(row).all():
            found.append(row)
    return np.array(found).reshape(-1, len(sites))
