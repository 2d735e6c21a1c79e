"""What particles know of drifts over time, and what is assumed of stations."""

from dataclasses import replace

import numpy as np
import pytest

from rayfix_service.tracking.drift import NUM_KINDS, DriftModel, joined, no_drifts, variance_factor
from rayfix_tables.site import Deviations, Station

STATION = Station(id="a", position=(0.0, 0.0, 2.0))
WHOLE = np.array([0.04, 0.01, 0.25])
COUNT = 600


def told(share: float | None, seconds: float | None) -> Station:
    return replace(STATION, deviations=Deviations(correlated_share=share, correlation_time=seconds))


def test_the_site_file_decides_for_all_particles():
    model = DriftModel()
    found = model.of(told(0.7, 3.0))
    np.testing.assert_array_equal(found.share, [0.7] * NUM_KINDS)
    np.testing.assert_array_equal(found.seconds, [3.0] * NUM_KINDS)
    assert not model.of(told(0.0, None)).share.any()
    # All of the variance, for ever: some scatter is left, and the time is bounded.
    assert model.of(told(1.0, 1e6)).share.max() < 1.0
    assert model.of(told(1.0, 1e6)).seconds.max() == 5.0
    unknown = model.of(STATION)
    np.testing.assert_array_equal(unknown.share, [0.0, model.share, model.long_share])
    np.testing.assert_array_equal(model.of(told(None, 3.0)).share, unknown.share)


def test_a_drift_that_nobody_heard_of_is_stationary():
    model = DriftModel()
    drifts = no_drifts(COUNT, np.random.default_rng(1))
    mean, variance, share = drifts.of(("a", 0), model.of(STATION), WHOLE)
    assert [np.count_nonzero(share == value) for value in (0.0, model.share, model.long_share)] == [COUNT // 3] * 3
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_allclose(variance, share[:, None] * WHOLE, rtol=1e-12)


def test_time_takes_a_known_drift_back_to_the_stationary_one():
    """Against the closed form of the process, within float32; in one step or in two."""
    model, process = DriftModel(change_s=1e9), DriftModel().of(told(0.5, 2.0))
    rng = np.random.default_rng(2)
    known = 0.1 * rng.normal(size=(COUNT, 3)), rng.uniform(0.0, 0.002, (COUNT, 3))
    drifts = no_drifts(COUNT, rng).heard([(("a", 0), *known)], 16)
    mean, variance, _ = drifts.aged(0.7, model, rng).aged(0.6, model, rng).of(("a", 0), process, WHOLE)
    np.testing.assert_allclose(mean, np.exp(-0.65) * known[0], rtol=1e-6)
    expected = np.exp(-1.3) * known[1] + (1.0 - np.exp(-1.3)) * 0.5 * WHOLE
    np.testing.assert_allclose(variance, expected, rtol=1e-6)


def test_particles_that_change_their_mind_know_nothing():
    model, rng = DriftModel(change_s=1.0), np.random.default_rng(3)
    known = np.ones((COUNT, 3)), np.full((COUNT, 3), 1e-6)
    drifts = no_drifts(COUNT, rng).heard([(("a", 0), *known)], 16).aged(0.5, model, rng)
    mean, variance, share = drifts.of(("a", 0), model.of(STATION), WHOLE)
    forgot = mean[:, 0] == 0.0
    # Of 600 by a probability of 0.39, five standard errors.
    assert forgot.mean() == pytest.approx(1.0 - np.exp(-0.5), abs=0.1)
    np.testing.assert_allclose(variance[forgot], share[forgot, None] * WHOLE, rtol=1e-12)


def test_memory_is_bounded_and_what_was_heard_longest_ago_goes_first():
    model, rng = DriftModel(max_stations=3, change_s=1e9), np.random.default_rng(4)
    drifts = no_drifts(COUNT, rng)
    for n in range(50):
        new = np.full((COUNT, 3), float(n)), np.full((COUNT, 3), 0.1)
        drifts = drifts.aged(0.1, model, rng).heard([((f"s{n}", 0), *new)], model.max_stations)
        assert drifts.mean.nbytes + drifts.variance.nbytes <= 3 * 24 * COUNT
    assert drifts.stations == (("s47", 0), ("s48", 0), ("s49", 0))
    np.testing.assert_array_equal(drifts.mean[0, :, 0], [47.0, 48.0, 49.0])
    many = [((f"t{n}", 0), *new) for n in range(5)]
    assert drifts.heard(many, 3).stations == (("t2", 0), ("t3", 0), ("t4", 0))
    assert drifts.aged(24.0, model, rng).stations == drifts.stations
    assert drifts.aged(26.0, model, rng).stations == ()


def test_newborn_particles_know_what_their_report_told():
    rng = np.random.default_rng(5)
    one, two = np.full((4, 3), 1.0), np.full((4, 3), 2.0)
    track = no_drifts(4, rng).heard([(("a", 0), one, one), (("b", 0), one, one)], 16)
    newborn = no_drifts(4, rng).heard([(("b", 0), two, two)], 16)
    both = joined(track.those(np.array([0, 1])), newborn.those(np.array([3])))
    np.testing.assert_array_equal(both.mean[:, 1, 0], [1.0, 1.0, 2.0])
    assert np.isnan(both.variance[:, 0, 0]).tolist() == [False, False, True]


def test_a_report_that_is_widened_tells_what_a_correlated_one_does():
    """Best linear estimate of two numbers with correlated errors, by their covariance matrix."""
    model = DriftModel()
    for ratio in (0.2, 1.0, 3.0, 50.0):
        for seconds, share, time in ((0.1, 0.8, 0.9), (0.5, 0.3, 0.4), (2.0, 0.9, 5.0)):
            found = variance_factor([told(0.1, 0.1), told(share, time)], model, seconds, ratio)
            common = share * np.exp(-seconds / time) * min(ratio, 1.0)
            inverse = np.linalg.inv(np.array([[ratio, common], [common, 1.0]]))
            assert 1.0 / (1.0 / ratio + 1.0 / found) == pytest.approx(1.0 / inverse.sum(), rel=1e-9)
    assert variance_factor([told(0.0, None)], model, 0.1, 1.0) == 1.0
    assert variance_factor([], model, 0.1, 1.0) == 1.0
    assert variance_factor([STATION], model, 0.1, 1e6) == pytest.approx(1.0, abs=1e-5)
