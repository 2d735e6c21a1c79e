"""Which part of a calibration explains reports that it was not made from better than the site as it is."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rayfix_evaluation.calibration.evidence import log_evidences
from rayfix_evaluation.calibration.measured import KnownReport
from rayfix_evaluation.calibration.site import SiteCalibration, calibrate_site
from rayfix_evaluation.calibration.station import folds_of
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.table import Table

__all__ = ["PARTS", "HeldOut", "Part", "judge", "only"]

Part = Literal["nothing", "deviations", "systematic", "all"]
"""What of a calibration is taken: nothing, deviations and tails, biases and turns, or all."""

PARTS: tuple[Part, ...] = ("all", "systematic", "deviations", "nothing")

_FOLDS = 3
_MOST = 300
"""Reports that are located in all."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """The judgement.

    Attributes
    ----------
    part : {"nothing", "deviations", "systematic", "all"}
        The best one.
    evidence : Mapping
        Mean log evidence of a held-out report, by part.
    count : int
        Held-out reports; 0 where there were too few places to hold any out. Then all reports judge.
    """

    part: Part
    evidence: Mapping[Part, float]
    count: int


def judge(
    reports: Sequence[KnownReport],
    table: Table,
    solver: ForwardSolver,
    calibration: SiteCalibration,
    *,
    progress: Progress = lambda stage, done, total: None,
) -> HeldOut:
    """Calibrate by two thirds of the places, locate the reports of the others, and compare the parts.

    Parameters
    ----------
    reports : sequence of KnownReport
    table : Table
        Of the site as it is.
    solver : ForwardSolver
        Of its scene.
    calibration : SiteCalibration
        By all of the reports; it is judged by them where too few places are left without some.
    progress : callable
        Given a stage, and how much of how much is done.
    """
    place = np.array([each.place for each in reports])
    folds = folds_of(place, np.array([each.seconds for each in reports]), most=_FOLDS)
    rows: list[np.ndarray[tuple[int, int], np.dtype[np.float64]]] = []
    for fold in np.unique(folds):
        progress("held-out evidence", int(fold), _FOLDS)
        held = [each for each, out in zip(reports, folds == fold, strict=True) if out]
        rest = [each for each, out in zip(reports, folds == fold, strict=True) if not out]
        try:
            found = calibrate_site(rest, table.site, solver)
        except ReportError:  # too few places
            rows.clear()
            break
        rows.append(_evidences(held, table, found))
    found_rows = np.concatenate(rows) if rows else _evidences(reports, table, calibration)
    count = len(found_rows) if rows else 0
    progress("held-out evidence", _FOLDS, _FOLDS)
    means = found_rows.mean(axis=0) if len(found_rows) else np.zeros(len(PARTS))
    return HeldOut(
        part=PARTS[int(np.argmax(means))],
        evidence=dict(zip(PARTS, means.tolist(), strict=True)),
        count=count,
    )


def only(part: Part, calibration: SiteCalibration, before: SiteInfo) -> SiteCalibration:
    """Leave of a calibration one part.

    Parameters
    ----------
    part : {"nothing", "deviations", "systematic", "all"}
    calibration : SiteCalibration
    before : SiteInfo
        The site as it is.
    """
    stations = {
        name: replace(found, station=_only(part, before.station_by_id[name], found.station))
        for name, found in calibration.stations.items()
    }
    site = replace(before, stations=tuple(stations[s.id].station if s.id in stations else s for s in before.stations))
    return replace(calibration, site=site, stations=stations)


def _only(part: Part, before: Station, after: Station) -> Station:
    match part:
        case "all":
            return after
        case "systematic":
            return replace(after, deviations=before.deviations)
        case "deviations":
            return replace(before, deviations=after.deviations)
        case "nothing":
            return before


def _evidences(
    reports: Sequence[KnownReport], table: Table, found: SiteCalibration
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Log evidence of reports for each part, shape (n, 4)."""
    sites = [only(part, found, table.site).site for part in PARTS]
    return log_evidences([each.report for each in reports], table, sites, most=_MOST // _FOLDS)
