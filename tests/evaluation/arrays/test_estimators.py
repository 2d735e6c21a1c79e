"""Estimators of directions: exact without noise, resolving what they should, at the bound where they reach it."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_evaluation.arrays.bound import cosine_bound
from rayfix_evaluation.arrays.covariance import covariance, num_sources, smoothed_covariance
from rayfix_evaluation.arrays.estimators import ESTIMATORS, delay_and_sum, esprit, music, mvdr, wave_powers
from rayfix_evaluation.arrays.planar import PlanarArray, Signal, receive, to_cosines, to_scene_direction
from rayfix_evaluation.truth.forward import Paths
from rayfix_tables.geometry.angles import direction
from rayfix_tables.site import Station

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

ARRAY = PlanarArray(columns=8, rows=6)
TWO = np.array([[0.10, 0.05], [0.10 + 0.6 * ARRAY.beam_width, 0.05]])
"""Two waves 0.6 beam widths apart."""


def exact(array: PlanarArray, cosines: Array, power: Array, noise: float) -> Complex:
    """Covariance of uncorrelated waves."""
    steering = array.steering(cosines)
    return np.asarray(steering @ np.diag(power) @ steering.conj().T + noise * np.eye(len(array)))


def draw(array: PlanarArray, cosines: Array, power: Array, count: int, rng: np.random.Generator) -> Complex:
    """Snapshots of uncorrelated random waves in noise of power 1."""
    waves = rng.standard_normal((2, len(cosines), count)) * np.sqrt(0.5)
    noise = rng.standard_normal((2, len(array), count)) * np.sqrt(0.5)
    amplitude = np.sqrt(power)[:, None] * (waves[0] + 1j * waves[1])
    return np.asarray(array.steering(cosines) @ amplitude + noise[0] + 1j * noise[1])


@pytest.mark.parametrize("name", list(ESTIMATORS))
@pytest.mark.parametrize("cosines", [(0.0, 0.0), (0.213, -0.131), (-0.7, 0.5), (0.05, 0.93)])
def test_a_plane_wave_without_noise_is_found_exactly(name: str, cosines: tuple[float, float]) -> None:
    truth = np.array([cosines])
    found = ESTIMATORS[name](exact(ARRAY, truth, np.array([2.0]), 1e-6), ARRAY, 1)
    np.testing.assert_allclose(found.cosines, truth, rtol=0, atol=1e-6)
    assert found.power[0] == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize("estimator", [mvdr, music, esprit])
def test_two_waves_within_a_beam_are_told_apart(estimator: object) -> None:
    power = np.array([1.0, 0.5])
    found = estimator(exact(ARRAY, TWO, power, 1e-4), ARRAY, 2)  # type: ignore[operator]
    np.testing.assert_allclose(found.cosines, TWO, rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.power, power, rtol=0, atol=1e-3)


def test_delay_and_sum_takes_two_waves_within_a_beam_for_one() -> None:
    found = delay_and_sum(exact(ARRAY, TWO, np.array([1.0, 1.0]), 1e-4), ARRAY, 2)
    np.testing.assert_allclose(found.cosines[0], TWO.mean(axis=0), rtol=0, atol=1e-4)
    # What comes second is a side lobe, not the other wave.
    assert np.abs(found.cosines[1:] - TWO[1]).max(initial=1.0) > 0.5 * ARRAY.beam_width
    apart = np.array([TWO[0], TWO[0] + [2.0 * ARRAY.beam_width, 0.0]])
    resolved = delay_and_sum(exact(ARRAY, apart, np.array([1.0, 1.0]), 1e-4), ARRAY, 2)
    order = np.argsort(resolved.cosines[:, 0])
    np.testing.assert_allclose(resolved.cosines[order], apart, rtol=0, atol=0.1 * ARRAY.beam_width)


def test_esprit_pairs_the_two_axes() -> None:
    """Two waves that share no cosine with the corners of their rectangle."""
    waves = np.array([[0.3, -0.4], [-0.2, 0.1], [0.3, 0.1]])
    power = np.array([3.0, 2.0, 1.0])
    found = esprit(exact(ARRAY, waves, power, 1e-6), ARRAY, 3)
    np.testing.assert_allclose(found.cosines, waves, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("name", "most"), [("MUSIC", 1.12), ("Delay-and-Sum", 1.12), ("ESPRIT", 1.6), ("MVDR", 2.2)])
def test_errors_of_one_wave_beside_the_bound(name: str, most: float) -> None:
    """200 trials: the standard error of a deviation over two axes is 3.5 %. MUSIC and the beam reach the bound."""
    rng = np.random.default_rng(3)
    truth, power, count = np.array([[0.213, -0.131]]), np.array([10.0]), 100
    found = [
        ESTIMATORS[name](covariance(draw(ARRAY, truth, power, count, rng)), ARRAY, 1).cosines[0] for _ in range(200)
    ]
    least = np.diag(cosine_bound(ARRAY, truth, power, noise=1.0, num_snapshots=count))
    ratio = np.sqrt(np.mean(np.square(np.array(found) - truth[0]) / least))
    assert 0.88 < ratio < most


def test_the_bound_of_one_wave_is_the_textbooks() -> None:
    """The variance is (1 + 1 / (M snr)) / (2 N snr times the sum of squared slopes of phase), the axes apart."""
    snr, count = 4.0, 50
    least = cosine_bound(ARRAY, np.array([[0.3, 0.2]]), np.array([snr]), noise=1.0, num_snapshots=count)
    slopes = np.square(np.pi * ARRAY.places).sum(axis=0)
    np.testing.assert_allclose(
        np.diag(least), (1.0 + 1.0 / (len(ARRAY) * snr)) / (2.0 * count * snr * slopes), rtol=1e-9
    )
    assert abs(least[0, 1]) < 1e-12


def test_smoothing_tells_copies_of_one_signal_apart() -> None:
    """Two copies a beam apart: with smoothing as if they were two signals, without it as if they were one."""
    waves = np.array([[0.3, -0.2], [0.3 - ARRAY.beam_width, -0.2]])
    rng = np.random.default_rng(5)
    copies = ARRAY.steering(waves) @ np.array([[1.0], [0.8 * np.exp(0.7j)]]) @ np.exp(2j * np.pi * rng.random((1, 40)))
    noise = 0.01 * (rng.standard_normal((len(ARRAY), 40)) + 1j * rng.standard_normal((len(ARRAY), 40)))
    part = PlanarArray(columns=5, rows=4)
    smoothed = smoothed_covariance(copies + noise, ARRAY, part)
    for estimator in (music, esprit):
        np.testing.assert_allclose(estimator(smoothed, part, 2).cosines, waves, rtol=0, atol=0.01)
    plain = covariance(copies + noise)
    assert num_sources(np.linalg.eigvalsh(plain), 40, most=6) == 1
    assert num_sources(np.linalg.eigvalsh(smoothed), 40, most=6) >= 2
    assert np.abs(esprit(plain, ARRAY, 2).cosines - waves).max() > 0.1
    with pytest.raises(ValueError, match="is not part of"):
        smoothed_covariance(copies, ARRAY, PlanarArray(columns=9, rows=4))


def test_signals_are_counted() -> None:
    rng = np.random.default_rng(6)
    waves = np.array([[0.3, -0.2], [-0.25, 0.1], [0.5, 0.6]])
    for count in (1, 2, 3):
        cov = covariance(draw(ARRAY, waves[:count], np.ones(count), 400, rng))
        assert num_sources(np.linalg.eigvalsh(cov), 400, most=6) == count
    noise = covariance(draw(ARRAY, waves[:1], np.array([1e-9]), 400, rng))
    assert num_sources(np.linalg.eigvalsh(noise), 400, most=6) == 1


def test_powers_are_those_of_the_waves() -> None:
    power = np.array([1.5, 0.2])
    np.testing.assert_allclose(wave_powers(exact(ARRAY, TWO, power, 0.3), ARRAY, TWO), power, rtol=0, atol=1e-9)


def test_cosines_and_directions_belong_together() -> None:
    """A station that is turned, tilted and slanted."""
    station = Station(id="a", position=(0.0, 0.0, 0.0), orientation=(0.7, 0.2, -0.3))
    cosines = np.array([[0.1, -0.5], [0.0, 0.0], [-0.8, 0.3]])
    vectors = to_scene_direction(station, cosines)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=1e-12)
    azimuth, zenith = np.arctan2(vectors[:, 1], vectors[:, 0]), np.arccos(vectors[:, 2])
    back, before = to_cosines(station, azimuth, zenith)
    np.testing.assert_allclose(back, cosines, rtol=0, atol=1e-12)
    assert before.all()
    assert not to_cosines(station, azimuth + np.pi, np.pi - zenith)[1].any()


def test_snapshots_have_the_phases_of_the_paths() -> None:
    """One path from 30 deg aside: the phase between columns, and between subcarriers that of 15 m."""
    station = Station(id="a", position=(0.0, 0.0, 0.0))
    signal = Signal(bandwidth=64e6, subcarriers=64, snr_db=200.0)
    snapshots = receive(ARRAY, station, paths_of([30.0, 210.0], [15.0, 10.0]), signal, np.random.default_rng(1))
    assert snapshots is not None
    np.testing.assert_allclose(np.abs(snapshots), 1e10, rtol=1e-6)
    between = snapshots.reshape(8, 6, 64)
    # The cosine along y is sin 30 deg = 1 / 2, and half a wavelength of it is a quarter turn.
    np.testing.assert_allclose(between[1:] / between[:-1], 1j, rtol=0, atol=1e-6)
    np.testing.assert_allclose(between[:, 1:] / between[:, :-1], 1.0, rtol=0, atol=1e-6)
    step = np.exp(-2j * np.pi * 1e6 * 15.0 / 299_792_458.0)
    np.testing.assert_allclose(snapshots[:, 1:] / snapshots[:, :-1], step, rtol=0, atol=1e-6)
    behind = receive(ARRAY, station, paths_of([150.0], [5.0]), signal, np.random.default_rng(1))
    assert behind is None


def paths_of(azimuths_deg: list[float], lengths: list[float]) -> Paths:
    """Level paths; only angles, lengths and gains are read."""
    count = len(lengths)
    return Paths(
        path_length=np.array(lengths),
        azimuth=np.deg2rad(azimuths_deg),
        zenith=np.full(count, 0.5 * np.pi),
        num_reflections=np.zeros(count, np.int64),
        gain_db=-20.0 * np.log10(lengths),
        vertices=np.zeros((count, 2, 3)),
        crossings=np.empty((count, 0, 3)),
        num_walls=np.zeros(count, np.int64),
    )


def test_the_beam_width_is_where_half_the_power_is_left() -> None:
    array = PlanarArray(columns=32, rows=1)
    beam = np.abs(
        array.steering(np.array([[0.0, 0.0]])).conj().T @ array.steering(np.array([[0.5 * array.beam_width, 0]]))
    )
    assert float(beam[0, 0]) ** 2 / len(array) ** 2 == pytest.approx(0.5, abs=0.005)
    np.testing.assert_allclose(direction(0.0, 0.5 * np.pi), [1, 0, 0], rtol=0, atol=1e-12)
