"""Errors that were put into measurements are found in them, and what a log does not tell is not."""

import numpy as np
import pytest

from rayfix_evaluation.calibration.measured import KnownReport, errors_of, turn_derivatives
from rayfix_evaluation.calibration.site import SiteCalibration, calibrate_site
from rayfix_evaluation.calibration.spread import Spread, fit_spread, log_density
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_service.fusion.measurements.directions import to_scene, without_bias
from rayfix_service.fusion.measurements.report import Angle, Measurement, Range, Report
from rayfix_tables.errors import ReportError
from rayfix_tables.geometry.angles import angles_of, direction, local_to_scene
from rayfix_tables.site import SiteInfo, Station

pytestmark = pytest.mark.slow

POSITIONS = {"a": (5.0, 4.0, 2.9), "b": (0.3, 0.3, 2.0), "c": (9.7, 7.7, 2.0)}
"""A station under the middle of the ceiling, which sees all round, and two in corners of a room of 10 x 8 x 3 m."""

NOISE_DEG = 1.0


def room() -> ForwardSolver:
    """Solver of an empty room of which only the straight paths count."""
    corners = np.array([[x, y, z] for x in (0.0, 10.0) for y in (0.0, 8.0) for z in (0.0, 3.0)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))]
    return ForwardSolver.from_mesh(corners, faces, max_reflections=0)


def site() -> SiteInfo:
    stations = tuple(Station(id=name, position=position) for name, position in POSITIONS.items())
    return SiteInfo(name="room", north=0.0, max_path_length=30.0, stations=stations)


TURN_DEG = np.array([0.0, 0.0, 3.0])


def measured(
    station: str, position: np.ndarray, rng: np.random.Generator, *, gain: float = 1.0, turn_deg: np.ndarray = TURN_DEG
) -> list[Measurement]:
    """Measure with a station that is turned, has a zenith bias of 2 deg, a gain and a range bias of 0.3 m."""
    apart = position - POSITIONS[station]
    wx, wy, wz = np.deg2rad(turn_deg)
    turned = np.eye(3) + np.array([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]])
    azimuth, zenith = angles_of(np.linalg.solve(turned, apart))
    noise = np.deg2rad(NOISE_DEG) * rng.normal(size=2)
    stated = np.deg2rad(0.5 * NOISE_DEG)
    angle = Angle(
        station_id=station,
        azimuth=gain * float(azimuth) + noise[0],
        azimuth_stdev=stated,
        zenith=float(zenith) + np.deg2rad(2.0) + noise[1],
        zenith_stdev=stated,
        frame="lcs",
    )
    length = float(np.linalg.norm(apart)) + 0.3 + 0.1 * rng.normal()
    return [angle, Range(station_id=station, path_length=length, stdev=0.05)]


def reports(places: int, each: int, *, gain: float = 1.0, seed: int = 1) -> list[KnownReport]:
    rng = np.random.default_rng(seed)
    found = []
    for place in range(places):
        position = rng.uniform([0.5, 0.5, 0.5], [9.5, 7.5, 1.8])
        for n in range(each):
            all_of_them = tuple(
                m for name in POSITIONS for m in measured(name, position, rng, gain=gain if name != "a" else 1.0)
            )
            x, y, z = position.tolist()
            known = KnownReport(
                report=Report(measurements=all_of_them), position=(x, y, z), seconds=100.0 * place + n, place=place
            )
            found.append(known)
    return found


@pytest.fixture(scope="module")
def found() -> SiteCalibration:
    return calibrate_site(reports(30, 6), site(), room())


def test_turns_and_biases_are_found(found: SiteCalibration) -> None:
    station = found.stations["a"]
    assert station.angles is not None
    assert station.angles.turn is not None
    # 180 errors of 1 deg tell a turn to 0.1 deg.
    assert station.angles.turn == pytest.approx(TURN_DEG, abs=0.3)
    assert np.rad2deg(station.station.bias.zenith) == pytest.approx(2.0, abs=0.3)
    for each in found.stations.values():
        assert each.ranges is not None
        assert each.ranges.model == "constant"
        assert each.station.bias.range == pytest.approx(0.3, abs=0.03)
        assert abs(each.station.bias.range - 0.3) < 3.0 * each.station.bias.range_stdev


def test_deviations_are_those_of_the_noise_and_not_the_stated_ones(found: SiteCalibration) -> None:
    for each in found.stations.values():
        deviations = each.station.deviations
        assert deviations is not None
        assert deviations.azimuth is not None
        assert deviations.zenith is not None
        assert np.rad2deg([deviations.azimuth, deviations.zenith]) == pytest.approx([1.0, 1.0], rel=0.12)
        assert deviations.range == pytest.approx(0.1, rel=0.12)
        assert deviations.tail_share == 0.0


def test_corrected_angles_point_to_the_target(found: SiteCalibration) -> None:
    # Other places, without noise: what is left is the error of the calibration.
    rng = np.random.default_rng(7)
    left = []
    for _ in range(100):
        position = rng.uniform([1.0, 1.0, 0.6], [9.0, 7.0, 1.7])
        for name in POSITIONS:
            station = found.stations[name].station
            angle = measured(name, position, _Silent())[0]  # type: ignore[arg-type]
            assert isinstance(angle, Angle)
            there = to_scene(without_bias(angle, station), station, 0.0)
            assert there.azimuth is not None
            assert there.zenith is not None
            apart = position - POSITIONS[name]
            cosine = direction(there.azimuth, there.zenith) @ apart / np.linalg.norm(apart)
            left.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    # Uncorrected they are off by 2 to 3.6 deg.
    assert np.median(left) < 0.4
    assert np.quantile(left, 0.95) < 1.2


