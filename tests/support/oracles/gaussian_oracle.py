"""The posterior of a report on a table by hand, in closed form.

The oracle knows nothing of beams, clocks or remainders: it multiplies all densities as one Gaussian over the position
and the ray coordinates of all stations, once for each way in which measurements can be outliers.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    Angle,
    Height,
    LogRange,
    MeasuredPath,
    Measurement,
    Range,
    TimeOfArrival,
)
from tests.support.tables.hand_tables import GRID, MAX_PATH_LENGTH, ORIGIN, SIDE, WINDOW, Array, Tube

EPSILON = 0.01


class Product:
    """A product of Gaussians over one state, of which some may be divided by."""

    def __init__(self, size: int) -> None:
        self.information, self.eta, self.log_scale = np.zeros((size, size)), np.zeros(size), 0.0

    def multiply(self, rows: Array, value: Array, cov: Array, *, sign: float = 1.0) -> None:
        """Multiply by N(rows @ state; value, cov), or divide by it."""
        precision = np.linalg.inv(cov)
        self.information += sign * rows.T @ precision @ rows
        self.eta += sign * rows.T @ precision @ value
        self.log_scale -= sign * 0.5 * (value @ precision @ value + np.linalg.slogdet(2.0 * np.pi * cov)[1])

    def multiply_tube(self, state: Array, n: int, tube: Tube, angle: Angle | None) -> Array:
        """Multiply by a tube whose ray coordinates are the n-th of the state; returns their rows."""
        u = state[3 + 3 * n : 6 + 3 * n]
        coordinates = Product(3)
        terms = [(np.eye(3), tube.u_mean, tube.u_cov, 1.0)]
        if angle is not None:
            assert angle.zenith is not None
            assert angle.zenith_stdev is not None
            azimuth, zenith = GRID.centres[tube.cell]
            sine = np.sin(zenith)
            offset = np.array([sine * (angle.azimuth - azimuth), angle.zenith - zenith])
            noise = np.diag([sine * angle.azimuth_stdev, angle.zenith_stdev]) ** 2
            # The tube has its cell's window already.
            window = WINDOW**2 * np.eye(2)
            terms += [(np.eye(3)[1:], offset, noise, 1.0), (np.eye(3)[1:], np.zeros(2), window, -1.0)]
        for rows, value, cov, sign in terms:
            coordinates.multiply(rows, value, cov, sign=sign)
            self.multiply(rows @ u, value, cov, sign=sign)
        slope, place, x_cov = straightened(tube, *coordinates.integral()[1:])
        self.multiply(state[:3] - slope @ u, place, x_cov)
        return u

    def integral(self) -> tuple[float, Array, Array]:
        """Log integral, and mean and covariance of the state."""
        cov = np.asarray(np.linalg.inv(self.information), np.float64)
        mean = cov @ self.eta
        return self.log_scale + 0.5 * (mean @ self.eta + np.linalg.slogdet(2.0 * np.pi * cov)[1]), mean, cov


def straightened(tube: Tube, u_mean: Array, u_cov: Array) -> tuple[Array, Array, Array]:
    """Slope, value at u = 0 and covariance of the linear map from Gaussian u that has the widening tube's moments."""
    line, share = np.polynomial.hermite_e.hermegauss(4)  # exact up to the seventh power
    nodes = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", share, share, share).ravel() / share.sum() ** 3
    u = u_mean + nodes @ np.linalg.cholesky(u_cov).T
    d = u - tube.u_mean
    widening = (d[:, :1] * d[:, 1:] - tube.u_cov[0, 1:]) @ tube.jacobian[:, 1:].T / tube.u_mean[0]
    x = tube.x_mean + d @ tube.jacobian.T + widening
    middle = weights @ x
    slope = np.linalg.solve(u_cov, (u - u_mean).T @ (weights[:, None] * (x - middle))).T
    rest = x - middle - (u - u_mean) @ slope.T
    return slope, middle - slope @ u_mean, tube.x_cov + rest.T @ (weights[:, None] * rest)


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """What the oracle says: one candidate, and the probability of each measurement to be an outlier."""

    log_evidence: float
    lost: float
    mean: Array
    cov: Array
    outlier: Array


Pattern = tuple[tuple[str, ...], float, Array, Array]
"""What each station's measurements are, the log evidence of it, and mean and covariance of the position."""


def one_gaussian(measurement: Measurement, wide: bool) -> tuple[Measurement, float]:
    """Measurement of which the error is of the one Gaussian or of the other, and the log probability of that."""
    assert not isinstance(measurement, LogRange | MeasuredPath)
    model = measurement.error_model
    scale, share = (model.tail_scale, model.tail_share) if wide else (1.0, 1.0 - model.tail_share)
    if isinstance(measurement, Angle):
        assert measurement.zenith_stdev is not None
        azimuth_stdev, zenith_stdev = scale * measurement.azimuth_stdev, scale * measurement.zenith_stdev
        return replace(measurement, azimuth_stdev=azimuth_stdev, zenith_stdev=zenith_stdev), float(np.log(share))
    return replace(measurement, stdev=scale * measurement.stdev), float(np.log(share))


def total_stdev(measurement: Range | TimeOfArrival) -> float:
    """Give the standard deviation of the whole error."""
    model = measurement.error_model
    return float(np.sqrt(1.0 + model.tail_share * (model.tail_scale**2 - 1.0))) * measurement.stdev


