"""Deviations of stations from reports of unknown positions, by expectation-maximisation over the fixes' posteriors.

The expectation is over points of each fix's posterior, given the deviations so far; the maximisation fits the spread
of the errors at these points. Only the straight path counts, at points that the station sees; what is reflected, or has
nothing to do with the position, is taken up by a share of outliers. Biases and turns are not looked for: without known
positions, a common turn or bias of stations is mostly a shift of the positions.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.calibration.measured import StationErrors
from rayfix_evaluation.calibration.site import SiteCalibration
from rayfix_evaluation.calibration.spread import Spread, fit_spread
from rayfix_evaluation.calibration.station import (
    AngleCalibration,
    RangeCalibration,
    StationCalibration,
    calibrated_station,
)
from rayfix_evaluation.drops.accuracy import solver_of
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_service.fusion.fusion import Fusion
from rayfix_service.fusion.measurements.directions import to_scene, without_bias
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_service.fusion.posterior.fixes import make_fix
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.errors import ReportError
from rayfix_tables.geometry.angles import angles_of
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

__all__ = ["calibrate_deviations"]

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

_ROUNDS = 12
_POINTS = 24
_MOST_REPORTS = 1000
_LEAST = 30
"""Measurements that a deviation is found from at least."""

_ENOUGH = 0.01
"""Relative change of all deviations at which the search ends."""


def calibrate_deviations(
    reports: Sequence[Report], table: Table, *, progress: Progress = lambda stage, done, total: None
) -> SiteCalibration:
    """Find the deviations of a site's stations without true positions.

    Parameters
    ----------
    reports : sequence of Report
        Of them, at most a thousand are used, spread evenly.
    table : Table
    progress : callable

    Raises
    ------
    ReportError
        When no station has enough measurements of fixes with status ok.
    """
    step = max(1, -(-len(reports) // _MOST_REPORTS))
    used, solver, site = list(reports[::step]), solver_of(table), table.site
    found: dict[str, StationCalibration] = {}
    settings = FusionSettings()
    fusion = Fusion(table, settings)
    for done in range(_ROUNDS):
        progress("deviations", done, _ROUNDS)
        rows = _expected(used, table, site, fusion, settings, solver)
        before = {name: each.station.deviations for name, each in found.items()}
        found = {}
        for station in table.site.stations:
            each = _station_of(station.id, rows.get(station.id, ([], [])), table.site)
            if each is not None:
                found[station.id] = each
        if not found:
            raise ReportError(
                f"no station has {_LEAST} measurements of fixes with status ok; give a longer log, or the truth"
            )
        site = replace(site, stations=tuple(found[s.id].station if s.id in found else s for s in table.site.stations))
        if before and all(_close(before.get(name), each.station.deviations) for name, each in found.items()):
            break
    progress("deviations", _ROUNDS, _ROUNDS)
    errors = {
        name: StationErrors(station=table.site.station_by_id[name], angles=None, ranges=None, without_path=0)
        for name in found
    }
    return SiteCalibration(site=site, stations=found, errors=errors)


_Rows = dict[str, tuple[list[Array], list[Array]]]
"""Of each station, errors of angles, rows of (azimuth, zenith, weight), deg, and of ranges, (error, weight), m."""


def _expected(
    reports: Sequence[Report],
    table: Table,
    site: SiteInfo,
    fusion: Fusion,
    settings: FusionSettings,
    solver: ForwardSolver,
) -> _Rows:
    """Errors of all measurements at points of their fixes' posteriors."""
    rows: _Rows = {}
    for report in reports:
        try:
            fix = make_fix(report, fusion.product(report, site=site), table, settings)
        except ReportError:
            continue
        if fix.status != "ok" or fix.regions is None:
            continue
        places = fix.regions.points.places()
        places = places[:: max(1, len(places) // _POINTS)]
        for measurement in report.measurements:
            if not isinstance(measurement, Angle | Range):
                continue
            station = site.station_by_id[measurement.station_id]
            seen = places[solver.line_of_sight(station.position, places)]
            if 2 * len(seen) < len(places):
                continue
            weight = np.full((len(seen), 1), 1.0 / len(seen))
            apart = seen - np.asarray(station.position)
            angles, ranges = rows.setdefault(station.id, ([], []))
            if isinstance(measurement, Range):
                error = measurement.path_length - station.bias.range - np.linalg.norm(apart, axis=1)
                ranges.append(np.column_stack([error, weight]))
                continue
            measured = to_scene(without_bias(measurement, station), station, site.north)
            if measured.zenith is None or measured.azimuth is None:
                continue
            azimuth, zenith = angles_of(apart)
            error = np.column_stack([measured.azimuth - azimuth, measured.zenith - zenith])
            error[:, 0] = (error[:, 0] + np.pi) % (2.0 * np.pi) - np.pi
            angles.append(np.column_stack([np.rad2deg(error), weight]))
    return rows


def _station_of(station_id: str, rows: tuple[list[Array], list[Array]], site: SiteInfo) -> StationCalibration | None:
    angles = ranges = None
    if len(rows[0]) >= _LEAST:
        table = np.vstack(rows[0])
        spread = fit_spread(table[:, :2], 360.0 * 180.0, table[:, 2])
        angles = _angles(spread, len(rows[0]))
    if len(rows[1]) >= _LEAST:
        table = np.vstack(rows[1])
        ranges = _ranges(fit_spread(table[:, :1], 50.0, table[:, 1]), len(rows[1]))
    if angles is None and ranges is None:
        return None
    before = site.station_by_id[station_id]
    after = calibrated_station(before, angles, ranges)
    return StationCalibration(
        station=replace(before, deviations=after.deviations),
        angles=angles,
        ranges=ranges,
        count=len(rows[0]) + len(rows[1]),
        places=0,
        notes=("biases and turns need true positions: give --truth",),
    )


def _angles(spread: Spread, count: int) -> AngleCalibration:
    return AngleCalibration(
        model="none",
        evidence={},
        spread=spread,
        num_independent=float(count),
        correlation_time=None,
        correlated_share=None,
        turn=None,
        turn_stdev=None,
        constant=np.zeros(2),
        constant_stdev=np.zeros(2),
        angles=None,
        azimuth_range=(-180.0, 180.0),
        zenith_range=(0.0, 180.0),
        notes=(),
    )


def _ranges(spread: Spread, count: int) -> RangeCalibration:
    return RangeCalibration(
        model="none",
        evidence={},
        spread=spread,
        num_independent=float(count),
        bias=0.0,
        bias_stdev=0.0,
        correlation_time=None,
        correlated_share=None,
    )


def _close(one: object, other: object) -> bool:
    if one is None or other is None:
        return one is other
    pairs = [(a, b) for a, b in zip(vars(one).values(), vars(other).values(), strict=True)]
    return all(a == b or (a and b and abs(a - b) <= _ENOUGH * abs(a)) for a, b in pairs)
