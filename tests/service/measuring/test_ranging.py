"""Path lengths from times, round trips, signal strengths and impulse responses."""

from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.measuring.impulse_response import paths_from_impulse_response, range_from_impulse_response
from rayfix_service.measuring.ranging import range_from_round_trip, range_from_rssi, range_from_times
from rayfix_tables.errors import ReportError

C = 299_792_458.0
RATE = 100e6  # Hz, 3 m per tap


def test_times_are_lengths() -> None:
    found = range_from_times(toa=1.0 + 40e-9, tod=1.0, stdev=2e-9)
    assert found.path_length == pytest.approx(40e-9 * C, abs=1e-7)
    assert found.stdev == pytest.approx(2e-9 * C)


def test_a_round_trip_goes_both_ways() -> None:
    found = range_from_round_trip(round_trip=250e-6 + 2 * 40e-9, reply=250e-6, stdev=2e-9)
    assert found.path_length == pytest.approx(40e-9 * C, abs=1e-7)
    assert found.stdev == pytest.approx(1e-9 * C)


def test_signal_strengths_go_back_through_the_model() -> None:
    rng = np.random.default_rng(1)
    strength = -40.0 - 10.0 * 2.4 * np.log10(7.0) + rng.normal(0.0, 5.0, 4000)
    found = [
        range_from_rssi(rssi_dbm=float(s), power_at_1m_dbm=-40.0, path_loss_exponent=2.4, shadowing_stdev_db=5.0)
        for s in strength
    ]
    logs = np.log([one.path_length for one in found])
    error = found[0].log_stdev / np.sqrt(len(logs))
    assert logs.mean() == pytest.approx(np.log(7.0), abs=4.0 * error)
    assert logs.std() == pytest.approx(found[0].log_stdev, rel=0.05)


def response(
    delays: list[float], gains: list[complex], count: int = 128, *, bandwidth: float = RATE
) -> NDArray[np.complex128]:
    """Taps of paths, by their definition: a flat band of frequencies, each path a phase."""
    frequency = np.fft.fftfreq(count, 1.0 / RATE)
    band = np.abs(frequency) <= 0.5 * bandwidth
    spectrum = sum(g * np.exp(-2j * np.pi * frequency * t) for t, g in zip(delays, gains, strict=True)) * band
    return np.asarray(np.fft.ifft(spectrum) * count / band.sum())


def noise(rng: np.random.Generator, count: int, power: float) -> NDArray[np.complex128]:
    return np.asarray(np.sqrt(0.5 * power) * (rng.standard_normal(count) + 1j * rng.standard_normal(count)))


@pytest.mark.parametrize("delay", [-0.3e-8, 0.0, 4.2e-8, 4.7e-8, 77.77e-8])
@pytest.mark.parametrize("path", ["strongest", "first"])
@pytest.mark.parametrize("bandwidth", [RATE, 0.5 * RATE])
def test_the_delay_of_one_path_is_exact(delay: float, path: Literal["strongest", "first"], bandwidth: float) -> None:
    taps = response([delay], [0.3 - 0.4j], bandwidth=bandwidth)
    found = range_from_impulse_response(
        taps, sampling_rate=RATE, path=path, bandwidth=bandwidth, noise_power=1e-8, first_tap_delay=5e-8
    )
    assert found.path_length == pytest.approx(C * (delay + 5e-8), abs=1e-5)  # m, of 3 m a tap


def test_the_first_path_comes_before_the_strongest() -> None:
    taps = response([10.3e-8, 31.6e-8], [0.2, 1.0j])
    strongest = range_from_impulse_response(taps, sampling_rate=RATE, noise_power=1e-8)
    first = range_from_impulse_response(taps, sampling_rate=RATE, noise_power=1e-8, path="first")
    assert strongest.path_length == pytest.approx(31.6e-8 * C, abs=0.1)  # m: each disturbs the other
    assert first.path_length == pytest.approx(10.3e-8 * C, abs=0.1)
    deaf = range_from_impulse_response(taps, sampling_rate=RATE, noise_power=1e-8, path="first", dynamic_range_db=10.0)
    assert deaf.path_length == pytest.approx(31.6e-8 * C, abs=0.1)


