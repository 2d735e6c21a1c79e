"""How the errors of a station hang together over time: a part that drifts, and scatter.

Of the variance of a measured angle or length a share belongs to a stationary Gauss-Markov process, the drift, and the
rest to scatter, independent from report to report. Within a time t the drift d becomes

    d' = rho d + e,   rho = exp(-t / tau),   var(e) = (1 - rho^2) share variance

(Bar-Shalom, Li, Kirubarajan, 2001, 8.2). Given where a particle went and which paths were measured, the drifts of
azimuth, zenith and length of each station are Gaussian: a particle carries their means and variances
(Rao-Blackwellised), as it does the velocity's. What share and what correlation time there are, nobody knows unless the
site file tells: each particle assumes one of a few kinds of error, and reports tell which particles live on.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.site import Station
from rayfix_tables.validation.limits import Limits, check_limits

NUM_KINDS = 3
"""Kinds of error that particles may assume: independent, and two kinds of drift."""

_MOST_SHARE = 0.99
"""Some scatter is left, or a single report would tell the drift exactly."""

_MOST_SECONDS = 5.0
"""Longer correlation times count as this one.

Particles are too few to hold for long what they know of a drift. With drifts for ever 512 of them, without a bound, put
20 % of the targets into the 90 % circle at ten reports a second; with 10 s the error still grew with the rate by 5 %.
"""

_KEPT = 5.0
"""Correlation times after which nothing is left of a drift."""

Array = NDArray[np.float64]
Key = tuple[str, int]
Positive = Annotated[float, Limits(above=0.0)]
Share = Annotated[float, Limits(least=0.0, most=1.0)]


@dataclass(frozen=True, kw_only=True)
class DriftModel:
    """What is assumed of errors where the site file does not tell: independent, or one of two kinds of drift.

    At first a third of a target's particles assumes each.

    Attributes
    ----------
    share, correlation_s : float, s
        First kind: the drift's share of a measurement's variance, and the time in which its correlation falls to 37 %.
        More than 5 s count as 5 s.
    long_share, long_correlation_s : float, s
        Second kind.
    change_s : float, s
        Mean time after which a particle assumes another kind.
    max_stations : int
        Stations of which a target's drifts are kept, 24 bytes for each particle; of more, those heard longest ago are
        forgotten.

    Raises
    ------
    SettingsError
        When a value is out of its range.
    """

    share: Share = 0.5
    correlation_s: Positive = 2.0
    long_share: Share = 0.9
    long_correlation_s: Positive = 5.0
    change_s: Positive = 60.0
    max_stations: Annotated[int, Limits(least=1)] = 16

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_limits(self)

    def of(self, station: Station) -> "Process":
        """Shares and correlation times of a station's errors for each kind: the same for all if its site file tells."""
        found = station.deviations
        if found is not None and found.correlated_share is not None:
            seconds = self.correlation_s if found.correlation_time is None else found.correlation_time
            shares, times = [found.correlated_share] * NUM_KINDS, [seconds] * NUM_KINDS
        else:
            shares = [0.0, self.share, self.long_share]
            times = [self.correlation_s, self.correlation_s, self.long_correlation_s]
        return Process(
            share=np.minimum(np.array(shares, np.float64), _MOST_SHARE),
            seconds=np.minimum(np.array(times, np.float64), _MOST_SECONDS),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Process:
    """Share and correlation time [s] of a station's errors for each kind, shape (num_kinds,)."""

    share: Array
    seconds: Array


def variance_factor(stations: Sequence[Station], model: DriftModel, seconds: float, ratio: float) -> float:
    """By how much to widen a report that is taken for a Gaussian, since its error is correlated with the track's.

    Two estimates of variances p and 1 whose errors have the covariance c have together the variance
    ``(p - c^2) / (p + 1 - 2 c)``. Taken for independent, the second one must be wider by ``p (p - c^2) / (p - c)^2``
    for that. The track's error is, at worst, the drift of the report before: ``c = rho share min(p, 1)``. So reports in
    quick succession add next to nothing to a track that is as good as they are, and count in full where the target may
    have moved. Of several stations the largest factor counts.

    Parameters
    ----------
    stations : sequence of Station
        Of the report.
    seconds : float
        Since the report before.
    ratio : float
        Variance p of the track's prediction, in that of the report.
    """
    largest = 1.0
    for station in stations:
        process = model.of(station)
        share, time = float(process.share[1]), float(process.seconds[1])
        common = share * math.exp(-seconds / time) * min(ratio, 1.0)
        largest = max(largest, ratio * (ratio - common**2) / (ratio - common) ** 2)
    return largest


@dataclass(frozen=True, kw_only=True, eq=False)
class Drifts:
    """Drifts of the stations that a target was heard by, as the particles know them.

    Attributes
    ----------
    kind : ndarray of int8, shape (n,)
        Kind of error that each particle assumes.
    stations : tuple of (str, int)
        Stations and numbers of their paths in a report. The one heard longest ago comes first.
    ages : tuple of float, s
        Time since each was heard.
    mean, variance : ndarray of float32, shape (n, n_stations, 3)
        Of the drifts of azimuth [rad], zenith [rad] and path length [m]. The variance is NaN where nothing is known.
    """

    kind: NDArray[np.int8]
    stations: tuple[Key, ...]
    ages: tuple[float, ...]
    mean: NDArray[np.float32]
    variance: NDArray[np.float32]

    def those(self, origin: NDArray[np.int64]) -> "Drifts":
        """Return the drifts of some particles."""
        return Drifts(
            kind=self.kind[origin],
            stations=self.stations,
            ages=self.ages,
            mean=self.mean[origin],
            variance=self.variance[origin],
        )

    def aged(self, seconds: float, model: DriftModel, rng: np.random.Generator) -> "Drifts":
        """Let time pass: old drifts are forgotten, and some particles change their kind and know nothing any more."""
        count = len(self.kind)
        change = rng.random(count) < -math.expm1(-seconds / model.change_s)
        kind = np.where(change, rng.integers(NUM_KINDS, size=count), self.kind).astype(np.int8)
        ages = [age + seconds for age in self.ages]
        kept = [n for n, age in enumerate(ages) if age < _KEPT * _MOST_SECONDS]
        variance = self.variance[:, kept]
        variance[change] = np.nan
        return Drifts(
            kind=kind,
            stations=tuple(self.stations[n] for n in kept),
            ages=tuple(ages[n] for n in kept),
            mean=self.mean[:, kept],
            variance=variance,
        )

    def of(self, station: Key, process: Process, whole: Array) -> tuple[Array, Array, Array]:
        """Predict the drifts of a station.

        Parameters
        ----------
        station : (str, int)
        process : Process
        whole : ndarray of shape (3,)
            Variances of its measurements, drift and scatter together: azimuth and zenith [rad2], length [m2].

        Returns
        -------
        mean, variance : ndarray of shape (n, 3)
        share : ndarray of shape (n,)
        """
        share = process.share[self.kind]
        stationary = share[:, None] * whole
        if station not in self.stations:
            return np.zeros_like(stationary), stationary, share
        n = self.stations.index(station)
        rho = np.exp(-self.ages[n] / process.seconds[self.kind])[:, None]
        variance = self.variance[:, n].astype(np.float64)
        known = np.isfinite(variance)
        mean = np.where(known, rho * self.mean[:, n], 0.0)
        return mean, np.where(known, rho**2 * variance + (1.0 - rho**2) * stationary, stationary), share

    def heard(self, found: Sequence[tuple[Key, Array, Array]], most: int) -> "Drifts":
        """Put in the drifts of stations that were just heard: name, means and variances of shape (n, 3)."""
        new = {name: (mean, variance) for name, mean, variance in found}
        old = [n for n, name in enumerate(self.stations) if name not in new]
        old = old[max(0, len(old) + len(new) - most) :]
        names = list(new)[-most:]
        added = np.array([new[name] for name in names], np.float32).reshape(len(names), 2, len(self.kind), 3)
        return Drifts(
            kind=self.kind,
            stations=(*(self.stations[n] for n in old), *names),
            ages=(*(self.ages[n] for n in old), *([0.0] * len(names))),
            mean=np.concatenate([self.mean[:, old], added[:, 0].transpose(1, 0, 2)], axis=1),
            variance=np.concatenate([self.variance[:, old], added[:, 1].transpose(1, 0, 2)], axis=1),
        )

    def in_order(self, stations: Sequence[Key]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Means and variances of stations in an order, nothing known of those that are missing."""
        mean = np.zeros((len(self.kind), len(stations), 3), np.float32)
        variance = np.full_like(mean, np.nan)
        for n, name in enumerate(stations):
            if name in self.stations:
                at = self.stations.index(name)
                mean[:, n], variance[:, n] = self.mean[:, at], self.variance[:, at]
        return mean, variance


def no_drifts(count: int, rng: np.random.Generator) -> Drifts:
    """Drifts of new particles: nothing is known, and each kind has as many."""
    kind = rng.permutation(np.arange(count) % NUM_KINDS).astype(np.int8)
    nothing = np.empty((count, 0, 3), np.float32)
    return Drifts(kind=kind, stations=(), ages=(), mean=nothing, variance=nothing)


def joined(first: Drifts, second: Drifts) -> Drifts:
    """Drifts of two lots of particles, those of the first's stations."""
    mean, variance = second.in_order(first.stations)
    return Drifts(
        kind=np.concatenate([first.kind, second.kind]),
        stations=first.stations,
        ages=first.ages,
        mean=np.concatenate([first.mean, mean]),
        variance=np.concatenate([first.variance, variance]),
    )
