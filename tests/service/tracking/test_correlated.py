"""Tracks of stations whose errors drift, in an empty room."""

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.report import Angle, Height, Range, Report
from rayfix_service.fusion.posterior.fused import Fused
from rayfix_service.locator import Locator
from rayfix_service.tracking.correlated import update_drifting, with_drifts
from rayfix_service.tracking.drift import DriftModel, no_drifts
from rayfix_service.tracking.motion import MotionModel, bridge_of, step_of
from rayfix_service.tracking.on_paths import Stations
from rayfix_service.tracking.particles import Particles
from rayfix_service.tracking.path_kernels import settle
from rayfix_service.tracking.settings import TrackingSettings
from rayfix_service.tracking.tracker import Tracker
from rayfix_tables.site import Deviations
from rayfix_tables.table import Table
from tests.support.tables.open_room import POSITIONS, open_room_table

Array = NDArray[np.float64]
DRIFT, SCATTER = 6.0, 1.0
STDEV = math.radians(math.hypot(DRIFT, SCATTER))
PLACE = np.array([2.4, 3.3, 1.2])


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Table:
    return open_room_table(Path(tmp_path_factory.mktemp("room")) / "room.h5")


@pytest.fixture(scope="module")
def locator(table: Table) -> Locator:
    return Locator(table)


def told(table: Table, share: float, seconds: float) -> Table:
    """Write what the errors are into the site."""
    found = Deviations(correlated_share=share, correlation_time=seconds)
    stations = tuple(replace(each, deviations=found) for each in table.site.stations)
    return replace(table, site=replace(table.site, stations=stations))


def fused(locator: Locator, place: Array, errors: Array, seconds: float, **others: object) -> Fused:
    """Fuse angles of all stations to a place with errors of shape (4, 2), deg."""
    angles = []
    for at, error in zip(POSITIONS.values(), np.radians(errors), strict=True):
        x, y, z = place - at
        angles.append(
            Angle(
                station_id=next(name for name in POSITIONS if POSITIONS[name] == at),
                azimuth=math.atan2(y, x) + float(error[0]),
                zenith=math.atan2(math.hypot(x, y), z) + float(error[1]),
                azimuth_stdev=STDEV,
                zenith_stdev=STDEV,
            )
        )
    moment = datetime(2026, 1, 31, 10, tzinfo=UTC) + timedelta(seconds=seconds)
    return locator.fuse(
        Report(measurements=tuple(angles), target_id="t", timestamp=moment.isoformat(), **others)  # type: ignore[arg-type]
    )


