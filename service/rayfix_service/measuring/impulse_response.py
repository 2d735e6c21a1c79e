"""The path length of a path in a measured channel impulse response."""

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rayfix_service.measuring.ranging import SPEED_OF_LIGHT, RangeEstimate
from rayfix_tables.errors import ReportError

_OVERSAMPLING = 4
"""Places between two taps at which the response is looked at before its maximum is found exactly."""

_NOISE_MARGIN = 4.0
"""A first path stands out of the noise by at least this many of its standard deviations."""


def range_from_impulse_response(
    taps: ArrayLike,
    *,
    sampling_rate: float,
    path: Literal["strongest", "first"] = "strongest",
    bandwidth: float | None = None,
    noise_power: float | None = None,
    dynamic_range_db: float = 20.0,
    first_tap_delay: float = 0.0,
) -> RangeEstimate:
    """Path length of the strongest or the first path of a channel impulse response.

    The taps are interpolated as the band-limited, periodic signal that they are samples of (an OFDM receiver's are
    exactly that), and the delay is where its magnitude has a maximum. The first path is looked for with a Hann window
    over the band, whose side lobes are 31 dB down; those of the bare band, 13 dB down, would pass for paths.

    Parameters
    ----------
    taps : array_like of shape (n,), complex
        The first at ``first_tap_delay``, the others every ``1 / sampling_rate``; at least 8.
    sampling_rate : float, Hz
    path : {"strongest", "first"}
        Whichever the table's path prior speaks of: ``"power"`` prefers the strongest.
    bandwidth : float, Hz, optional
        Of the signal, about the middle of the sampled band; the sampling rate when left out.
    noise_power : float, optional
        Mean of ``|noise|^2`` of a tap; estimated from the median tap when left out, which needs more taps without paths
        than with.
    dynamic_range_db : float
        A first path is at most this much weaker than the strongest.
    first_tap_delay : float, s

    Returns
    -------
    RangeEstimate
        Its deviation is that of the noise alone: paths that arrive within about ``c / bandwidth`` of each other disturb
        one another by more, for which add what your receiver is known for.

    Raises
    ------
    ReportError
        When the taps or the rates cannot be.

    Notes
    -----
    To first order an error of the maximum is ``-Re(n' conj(g)) / Re(g'' conj(g))`` with the windowed response g and its
    noise n; without a window its variance is the Cramer-Rao bound ``1 / (8 pi^2 SNR B^2 / 12)``.
    """
    values = _checked_taps(taps)
    if not (math.isfinite(sampling_rate) and sampling_rate > 0.0):
        raise ReportError(f"sampling_rate is {sampling_rate}; give a positive rate in hertz")
    bandwidth = sampling_rate if bandwidth is None else bandwidth
    if not 0.0 < bandwidth <= sampling_rate:
        raise ReportError(
            f"bandwidth is {bandwidth:g} Hz; give one between 0 and the sampling rate, {sampling_rate:g} Hz"
        )
    if noise_power is None:
        # Of complex Gaussian noise the squares are exponential: their median is log 2 of their mean.
        noise_power = float(np.median(np.abs(values) ** 2)) / math.log(2.0)
    if not (math.isfinite(noise_power) and noise_power > 0.0):
        raise ReportError(f"noise_power is {noise_power}; give the mean power of the noise of a tap")
    count = len(values)
    frequency = np.fft.fftfreq(count, 1.0 / sampling_rate)
    band = np.abs(frequency) <= 0.5 * bandwidth
    window = band * (1.0 if path == "strongest" else 0.5 + 0.5 * np.cos(2.0 * np.pi * frequency / bandwidth))
    spectrum, omega = window * np.fft.fft(values) / count, np.asarray(2.0 * np.pi * frequency, np.float64)
    step = 1.0 / (sampling_rate * _OVERSAMPLING)
    # From one tap before the first: noise may push a path there.
    times = step * np.arange(-_OVERSAMPLING, _OVERSAMPLING * (count - 1))
    power = np.abs(np.exp(1j * np.outer(times, omega)) @ spectrum) ** 2
    start = int(np.argmax(power))
    if path == "first":
        noise = noise_power * float((window**2).sum()) / np.count_nonzero(band)
        least = max(_NOISE_MARGIN**2 * noise, float(power[start]) * 10.0 ** (-0.1 * dynamic_range_db))
        above = (power[1:-1] >= least) & (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
        start = int(np.flatnonzero(above)[0]) + 1 if above.any() else start
    delay = _maximum(spectrum, omega, float(times[start]), step)
    # The noise of a frequency, and the amplitude of the path in it; both in units of the taps.
    noise_per_bin = noise_power / np.count_nonzero(band)
    amplitude = abs(np.exp(1j * omega * delay) @ spectrum) / float(window.sum())
    bend = float((window * omega**2).sum())
    variance = 0.5 * noise_per_bin * float((window**2 * omega**2).sum()) / (amplitude * bend) ** 2
    return RangeEstimate(
        path_length=SPEED_OF_LIGHT * (first_tap_delay + delay), stdev=SPEED_OF_LIGHT * math.sqrt(variance)
    )


def _checked_taps(taps: ArrayLike) -> NDArray[np.complex128]:
    values = np.asarray(taps, dtype=np.complex128)
    if values.ndim != 1 or len(values) < 8:
        raise ReportError(f"the taps have the shape {values.shape}; give at least 8 in one row")
    if not np.isfinite(values).all() or not values.any():
        raise ReportError("the taps are zero or not finite; give complex amplitudes")
    return values


def _maximum(spectrum: NDArray[np.complex128], omega: NDArray[np.float64], start: float, reach: float) -> float:
    """Time at which the magnitude of a signal has its maximum, by Newton's steps from nearby, s."""
    time = start
    for _ in range(20):
        turned = np.exp(1j * omega * time) * spectrum
        value, slope, bend = turned.sum(), (1j * omega * turned).sum(), (-(omega**2) * turned).sum()
        first = (np.conj(value) * slope).real
        second = abs(slope) ** 2 + (np.conj(value) * bend).real
        # Where the magnitude is not concave, uphill by half of what there is left.
        step = -first / second if second < 0.0 else math.copysign(0.5 * reach, first)
        moved = min(max(time + step, start - reach), start + reach)
        if abs(moved - time) <= 1e-9 * reach:
            break
        time = moved
    return float(time)
