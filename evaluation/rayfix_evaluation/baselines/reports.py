"""Reports in the form of the baselines."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.paper.reports import PaperReport, sort_for_paper
from rayfix_service.fusion.measurements.report import Report
from rayfix_tables.site import SiteInfo


def sort_for_rivals(report: Report, site: SiteInfo) -> PaperReport:
    """Sort a report by station, with or without a height.

    Raises
    ------
    ReportError
        As in :func:`rayfix_evaluation.paper.reports.sort_for_paper`.
    """
    return sort_for_paper(replace(report, height=None), site)


def station_positions(site: SiteInfo) -> dict[str, NDArray[np.float64]]:
    """Position of each station, shape (3,), m, by its identifier."""
    return {station.id: np.array(station.position) for station in site.stations}
