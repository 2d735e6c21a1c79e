"""Path lengths of paths in a measured channel impulse response."""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rayfix_service.measuring.ranging import SPEED_OF_LIGHT, RangeEstimate
from rayfix_tables.errors import ReportError

_OVERSAMPLING = 4
"""Samples between two taps at which the response is evaluated before its maximum is refined."""

_NOISE_MARGIN = 4.0
"""A path exceeds the noise by at least this many of its standard deviations."""

_MOST_RANGE_DB = 30.0
"""Side lobes of a Hann window are weaker."""


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
    response = _Response.of(taps, sampling_rate, bandwidth, noise_power, windowed=path == "first")
    times, power = response.sampled()
    start = int(np.argmax(power))
    if path == "first":
        found = response.peaks(power, dynamic_range_db)
        start = int(found[0]) if len(found) else start
    delay, variance, _ = response.refined(float(times[start]))
    return RangeEstimate(
        path_length=SPEED_OF_LIGHT * (first_tap_delay + delay), stdev=SPEED_OF_LIGHT * math.sqrt(variance)
    )


@dataclass(frozen=True, kw_only=True)
class PathEstimate:
    """A path of an impulse response.

    Attributes
    ----------
    path_length, stdev : float, m
    power_db : float
        Power in the unit of the taps' squares, dB.
    """

    path_length: float
    stdev: float
    power_db: float


def paths_from_impulse_response(
    taps: ArrayLike,
    *,
    sampling_rate: float,
    bandwidth: float | None = None,
    noise_power: float | None = None,
    dynamic_range_db: float = 20.0,
    first_tap_delay: float = 0.0,
    most: int = 16,
) -> tuple[PathEstimate, ...]:
    """Path lengths of all paths that a channel impulse response shows, in the order of arrival.

    The paths are the maxima of the interpolated magnitude that exceed the noise by four of its standard deviations,
    with a Hann window over the band, whose side lobes are at -31 dB.

    Parameters
    ----------
    taps, sampling_rate, bandwidth, noise_power, first_tap_delay
        As of :func:`range_from_impulse_response`.
    dynamic_range_db : float
        Paths are at most this much weaker than the strongest; at most 30, where side lobes begin.
    most : int
        Paths that are returned, the strongest.

    Returns
    -------
    tuple of PathEstimate
        At least the strongest path. Standard deviations are due to noise only, as of
        :func:`range_from_impulse_response`; paths closer than about ``2 c / bandwidth`` are not told apart.

    Raises
    ------
    ReportError
        When the taps, the rates or the dynamic range are not valid.
    """
    if not 0.0 < dynamic_range_db <= _MOST_RANGE_DB:
        raise ReportError(
            f"dynamic_range_db is {dynamic_range_db}; give one above 0, and at most {_MOST_RANGE_DB:g}, where side "
            "lobes begin"
        )
    if most < 1:
        raise ReportError(f"most is {most}; give the number of paths that are wanted, at least 1")
    response = _Response.of(taps, sampling_rate, bandwidth, noise_power, windowed=True)
    times, power = response.sampled()
    starts = response.peaks(power, dynamic_range_db)
    if not len(starts):
        starts = np.array([int(np.argmax(power))])
    strongest = starts[np.argsort(-power[starts])[:most]]
    found = [response.refined(float(times[start])) for start in np.sort(strongest)]
    return tuple(
        PathEstimate(
            path_length=SPEED_OF_LIGHT * (first_tap_delay + delay),
            stdev=SPEED_OF_LIGHT * math.sqrt(variance),
            power_db=20.0 * math.log10(amplitude),
        )
        for delay, variance, amplitude in found
    )


class _Response(NamedTuple):
    """A windowed response as a spectrum.

    Attributes
    ----------
    spectrum : ndarray of shape (n,), complex
    omega : ndarray of shape (n,), rad/s
    window : ndarray of shape (n,)
    band_size : int
        Frequencies in the band.
    noise_power : float
        Of a tap.
    step : float, s
        Between the times at which it is sampled.
    """

    spectrum: NDArray[np.complex128]
    omega: NDArray[np.float64]
    window: NDArray[np.float64]
    band_size: int
    noise_power: float
    step: float

    @classmethod
    def of(
        cls,
        taps: ArrayLike,
        sampling_rate: float,
        bandwidth: float | None,
        noise_power: float | None,
        *,
        windowed: bool,
    ) -> "_Response":
        """Check what was given, and transform the taps."""
        return _transformed(taps, sampling_rate, bandwidth, noise_power, windowed=windowed)

    def sampled(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Sample the power, from one tap before the first, where noise may shift a path; give times, s, and power."""
        times = self.step * np.arange(-_OVERSAMPLING, _OVERSAMPLING * (len(self.omega) - 1))
        power = np.abs(np.exp(1j * np.outer(times, self.omega)) @ self.spectrum) ** 2
        return np.asarray(times, np.float64), np.asarray(power, np.float64)

    def peaks(self, power: NDArray[np.float64], dynamic_range_db: float) -> NDArray[np.int64]:
        """Maxima of the sampled power that are above the noise and not too weak."""
        noise = self.noise_power * float((self.window**2).sum()) / self.band_size
        least = max(_NOISE_MARGIN**2 * noise, float(power.max()) * 10.0 ** (-0.1 * dynamic_range_db))
        above = (power[1:-1] >= least) & (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
        return np.flatnonzero(above) + 1

    def refined(self, start: float) -> tuple[float, float, float]:
        """Delay of the maximum next to a time, s, its variance, s2, and the path's amplitude in units of the taps."""
        delay = _maximum(self.spectrum, self.omega, start, self.step)
        total = float(self.window.sum())
        amplitude = abs(np.exp(1j * self.omega * delay) @ self.spectrum) / total
        noise_per_bin = self.noise_power / self.band_size
        bend = float((self.window * self.omega**2).sum())
        variance = 0.5 * noise_per_bin * float((self.window**2 * self.omega**2).sum()) / (amplitude * bend) ** 2
        return delay, variance, float(amplitude) * total


def _transformed(
    taps: ArrayLike, sampling_rate: float, bandwidth: float | None, noise_power: float | None, *, windowed: bool
) -> _Response:
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
    window = band * (0.5 + 0.5 * np.cos(2.0 * np.pi * frequency / bandwidth) if windowed else 1.0)
    return _Response(
        spectrum=window * np.fft.fft(values) / count,
        omega=np.asarray(2.0 * np.pi * frequency, np.float64),
        window=window,
        band_size=int(np.count_nonzero(band)),
        noise_power=noise_power,
        step=1.0 / (sampling_rate * _OVERSAMPLING),
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
