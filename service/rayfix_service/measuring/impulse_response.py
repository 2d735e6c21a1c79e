"""The path length of a path in a measured channel impulse response."""

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rayfix_service.measuring.ranging import SPEED_OF_LIGHT, RangeEstimate
from rayfix_tables.errors import ReportError

_OVERSAMPLING = 4
"""Samples between two taps at which the response is evaluated before its maximum is refined."""

_NOISE_MARGIN = 4.0
"""A first path exceeds the noise by at least this many of its standard deviations."""


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

    The taps are interpolated as samples of a band-limited, periodic signal, which is exact for an OFDM receiver. The
    delay is a maximum of its magnitude. The search for the first path uses a Hann window over the band, with side lobes
    at -31 dB; without a window, side lobes at -13 dB would be mistaken for paths.

    Parameters
    ----------
    taps : array_like of shape (n,), complex
        The first at ``first_tap_delay``, the others every ``1 / sampling_rate``; at least 8.
    sampling_rate : float, Hz
    path : {"strongest", "first"}
        Choose the one that the table's path prior assumes: ``"power"`` prefers the strongest.
    bandwidth : float, Hz, optional
        Bandwidth of the signal, centred in the sampled band; by default the sampling rate.
    noise_power : float, optional
        Mean of ``|noise|^2`` of a tap; by default estimated from the median tap, which requires that most taps have no
        path.
    dynamic_range_db : float
        A first path is at most this much weaker than the strongest.
    first_tap_delay : float, s

    Returns
    -------
    RangeEstimate
        Its standard deviation is due to noise only. Paths whose lengths differ by less than about ``c / bandwidth``
        interfere and cause larger errors; add the known error of your receiver.

    Raises
    ------
    ReportError
        When the taps or the rates are not valid.

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
        # The squares of complex Gaussian noise are exponentially distributed: the median is the mean times log 2.
        noise_power = float(np.median(np.abs(values) ** 2)) / math.log(2.0)
    if not (math.isfinite(noise_power) and noise_power > 0.0):
        raise ReportError(f"noise_power is {noise_power}; give the mean power of the noise of a tap")
    count = len(values)
    frequency = np.fft.fftfreq(count, 1.0 / sampling_rate)
    band = np.abs(frequency) <= 0.5 * bandwidth
    window = band * (1.0 if path == "strongest" else 0.5 + 0.5 * np.cos(2.0 * np.pi * frequency / bandwidth))
    spectrum, omega = window * np.fft.fft(values) / count, np.asarray(2.0 * np.pi * frequency, np.float64)
    step = 1.0 / (sampling_rate * _OVERSAMPLING)
    # The search begins one tap before the first, where noise may shift a path.
    times = step * np.arange(-_OVERSAMPLING, _OVERSAMPLING * (count - 1))
    power = np.abs(np.exp(1j * np.outer(times, omega)) @ spectrum) ** 2
    start = int(np.argmax(power))
    if path == "first":
        noise = noise_power * float((window**2).sum()) / np.count_nonzero(band)
        least = max(_NOISE_MARGIN**2 * noise, float(power[start]) * 10.0 ** (-0.1 * dynamic_range_db))
        above = (power[1:-1] >= least) & (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
        start = int(np.flatnonzero(above)[0]) + 1 if above.any() else start
    delay = _maximum(spectrum, omega, float(times[start]), step)
    # Noise at one frequency, and the path's amplitude there; both in units of the taps.
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
    """Time of the maximum of a signal's magnitude, by Newton's method from a nearby start, s."""
    time = start
    for _ in range(20):
        turned = np.exp(1j * omega * time) * spectrum
        value, slope, bend = turned.sum(), (1j * omega * turned).sum(), (-(omega**2) * turned).sum()
        first = (np.conj(value) * slope).real
        second = abs(slope) ** 2 + (np.conj(value) * bend).real
        # Where the magnitude is not concave: uphill by half of the remaining interval.
        step = -first / second if second < 0.0 else math.copysign(0.5 * reach, first)
        moved = min(max(time + step, start - reach), start + reach)
        if abs(moved - time) <= 1e-9 * reach:
            break
        time = moved
    return float(time)
