"""Angle errors of antenna arrays in a site, as statistics for reports and site files."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.arrays.planar import PlanarArray, Signal
from rayfix_evaluation.arrays.study import ArrayStudy, angle_errors, statistics_rows, study_statistics
from rayfix_evaluation.drops.accuracy import Drop
from rayfix_tables.site import Station

__all__ = ["study_arrays"]

_DRAWS = 11  # purpose of a generator, as in rayfix_evaluation.studies.cases

_STUDIES = {
    "4 x 4 antennas": ArrayStudy(
        array=PlanarArray(columns=4, rows=4), part=PlanarArray(columns=3, rows=3), signal=Signal(snr_db=20.0)
    ),
    "8 x 8 antennas": ArrayStudy(
        array=PlanarArray(columns=8, rows=8), part=PlanarArray(columns=6, rows=6), signal=Signal(snr_db=20.0)
    ),
}


def study_arrays(drops: Sequence[Drop], stations: Sequence[Station], *, seed: int) -> list[dict[str, Any]]:
    """Estimate angles of the paths to drops by four estimators, for two sizes of array.

    Parameters
    ----------
    drops : sequence of Drop
        With all paths.

    Returns
    -------
    list of dict
        JSON-compatible, one for each size. An estimator with fewer than ten inliers has errors but no statistics.
        Angles in deg.
    """
    found = []
    for label, study in _STUDIES.items():
        errors = angle_errors(drops, stations, study, np.random.default_rng([seed, _DRAWS]))
        usable = {name: each for name, each in errors.items() if (each.apart <= study.limit).sum() >= 10}
        rows = {row["estimator"]: row for row in statistics_rows(study_statistics(usable, study))}
        found.append(
            {
                "label": label,
                "snr_db": study.signal.snr_db,
                "beam_width_deg": round(float(np.degrees(study.limit)), 3),
                "estimators": {
                    name: {
                        "apart_deg": np.round(np.degrees(np.sort(each.apart)), 4).tolist(),
                        "p50_deg": _percentile(each.apart, 50),
                        "p90_deg": _percentile(each.apart, 90),
                        "statistics": _rounded(rows.get(name)),
                    }
                    for name, each in errors.items()
                },
            }
        )
    return found


def _percentile(values: NDArray[np.float64], percent: float) -> float | None:
    if not len(values):
        return None
    return round(float(np.degrees(np.percentile(values, percent, method="inverted_cdf"))), 4)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    return round(value, 6) if isinstance(value, float) else value
