"""Simulated reports of several paths: which paths they are of, and their clocks."""

from typing import Any

import numpy as np
import pytest

from rayfix_evaluation.drops.several import simulate_paths
from rayfix_evaluation.drops.simulate import Noise
from rayfix_evaluation.truth.forward import ForwardSolver, Paths
from rayfix_service.wire import parse_report
from tests.support.scenes.shapes import box

SILENT = Noise(azimuth_stdev=1e-14, zenith_stdev=1e-14, range_stdev=1e-14)


@pytest.fixture(scope="module")
def paths() -> dict[str, Paths]:
    """Paths in an empty room of 6 x 5 x 3 m."""
    triangles = box([0.0, 0.0, 0.0], [6.0, 5.0, 3.0])
    solver = ForwardSolver.from_mesh(
        triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), max_reflections=2
    )
    return {"a": solver.station(np.array([1.0, 1.0, 2.0])).paths(np.array([4.0, 3.0, 1.0]))}


def simulated(paths: dict[str, Paths], **options: Any) -> list[dict[str, Any]]:
    """Measurements without noise."""
    report = simulate_paths(paths, SILENT, rng=np.random.default_rng(1), **options)
    assert len(parse_report({"measurements": [m | stdevs(m) for m in report["measurements"]]}).measurements)
    found: list[dict[str, Any]] = report["measurements"]
    return found


def stdevs(measurement: dict[str, Any]) -> dict[str, float]:
    """Return deviations that a report may have."""
    return {key: 0.1 for key in measurement if "stdev" in key}


def test_the_strongest_paths_are_reported(paths: dict[str, Paths]) -> None:
    found = simulated(paths, most=4, clock="known")
    assert [m["range_m"] for m in found] == pytest.approx(paths["a"].path_length[:4].tolist())
    assert [m["azimuth_deg"] for m in found] == pytest.approx(np.degrees(paths["a"].azimuth[:4]).tolist())
    assert [m["zenith_deg"] for m in found] == pytest.approx(np.degrees(paths["a"].zenith[:4]).tolist())


def test_clocks_shift_all_lengths_alike(paths: dict[str, Paths]) -> None:
    length = paths["a"].path_length[:5]
    ue = np.array([m["toa_m"] for m in simulated(paths, most=5, clock="ue")])
    assert ue - ue[0] == pytest.approx(length - length[0])
    assert 0.0 < ue[0] - length[0] < 300.0
    own = np.array([m["delay_ns"] for m in simulated(paths, most=5, clock="station")])
    assert 0.299792458 * own == pytest.approx(length - length.min(), abs=1e-9)


def test_spurious_paths_replace_the_weakest(paths: dict[str, Paths]) -> None:
    found = simulated(paths, most=5, clock="known", spurious=2)
    length = paths["a"].path_length[:5]
    assert [m["range_m"] for m in found[:3]] == pytest.approx(length[:3].tolist())
    assert np.abs([found[n]["range_m"] - length[n] for n in (3, 4)]).min() > 1e-3


def test_a_missing_path_lets_a_weaker_one_in(paths: dict[str, Paths]) -> None:
    found = simulated(paths, most=5, clock="known", missing=0.5)
    assert len(found) == 5
    rank = [int(np.argmin(np.abs(paths["a"].path_length - m["range_m"]))) for m in found]
    assert max(rank) > 4
    assert simulate_paths(paths, SILENT, rng=np.random.default_rng(0), most=5, missing=1.0)["measurements"] == []
