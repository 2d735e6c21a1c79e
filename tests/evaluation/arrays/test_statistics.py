"""Statistics of angle errors, and the study that makes them."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from rayfix_evaluation.arrays.picture import draw_angle_errors
from rayfix_evaluation.arrays.planar import PlanarArray, Signal
from rayfix_evaluation.arrays.statistics import AngleErrors, angle_statistics, fit_tails
from rayfix_evaluation.arrays.study import ArrayStudy, angle_errors, statistics_rows, study_statistics
from rayfix_evaluation.drops.accuracy import Drop
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_service.fusion.measurements.report import GAUSSIAN
from rayfix_service.wire import parse_report
from rayfix_tables.site import Station

STUDY = ArrayStudy(
    array=PlanarArray(columns=8, rows=8), part=PlanarArray(columns=6, rows=6), signal=Signal(snr_db=30.0)
)
STATIONS = (
    Station(id="a", position=(0.5, 0.6, 2.6), orientation=(0.9, 0.2, 0.0)),
    Station(id="b", position=(3.6, 4.4, 2.3), orientation=(-2.2, 0.0, 0.1)),
)


def errors_of(both: np.ndarray, *, apart: np.ndarray | None = None) -> AngleErrors:
    count = len(both)
    return AngleErrors(
        azimuth=both[:, 0],
        zenith=both[:, 1],
        apart=np.zeros(count) if apart is None else apart,
        other_path=np.zeros(count, np.bool_),
    )


def test_tails_are_found_again() -> None:
    rng = np.random.default_rng(1)
    wide = rng.random(20_000) < 0.15
    errors = rng.standard_normal((20_000, 2)) * [0.01, 0.02] * np.where(wide, 4.0, 1.0)[:, None]
    stdev, model = fit_tails(errors)
    np.testing.assert_allclose(stdev, [0.01, 0.02], rtol=0.03)
    assert model.tail_share == pytest.approx(0.15, abs=0.015)
    assert model.tail_scale == pytest.approx(4.0, rel=0.05)


def test_gaussian_errors_have_no_tails() -> None:
    errors = np.random.default_rng(2).standard_normal((5000, 2)) * [0.01, 0.02]
    stdev, model = fit_tails(errors)
    assert model == GAUSSIAN
    np.testing.assert_allclose(stdev, [0.01, 0.02], rtol=0.04)


def test_bias_deviation_and_outliers_are_told_apart() -> None:
    rng = np.random.default_rng(3)
    both = rng.standard_normal((4000, 2)) * [0.01, 0.02] + [0.005, -0.004]
    off = rng.random(4000) < 0.1
    both[off] += 0.5
    told = angle_statistics(errors_of(both, apart=np.where(off, 0.7, 0.01)), limit=0.2)
    assert told.num_angles == 4000
    assert told.outlier_share == pytest.approx(off.mean(), abs=1e-12)
    assert told.azimuth_bias == pytest.approx(0.005, abs=4.0 * told.bias_stdev)
    assert told.zenith_bias == pytest.approx(-0.004, abs=4.0 * told.bias_stdev)
    assert told.bias_stdev < 0.001
    assert told.azimuth_stdev == pytest.approx(0.01, rel=0.05)
    assert told.zenith_stdev == pytest.approx(0.02, rel=0.05)
    with pytest.raises(ValueError, match="only 0 of 4000 angles are within"):
        angle_statistics(errors_of(both, apart=np.ones(4000)), limit=0.2)


@pytest.fixture(scope="module")
def drops() -> list[Drop]:
    """Drop into an empty room of 4 x 5 x 3 m whose walls reflect little."""
    walls = trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)])
    solver = ForwardSolver.from_mesh(walls.vertices, walls.faces, max_reflections=1, reflection_loss_db=15.0)
    points = np.random.default_rng(4).uniform([0.5, 0.5, 0.5], [3.5, 4.5, 2.0], (25, 3))
    return [Drop(position=x, paths={s.id: solver.paths(s.position, x) for s in STATIONS}) for x in points]


def test_the_study_goes_from_paths_to_report_fields(drops: list[Drop], tmp_path: Path) -> None:
    errors = angle_errors(drops, STATIONS, STUDY, np.random.default_rng(5))
    told = study_statistics(errors, STUDY)
    for name, each in told.items():
        assert each.num_angles == 50
        assert each.outlier_share <= 0.02
        assert each.other_path_share <= 0.04
        # A beam is 12.7 deg wide; what resolves the reflections is far better than what does not.
        assert np.degrees(np.median(errors[name].apart)) < (0.5 if name == "Delay-and-Sum" else 0.05)
    (again,) = [angle_errors(drops, STATIONS, STUDY, np.random.default_rng(5))]
    np.testing.assert_array_equal(again["MUSIC"].azimuth, errors["MUSIC"].azimuth)

    for row in statistics_rows(told):
        angle = {"type": "aoa", "station_id": "a", "azimuth_deg": 10.0, "zenith_deg": 100.0, **row["report"]}
        (parsed,) = parse_report({"measurements": [angle]}).measurements
        assert parsed.azimuth_stdev == pytest.approx(told[row["estimator"]].azimuth_stdev, rel=1e-9)
        assert parsed.error_model == told[row["estimator"]].error_model
        assert set(row["bias"]) == {"azimuth_deg", "zenith_deg", "angle_stdev_deg"}

    draw_angle_errors(tmp_path / "errors.svg", {"room": (STUDY, errors)})
    drawn = (tmp_path / "errors.svg").read_text(encoding="utf-8")
    assert drawn.startswith("<?xml")


def test_stations_that_hear_nothing_are_left_out(drops: list[Drop]) -> None:
    deaf = [Drop(position=drop.position, paths={"a": drop.paths["a"]}) for drop in drops[:3]]
    assert len(angle_errors(deaf, STATIONS, STUDY, np.random.default_rng(1))["ESPRIT"]) == 3
    # With its back to the room.
    away = Station(id="a", position=STATIONS[0].position, orientation=(-2.3, 0.0, 0.0))
    behind = angle_errors(deaf, [away], STUDY, np.random.default_rng(1))["ESPRIT"]
    assert len(behind) <= 3
