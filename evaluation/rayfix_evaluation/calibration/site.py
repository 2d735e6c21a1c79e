"""The calibration of a site from reports of known positions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from rayfix_evaluation.calibration.measured import KnownReport, StationErrors, errors_of
from rayfix_evaluation.calibration.ranges import calibrate_ranges, with_common_tails
from rayfix_evaluation.calibration.spread import Spread
from rayfix_evaluation.calibration.station import (
    AngleCalibration,
    RangeCalibration,
    StationCalibration,
    calibrate_angles,
    calibrated_station,
    chosen_models,
    num_places,
    try_angles,
)
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo

__all__ = ["SiteCalibration", "calibrate_site"]

_LEAST_PLACES = 3
"""Fewer places cannot tell the errors of a station from those of a place."""

_SHARED = 4.0
"""Independent errors that the other stations' deviation counts for in that of each."""

Progress = Callable[[str, int, int], None]

_Found = TypeVar("_Found", AngleCalibration, RangeCalibration)


@dataclass(frozen=True, kw_only=True)
class SiteCalibration:
    """What was found of a site.

    Attributes
    ----------
    site : SiteInfo
        With all of it.
    stations : Mapping
        Of those that measured, by station.
    errors : Mapping
        What it was found from, by station.
    """

    site: SiteInfo
    stations: Mapping[str, StationCalibration]
    errors: Mapping[str, StationErrors]


def calibrate_site(
    reports: Sequence[KnownReport],
    site: SiteInfo,
    solver: ForwardSolver,
    *,
    progress: Progress = lambda stage, done, total: None,
) -> SiteCalibration:
    """Calibrate the stations of a site.

    Parameters
    ----------
    reports : sequence of KnownReport
    site : SiteInfo
    solver : ForwardSolver
        Of its scene.
    progress : callable
        Given a stage, and how much of how much is done.

    Raises
    ------
    ReportError
        When no station measured at three known places or more.
    """
    progress("paths", 0, 0)
    errors = errors_of(reports, site, solver)
    with_angles = [s for s, e in errors.items() if e.angles is not None and num_places(e.angles.place) >= _LEAST_PLACES]
    with_ranges = [s for s, e in errors.items() if e.ranges is not None and num_places(e.ranges.place) >= _LEAST_PLACES]
    if not with_angles and not with_ranges:
        raise ReportError(
            "no station has angles or propagation times of three known places; check the times of the truth"
        )
    trials = []
    for n, station_id in enumerate(with_angles):
        progress("angles", n, len(with_angles))
        found = errors[station_id].angles
        assert found is not None
        trials.append(try_angles(found))
    models = chosen_models(trials)
    angles = {
        station_id: calibrate_angles(trial, model)
        for station_id, trial, model in zip(with_angles, trials, models, strict=True)
    }
    ranges: dict[str, RangeCalibration] = {}
    for n, station_id in enumerate(with_ranges):
        progress("ranges", n, len(with_ranges))
        measured = errors[station_id].ranges
        assert measured is not None
        ranges[station_id] = calibrate_ranges(measured)
    progress("ranges", 1, 1)
    angles, ranges = _pooled(angles), _pooled(with_common_tails(ranges))
    calibrated = {
        station_id: _station(each, angles.get(station_id), ranges.get(station_id))
        for station_id, each in errors.items()
    }
    stations = tuple(
        calibrated[station.id].station if station.id in calibrated else station for station in site.stations
    )
    return SiteCalibration(site=replace(site, stations=stations), stations=calibrated, errors=errors)


def _station(
    errors: StationErrors, angles: AngleCalibration | None, ranges: RangeCalibration | None
) -> StationCalibration:
    notes = list(angles.notes) if angles is not None else []
    for name, measured, found in (("angles", errors.angles, angles), ("ranges", errors.ranges, ranges)):
        if measured is not None and found is None:
            notes.append(f"its {name} are of fewer than three places, which cannot tell errors from the place")
    if errors.without_path:
        notes.append(f"{errors.without_path} measurements are of places to which the twin has no path")
    of_station = [each for each in (errors.angles, errors.ranges) if each is not None]
    return StationCalibration(
        station=calibrated_station(errors.station, angles, ranges),
        angles=angles,
        ranges=ranges,
        count=sum(len(each.seconds) for each in of_station),
        places=max((num_places(each.place) for each in of_station), default=0),
        notes=tuple(notes),
    )


def _pooled(found: dict[str, _Found]) -> dict[str, _Found]:
    """Draw the deviations of stations to each other, those most that few independent errors tell.

    A deviation of few errors is mostly chance, and one that is too small makes fixes surer than they are.
    """
    by_size: dict[int, list[str]] = {}
    for station_id, each in found.items():
        by_size.setdefault(len(each.spread.stdev), []).append(station_id)
    pooled = dict(found)
    for station_ids in by_size.values():
        squares = np.array([np.square(found[s].spread.stdev) for s in station_ids])
        counts = np.array([found[s].num_independent for s in station_ids])
        common = (counts[:, None] * squares).sum(axis=0) / counts.sum()
        for station_id, square, count in zip(station_ids, squares, counts, strict=True):
            shared = (count * square + _SHARED * common) / (count + _SHARED)
            # Of a deviation from few errors, the predicted error is spread wider (Student).
            wider = shared * (1.0 + 2.0 / (count + _SHARED))
            spread = found[station_id].spread
            pooled[station_id] = replace(
                found[station_id],
                spread=Spread(
                    stdev=tuple(np.sqrt(wider).tolist()),
                    tail_share=spread.tail_share,
                    tail_scale=spread.tail_scale,
                    outlier_share=spread.outlier_share,
                ),
            )
    return pooled