@pytest.mark.parametrize("path", ["strongest", "first"])
@pytest.mark.parametrize("bandwidth", [RATE, 0.5 * RATE])
def test_the_deviation_is_that_of_many_draws(path: Literal["strongest", "first"], bandwidth: float) -> None:
    rng = np.random.default_rng(3)
    clean, power = response([20.37e-8], [1.0], bandwidth=bandwidth), 10.0**-2.5
    in_band = np.abs(np.fft.fftfreq(128, 1.0 / RATE)) <= 0.5 * bandwidth
    found = []
    for _ in range(400):
        white = np.fft.ifft(np.fft.fft(noise(rng, 128, power)) * in_band) * np.sqrt(128 / in_band.sum())
        found.append(
            range_from_impulse_response(
                clean + white, sampling_rate=RATE, path=path, bandwidth=bandwidth, noise_power=power
            )
        )
    lengths = np.array([one.path_length for one in found])
    stdev = float(np.mean([one.stdev for one in found]))
    assert lengths.mean() == pytest.approx(20.37e-8 * C, abs=4.0 * stdev / 20.0)
    # A deviation of 400 draws strays by 3.5 %.
    assert stdev == pytest.approx(lengths.std(), rel=0.12)
    if path == "strongest":
        bound = C * np.sqrt(12.0 * power / (8.0 * np.pi**2)) / bandwidth
        assert lengths.std() == pytest.approx(bound, rel=0.12)


def test_all_paths_come_in_the_order_of_arrival() -> None:
    """Four taps apart or more, where side lobes are below -31 dB of each other."""
    delays, gains = [10.3e-8, 31.6e-8, 50.0e-8], [0.2 + 0.0j, 1.0j, -0.3 + 0.0j]
    found = paths_from_impulse_response(response(delays, gains), sampling_rate=RATE, noise_power=1e-8)
    assert [one.path_length for one in found] == pytest.approx([C * t for t in delays], abs=0.1)
    assert np.diff([one.power_db for one in found]) == pytest.approx([14.0, -10.5], abs=0.3)  # dB: each disturbs others
    strongest = paths_from_impulse_response(response(delays, gains), sampling_rate=RATE, noise_power=1e-8, most=2)
    assert strongest == found[1:]
    near = paths_from_impulse_response(
        response(delays, gains), sampling_rate=RATE, noise_power=1e-8, dynamic_range_db=12.0, first_tap_delay=1e-8
    )
    assert [one.path_length for one in near] == pytest.approx([one.path_length + 1e-8 * C for one in found[1:]])


def test_noise_is_hardly_ever_a_path() -> None:
    """Of four deviations above it one sample in ten million is; the weak path's deviation is that of many draws."""
    rng, power = np.random.default_rng(6), 10.0**-3.5
    clean = response([20.37e-8, 60.0e-8], [1.0, 0.4])
    found = [
        paths_from_impulse_response(clean + noise(rng, 128, power), sampling_rate=RATE, noise_power=power)
        for _ in range(200)
    ]
    assert all(len(paths) == 2 for paths in found)
    lengths = np.array([paths[1].path_length for paths in found])
    assert np.mean([paths[1].stdev for paths in found]) == pytest.approx(lengths.std(), rel=0.16)


@pytest.mark.parametrize("options", [{"dynamic_range_db": 0.0}, {"dynamic_range_db": 31.0}, {"most": 0}])
def test_bad_settings_of_paths_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ReportError, match="give"):
        paths_from_impulse_response(response([1e-8], [1.0]), sampling_rate=RATE, **options)  # type: ignore[arg-type]


def test_the_noise_is_estimated_from_the_taps_between_the_paths() -> None:
    """To a third: side lobes of the path, too, are between the paths."""
    taps = response([20.37e-8], [1.0]) + noise(np.random.default_rng(4), 128, 10.0**-2.5)
    guessed = range_from_impulse_response(taps, sampling_rate=RATE)
    known = range_from_impulse_response(taps, sampling_rate=RATE, noise_power=10.0**-2.5)
    assert guessed.path_length == known.path_length
    assert guessed.stdev == pytest.approx(known.stdev, rel=0.35)
    assert guessed.stdev != known.stdev


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"taps": [1.0] * 4}, "at least 8"),
        ({"taps": np.ones((4, 4))}, "in one row"),
        ({"taps": [0.0] * 16}, "zero or not finite"),
        ({"taps": [np.nan] * 16}, "zero or not finite"),
        ({"sampling_rate": 0.0}, "positive rate"),
        ({"bandwidth": 2e8}, "between 0 and the sampling rate"),
        ({"noise_power": 0.0}, "noise_power"),
        ({"taps": [1.0] + [0.0] * 15}, "noise_power"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, Any], words: str) -> None:
    given: dict[str, Any] = {"taps": np.exp(1j * np.arange(16)), "sampling_rate": RATE, **changes}
    with pytest.raises(ReportError, match=words):
        range_from_impulse_response(given.pop("taps"), **given)