def final_errors(locator: Locator, tracker: Tracker, rate: int, num_targets: int = 6, seconds: int = 4) -> Array:
    """Errors of targets that stand still, with a bias for ever, at the end."""
    found = []
    for n in range(num_targets):
        rng = np.random.default_rng([5, n])
        bias, scatter = DRIFT * rng.standard_normal((4, 2)), SCATTER * rng.standard_normal((10 * seconds + 1, 4, 2))
        for k in range(0, 10 * seconds + 1, 10 // rate):
            track = tracker.follow(fused(locator, PLACE, bias + scatter[k], 100.0 * n + 0.1 * k))
        assert track is not None
        found.append(np.linalg.norm(track.estimate.position - PLACE))
    return np.array(found)


def test_a_bias_for_ever_costs_no_more_at_ten_reports_a_second(table: Table, locator: Locator):
    site = told(table, DRIFT**2 / (DRIFT**2 + SCATTER**2), 1e6)
    slow, fast = (final_errors(locator, Tracker(site), rate) for rate in (1, 10))
    assert fast.mean() < 1.03 * slow.mean()


def test_what_is_stated_holds_biases_for_ever(table: Table, locator: Locator):
    """Errors of independent reports would have averaged out: the track's covariance says that these have not."""
    spread, apart = np.zeros(2), np.zeros(2)
    for seed in range(6, 14):
        bias = DRIFT * np.random.default_rng(seed).standard_normal((4, 2))
        for n, settings in enumerate((None, TrackingSettings(drift=None))):
            tracker = Tracker(told(table, 0.97, 1e6), settings)
            for k in range(31):
                track = tracker.follow(fused(locator, PLACE, bias, 0.1 * k))
            assert track is not None
            off, cov = track.estimate.position - PLACE, track.estimate.covariance
            spread[n] += np.trace(cov)
            apart[n] += off @ np.linalg.solve(cov, off)
    assert spread[0] > 3.0 * spread[1]
    assert apart[0] < 43.0 < apart[1]  # 99 % of chi2 with 8 times 3 degrees


def test_without_drift_tracks_are_the_former_ones(table: Table, locator: Locator):
    """A tracker of a scene alone knows no station: both take in the same Gaussians with the same random numbers."""
    rng = np.random.default_rng(7)
    reports = [fused(locator, PLACE + 0.1 * k, 6.0 * rng.standard_normal((4, 2)), 0.5 * k) for k in range(8)]
    without, former = Tracker(table, TrackingSettings(drift=None)), Tracker(table.scene)
    for report in reports:
        found, expected = without.follow(report), former.follow(report)
        assert found is not None
        assert expected is not None
        np.testing.assert_array_equal(found.regions.points.position, expected.regions.points.position)
        assert found.state == expected.state


def test_white_errors_that_the_site_file_tells_of_are_followed_as_well(table: Table, locator: Locator):
    rng = np.random.default_rng(8)
    both = {"site": Tracker(told(table, 0.0, 1.0)), "former": Tracker(table, TrackingSettings(drift=None))}
    errors: dict[str, list[float]] = {name: [] for name in both}
    for k in range(60):
        place = PLACE + np.array([0.02 * k, 0.0, 0.0])
        report = fused(locator, place, 6.0 * rng.standard_normal((4, 2)), 0.2 * k)
        for name, tracker in both.items():
            track = tracker.follow(report)
            assert track is not None
            errors[name].append(float(np.linalg.norm(track.estimate.position - place)))
    assert np.mean(errors["site"]) < 1.1 * np.mean(errors["former"])


def test_a_known_height_counts(table: Table, locator: Locator):
    tracker, rng = Tracker(table), np.random.default_rng(9)
    for k in range(30):
        errors = 6.0 * rng.standard_normal((4, 2)) + [0.0, 4.0]  # all too low
        track = tracker.follow(fused(locator, PLACE, errors, 0.5 * k, height=Height(z=1.2, stdev=0.05)))
    assert track is not None
    assert track.estimate.position[2] == pytest.approx(1.2, abs=0.1)


def test_a_report_of_narrow_errors_goes_the_way_of_gaussians(table: Table, locator: Locator):
    length = Range(station_id="a", path_length=3.0, stdev=0.3)
    wide = locator.fuse(Report(measurements=(length,)))
    assert [each.factor is None for each in wide.factors] == [False]
    narrow = locator.fuse(Report(measurements=(replace(length, stdev=0.01),)))
    assert all(each.factor is None for each in narrow.factors)


def test_memory_of_a_target_is_bounded(table: Table, locator: Locator):
    tracker = Tracker(table, TrackingSettings(drift=DriftModel(max_stations=2)))
    for k in range(20):
        tracker.follow(fused(locator, PLACE, np.zeros((4, 2)), 0.1 * k))
    drifts = tracker._tracks["t"].particles.drifts
    assert drifts is not None
    assert drifts.mean.shape == drifts.variance.shape == (512, 2, 3)


class Open:
    """Walls that block nothing."""

    def passable(self, begin: Array, end: Array) -> NDArray[np.bool_]:
        """Let all pass."""
        return np.ones(np.broadcast(begin, end).shape[0], np.bool_)


@pytest.mark.parametrize("known", [False, True])
def test_an_update_is_that_of_many_draws_from_the_prediction(hall_table_path: Path, known: bool):
    """Evidence, mean and spread between machines, where paths begin and end within a step."""
    table = told(Table.open(hall_table_path), 0.9 if known else 0.0, 5.0)
    locator, model, stdev = Locator(table), DriftModel(), math.radians(5.0)
    stations, apart = Stations(table, model), []
    for seed in range(4):
        rng = np.random.default_rng([11, seed])
        place = np.array([3.0 + 0.7 * seed, 6.0 + 2.0 * seed, 1.2])
        angles = []
        for station in table.site.stations:
            x, y, z = place - station.position
            azimuth, zenith = math.atan2(y, x), math.atan2(math.hypot(x, y), z)
            angles.append(
                Angle(station_id=station.id, azimuth=azimuth, zenith=zenith, azimuth_stdev=stdev, zenith_stdev=stdev)
            )
        measured = stations.measured(locator.fuse(Report(measurements=tuple(angles))).factors)
        assert measured is not None
        count = 4000
        particles = Particles(
            position=place + [0.8, -0.6, 0.0] + [0.4, 0.4, 0.1] * rng.standard_normal((count, 3)),
            velocity=np.zeros((count, 3)),
            velocity_variance=np.array([0.6, 0.6, 0.02]),
            drifts=no_drifts(count, rng),
        )
        if known:
            particles = with_drifts(particles, measured, model, rng)
        assert particles.drifts is not None
        updated = update_drifting(particles, measured, MotionModel(), model, 1.0, 1, Open(), rng)  # type: ignore[arg-type]
        assert updated is not None
        found = updated.particles.position

        origin = np.repeat(np.arange(count), 25)
        step = step_of(MotionModel(), particles.velocity_variance, 1.0)
        end = particles.position[origin] + np.sqrt(step.variance) * rng.standard_normal((len(origin), 3))
        log = np.zeros(len(origin))
        for each in measured:
            drift = tuple(column[origin] for column in particles.drifts.of(each.key, each.process, each.whole))
            out, uniform = np.empty((2, len(origin))), rng.random((len(origin), 2))
            chosen = tuple(np.zeros(len(origin), kind) for kind in (int, float, float, int, int))
            settle(end, tuple(each.map), each.values, drift, uniform, False, chosen, (out[0], out[1]))
            log += out[1]
        weight = np.exp(log - log.max())
        evidence = log.max() + np.log(weight.mean())
        weight /= weight.sum()
        mean = weight @ end
        variance = weight @ (end - mean) ** 2
        off = (found.mean(axis=0) - mean) / np.sqrt(variance)
        apart.append([updated.log_evidence - evidence, *off, *(found.var(axis=0) / variance - 1.0)])
    # Either draws scatter by 0.05 to 0.1 at each place.
    np.testing.assert_allclose(np.mean(apart, axis=0), 0.0, atol=0.12)


@pytest.mark.parametrize("num_steps", [2, 3])
def test_ways_to_a_known_end_are_those_of_the_motion_model(num_steps: int):
    """Against a dense Gaussian over the states at all steps."""
    model, variance, seconds = MotionModel(), np.array([0.3, 0.2, 0.05]), 0.9
    t = seconds / num_steps
    bridge = bridge_of(model, variance, seconds, num_steps)
    for axis in range(3):
        transition = np.array([[1.0, t], [0.0, 1.0]])
        noise = model.density[axis] * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
        now = np.diag([0.0, variance[axis]])
        joint = np.zeros((num_steps, num_steps))
        for k in range(num_steps):
            now = transition @ now @ transition.T + noise
            ahead = now
            for later in range(k, num_steps):
                joint[k, later] = joint[later, k] = ahead[0, 0]
                ahead = transition @ ahead
        gain = joint[:-1, -1] / joint[-1, -1]
        np.testing.assert_allclose(bridge.gain[axis], gain, rtol=1e-10)
        left = joint[:-1, :-1] - np.outer(gain, joint[-1, :-1])
        np.testing.assert_allclose(bridge.root[axis] @ bridge.root[axis].T, left, rtol=1e-9, atol=1e-15)
        assert joint[-1, -1] == pytest.approx(step_of(model, variance, seconds).variance[axis], rel=1e-12)