def patterns_of(
    tubes: list[Tube],
    stated: Sequence[Measurement],
    measurements: Sequence[Measurement],
    log_share: float,
    log_volume: float,
    height: Height | None,
) -> list[Pattern]:
    """All ways in which measurements can be outliers, given which Gaussian each error is of."""
    num = len(tubes)
    arrivals = [m for m in measurements if isinstance(m, TimeOfArrival)]
    places = {tube.station_id: n for n, tube in enumerate(tubes)}
    angles = {places[m.station_id]: m for m in measurements if isinstance(m, Angle)}
    size = 3 + 3 * num + (1 if arrivals else 0)
    patterns: list[Pattern] = []
    for kinds in itertools.product(("good", "late", "bad"), repeat=num):
        timed: list[list[Range | TimeOfArrival]] = [[] for _ in tubes]
        log_any = np.zeros(num)
        for m, said in zip(measurements, stated, strict=True):
            if isinstance(m, Range | TimeOfArrival) and isinstance(said, Range | TimeOfArrival):
                timed[places[m.station_id]].append(m)
                log_any[places[m.station_id]] -= np.log(MAX_PATH_LENGTH + np.sqrt(2.0 * np.pi) * total_stdev(said))
        if any(kind == "late" and not (timed[n] and n in angles) for n, kind in enumerate(kinds)):
            continue
        product, log_prior, clock_known = Product(size), log_share, False
        state = np.eye(size)
        for n, (tube, kind) in enumerate(zip(tubes, kinds, strict=True)):
            if kind == "bad":
                log_prior += np.log(EPSILON) + log_any[n] - (np.log(4.0 * np.pi) if n in angles else 0.0)
                product.multiply(state[3 + 3 * n : 6 + 3 * n], np.zeros(3), np.eye(3))
                continue
            log_prior += tube.log_mass + np.log1p(-EPSILON)
            if n in angles and timed[n]:
                log_prior += np.log(EPSILON) + log_any[n] if kind == "late" else np.log1p(-EPSILON)
            u = product.multiply_tube(state, n, tube, angles.get(n))
            for m in timed[n] if kind == "good" else []:
                clock_known |= isinstance(m, TimeOfArrival)
                row = u[:1] + (state[-1:] if isinstance(m, TimeOfArrival) else 0.0)
                product.multiply(row, np.array([m.path_length]), np.array([[m.stdev**2]]))
        if all(kind == "bad" for kind in kinds):
            patterns.append((kinds, log_prior, np.full(3, np.nan), np.full((3, 3), np.nan)))
            continue
        log_prior -= log_volume
        if height is not None:
            product.multiply(state[2:3], np.array([height.z]), np.array([[height.stdev**2]]))
        if arrivals:
            log_prior -= np.log(MAX_PATH_LENGTH)
            if not clock_known:
                # Anywhere in a range of this length.
                log_prior += np.log(MAX_PATH_LENGTH)
                product.multiply(state[-1:], np.zeros(1), np.eye(1))
        log_integral, mean, cov = product.integral()
        patterns.append((kinds, log_prior + log_integral, mean[:3], cov[:3, :3]))
    return patterns


def oracle(tubes: list[Tube], measurements: Sequence[Measurement], height: Height | None = None) -> Posterior:
    """Posterior of a report with one angle and any times per station, by one big Gaussian per way errors can be."""
    log_volume = float(np.log(SIDE**3))
    if height is not None:
        inside = np.diff(norm.cdf(ORIGIN[2] + np.array([0.0, SIDE]), height.z, height.stdev))[0]
        log_volume = float(np.log(SIDE**2 * inside))
    heavy = [n for n, m in enumerate(measurements) if getattr(m, "error_model", GAUSSIAN) != GAUSSIAN]
    patterns: list[Pattern] = []
    for wide in itertools.product((False, True), repeat=len(heavy)):
        log_share, errors = 0.0, list(measurements)
        for n, is_wide in zip(heavy, wide, strict=True):
            errors[n], log_chosen = one_gaussian(measurements[n], is_wide)
            log_share += log_chosen
        patterns += patterns_of(tubes, measurements, errors, log_share, log_volume, height)
    logs = np.array([pattern[1] for pattern in patterns])
    log_evidence = float(logs.max() + np.log(np.exp(logs - logs.max()).sum()))
    weight = np.exp(logs - log_evidence)
    lost = float(sum(w for w, p in zip(weight, patterns, strict=True) if set(p[0]) == {"bad"}))
    share = [(w / (1.0 - lost), p) for w, p in zip(weight, patterns, strict=True) if set(p[0]) != {"bad"}]
    mean = np.asarray(sum(w * p[2] for w, p in share))
    cov = np.asarray(sum(w * (p[3] + np.outer(p[2] - mean, p[2] - mean)) for w, p in share))
    places = {tube.station_id: n for n, tube in enumerate(tubes)}
    outlier = np.array(
        [
            sum(
                w
                for w, p in zip(weight, patterns, strict=True)
                if p[0][places[m.station_id]] in (("bad",) if isinstance(m, Angle) else ("bad", "late"))
            )
            for m in measurements
        ]
    )
    return Posterior(log_evidence=log_evidence, lost=lost, mean=mean, cov=cov, outlier=outlier)
