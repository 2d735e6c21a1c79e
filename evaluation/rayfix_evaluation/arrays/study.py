"""Errors of the angles that arrays report in a scene: each estimator on simulated snapshots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rayfix_evaluation.arrays.covariance import covariance, num_sources, smoothed_covariance
from rayfix_evaluation.arrays.estimators import ESTIMATORS, Waves
from rayfix_evaluation.arrays.planar import (
    Array,
    Complex,
    PlanarArray,
    Signal,
    receive,
    to_cosines,
    to_scene_direction,
)
from rayfix_evaluation.arrays.statistics import AngleErrors, AngleStatistics, angle_statistics
from rayfix_evaluation.drops.accuracy import Drop
from rayfix_evaluation.truth.forward import Paths
from rayfix_tables.geometry.angles import angles_of, direction, wrap
from rayfix_tables.site import Station


@dataclass(frozen=True, kw_only=True)
class ArrayStudy:
    """An array, its signal, and the processing of its snapshots.

    Attributes
    ----------
    array : PlanarArray
    part : PlanarArray
        Subarray of the spatial smoothing, which all estimators except Delay-and-Sum need.
    signal : Signal
    most_waves : int
        Largest number of waves that an estimator searches for.
    """

    array: PlanarArray
    part: PlanarArray
    signal: Signal
    most_waves: int = 6

    @property
    def limit(self) -> float:
        """Error above which an angle is an outlier, rad: the half-power beam width straight ahead."""
        return self.array.beam_width

    def waves(self, snapshots: Complex, name: str) -> Waves:
        """Estimate waves from snapshots, strongest first; see :data:`ESTIMATORS` for the names."""
        if name == "Delay-and-Sum":
            return ESTIMATORS[name](covariance(snapshots), self.array, 1)
        cov = smoothed_covariance(snapshots, self.array, self.part)
        count = num_sources(np.asarray(np.linalg.eigvalsh(cov), np.float64), snapshots.shape[1], most=self.most_waves)
        return ESTIMATORS[name](cov, self.part, count)


def angle_errors(
    drops: Sequence[Drop], stations: Sequence[Station], study: ArrayStudy, rng: np.random.Generator
) -> dict[str, AngleErrors]:
    """Errors of each estimator's strongest wave relative to the strongest path in front of the array.

    All estimators use the same snapshots. Pairs of drop and station without a path from the front are left out.
    """
    rows: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in ESTIMATORS}
    for drop in drops:
        for station in stations:
            if station.id not in drop.paths:
                continue
            paths = drop.paths[station.id]
            snapshots = receive(study.array, station, paths, study.signal, rng)
            if snapshots is None:
                continue
            for name in ESTIMATORS:
                found = to_scene_direction(station, study.waves(snapshots, name).cosines[:1])[0]
                rows[name].append(_error(found, station, paths))
    columns = {name: np.array(found).reshape(-1, 4).T for name, found in rows.items()}
    return {
        name: AngleErrors(azimuth=azimuth, zenith=zenith, apart=apart, other_path=other > 0.0)
        for name, (azimuth, zenith, apart, other) in columns.items()
    }


def _error(found: Array, station: Station, paths: Paths) -> tuple[float, float, float, float]:
    """Errors of azimuth and zenith, angle between the directions, and 1 if another path is nearer."""
    _, before = to_cosines(station, paths.azimuth, paths.zenith)
    azimuth, zenith = paths.azimuth[before], paths.zenith[before]
    apart = np.arccos(np.clip(direction(azimuth, zenith) @ found, -1.0, 1.0))
    found_azimuth, found_zenith = angles_of(found)
    strongest = int(np.argmax(paths.gain_db[before]))
    return (
        float(wrap(found_azimuth - azimuth[strongest])),
        float(found_zenith - zenith[strongest]),
        float(apart[strongest]),
        float(np.argmin(apart) != strongest),
    )


def study_statistics(errors: Mapping[str, AngleErrors], study: ArrayStudy) -> dict[str, AngleStatistics]:
    """Statistics of each estimator's errors."""
    return {name: angle_statistics(each, limit=study.limit) for name, each in errors.items()}


def statistics_rows(statistics: Mapping[str, AngleStatistics]) -> list[dict[str, Any]]:
    """Rows of a table, one for each estimator: JSON-compatible, degrees."""
    return [
        {
            "estimator": name,
            "angles": each.num_angles,
            "outlier_share": each.outlier_share,
            "other_path_share": each.other_path_share,
            "bias": each.site_bias(),
            "report": each.report_fields(),
        }
        for name, each in statistics.items()
    ]