class _Silent:
    """A generator that draws zeros."""

    def normal(self, size: int | None = None) -> object:
        return 0.0 if size is None else np.zeros(size)


def test_a_gain_is_taken_for_a_bias_that_depends_on_the_direction() -> None:
    found = calibrate_site(reports(30, 6, gain=0.8, seed=3), site(), room())
    station = found.stations["b"]
    assert station.angles is not None
    assert station.angles.model == "smooth"
    assert station.station.bias.angles is not None
    rng = np.random.default_rng(8)
    before, after = [], []
    for _ in range(100):
        position = rng.uniform([1.0, 1.0, 0.6], [9.0, 7.0, 1.7])
        angle = measured("b", position, _Silent(), gain=0.8)[0]  # type: ignore[arg-type]
        assert isinstance(angle, Angle)
        true = float(angles_of(position - POSITIONS["b"])[0])
        there = to_scene(without_bias(angle, station.station), station.station, 0.0)
        assert there.azimuth is not None
        after.append(abs(np.degrees(there.azimuth - true)))
        before.append(abs(np.degrees(angle.azimuth - true)))
    assert np.median(before) > 8.0
    assert np.median(after) < 1.0


def test_what_was_not_seen_is_named() -> None:
    with pytest.raises(ReportError, match="three known places"):
        calibrate_site(reports(2, 6), site(), room())
    narrow = calibrate_site(reports(12, 2), site(), room())
    # A station in a corner sees a quarter of the azimuths, which do not tell a tilt from a bias of the zenith.
    assert any("turn about x" in note for note in narrow.stations["b"].notes)
    assert not any("turn about z" in note for note in narrow.stations["a"].notes)


def test_the_derivatives_of_a_turn() -> None:
    rng = np.random.default_rng(2)
    azimuth, zenith = rng.uniform(-3.0, 3.0, 50), rng.uniform(0.5, 2.6, 50)
    derivatives = turn_derivatives(np.rad2deg(np.column_stack([azimuth, zenith])))
    for axis in range(3):
        small = np.zeros(3)
        small[axis] = 1e-6
        # A small turn about x, y or z is what slant, downtilt and bearing are about zero.
        rotation = local_to_scene((small[2], small[1], small[0]))
        seen = angles_of(direction(azimuth, zenith) @ rotation)
        numeric = [(seen[0] - azimuth) / 1e-6, (seen[1] - zenith) / 1e-6]
        assert derivatives[0, :, axis] == pytest.approx(numeric[0], abs=1e-4)
        assert derivatives[1, :, axis] == pytest.approx(numeric[1], abs=1e-4)


@pytest.mark.parametrize(("share", "scale"), [(0.0, 1.0), (0.2, 4.0)])
def test_the_spread_of_errors(share: float, scale: float) -> None:
    rng = np.random.default_rng(5)
    wide = np.where(rng.random(4000) < share, scale, 1.0)[:, None]
    errors = np.array([1.5, 0.7]) * wide * rng.normal(size=(4000, 2))
    errors[:80] = rng.uniform(-90.0, 90.0, (80, 2))
    found = fit_spread(errors, 180.0 * 180.0)
    assert found.stdev == pytest.approx((1.5, 0.7), rel=0.06)
    assert found.tail_share == pytest.approx(share, abs=0.04)
    assert found.tail_scale == pytest.approx(scale, rel=0.15)
    assert found.outlier_share == pytest.approx(0.02, abs=0.012)


def test_the_density_of_errors_is_one() -> None:
    spread = Spread(stdev=(2.0,), tail_share=0.3, tail_scale=3.0, outlier_share=0.1)
    x = np.linspace(-500.0, 500.0, 200_001)
    inside = np.abs(x) <= 180.0
    density = np.exp(log_density(x[:, None], spread, 360.0)) - np.where(inside, 0.0, 0.1 / 360.0)
    assert np.trapezoid(density, x) == pytest.approx(1.0, abs=1e-3)


def test_paths_are_told_apart() -> None:
    """A reflection that is measured is compared with the reflected path, not with the straight one."""
    solver = ForwardSolver.from_mesh(
        [[-5.0, 2.0, -5.0], [15.0, 2.0, -5.0], [5.0, 2.0, 20.0]], [[0, 1, 2]], max_reflections=1
    )
    flat = SiteInfo(name="wall", north=0.0, max_path_length=60.0, stations=(Station(id="a", position=(0.0, 0.0, 1.0)),))
    # The mirror image of the target (4, 0, 1) in the wall y = 2 is (4, 4, 1).
    angle = Angle(station_id="a", azimuth=np.pi / 4 + 0.01, azimuth_stdev=0.02, zenith=np.pi / 2, zenith_stdev=0.02)
    length = Range(station_id="a", path_length=np.sqrt(32.0) + 0.1, stdev=0.1)
    known = KnownReport(report=Report(measurements=(angle, length)), position=(4.0, 0.0, 1.0), seconds=0.0, place=0)
    errors = errors_of([known], flat, solver)["a"]
    assert errors.angles is not None
    assert errors.ranges is not None
    assert errors.angles.error[0] == pytest.approx([np.degrees(0.01), 0.0], abs=1e-9)
    assert errors.ranges.error[0] == pytest.approx(0.1, abs=1e-9)
