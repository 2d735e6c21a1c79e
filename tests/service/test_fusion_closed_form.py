"""Whole fixes on hand-made tables, which have a closed form.

Each station's cells are empty but for those given; a cell holds one tube, that of the line of sight::

    y       o b (6, 14)
    |
    |           x UE (9, 8)              seen from above, in the middle of a free cube of 64 m;
    |                                    the stations 1.2 m above the UE
    |      o a (5, 3)
    |___________________o c (16, 2)__ x

The oracle knows nothing of beams, clocks or remainders: it multiplies all densities as one Gaussian over the position
and the ray coordinates of all stations, once for each way in which measurements can be outliers.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from rayfix_service.fusion.locator import Locator
from rayfix_service.fusion.report import (
    GAUSSIAN,
    HEAVY_TAILED,
    Angle,
    ErrorModel,
    Fix,
    Height,
    LogRange,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.angles import angles_of, direction
from rayfix_tables.errors import ReportError
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import Level
from rayfix_tables.mixture import TubeMixture, pack
from rayfix_tables.site import SiteInfo, Station, StationBias
from rayfix_tables.table import Table
from rayfix_tables.write import SceneContent, StationContent, write_table

Array = NDArray[np.float64]

WINDOW = float(np.deg2rad(5.0))
GRID = AngularGrid.from_spacing(WINDOW / 0.8)
MAX_PATH_LENGTH = 40.0
SIDE = 64
ORIGIN = np.array([-23.0, -24.0, -30.8])
POSITIONS = {"a": (5.0, 3.0, 2.4), "b": (6.0, 14.0, 2.4), "c": (16.0, 2.0, 2.4)}
UE = np.array([9.0, 8.0, 1.2])
EPSILON = 0.01


@dataclass(frozen=True, kw_only=True)
class Tube:
    """The line of sight from a station to a place, as a cell's one component, in the numbers of the table."""

    station_id: str
    cell: int
    log_mass: float
    u_mean: Array
    u_cov: Array
    x_mean: Array
    jacobian: Array
    x_cov: Array


def line_of_sight(
    station_id: str, place: Array = UE, *, length_stdev: float = 2.0, log_mass: float = 1.0, width: float = 0.05
) -> Tube:
    """Tube from a station through a place, as long as the deviation says and as wide as its cell's window."""
    apart = place - np.array(POSITIONS[station_id])
    azimuth, zenith = angles_of(apart)
    cell = int(GRID.nearest(azimuth, zenith))
    centre_azimuth, centre_zenith = GRID.centres[cell]
    offset = np.array([np.sin(centre_zenith) * (azimuth - centre_azimuth), zenith - centre_zenith])
    length = np.linalg.norm(apart)
    along = direction(azimuth, zenith)
    sideways = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]) * np.sin(zenith) / np.sin(centre_zenith)
    down = direction(azimuth, zenith + 0.5 * np.pi)
    deviations = np.array([length_stdev, 0.7 * WINDOW, 0.8 * WINDOW])
    correlation = np.array([[1.0, 0.1, -0.2], [0.1, 1.0, 0.05], [-0.2, 0.05, 1.0]])

    def stored(values: Array) -> Array:
        return np.asarray(np.asarray(values, np.float32), np.float64)

    return Tube(
        station_id=station_id,
        cell=cell,
        log_mass=log_mass,
        u_mean=stored(np.array([length, *offset])),
        u_cov=stored(correlation * np.multiply.outer(deviations, deviations)),
        x_mean=stored(place),
        jacobian=stored(np.stack([along, length * sideways, length * down], axis=-1)),
        x_cov=stored(width**2 * np.array([[1.0, 0.2, 0.0], [0.2, 1.5, 0.1], [0.0, 0.1, 0.8]])),
    )


def station_content(tubes: list[Tube]) -> StationContent:
    offsets, masses = np.zeros(GRID.num_cells + 1, np.int64), np.full(GRID.num_cells, -np.inf)
    tubes = sorted(tubes, key=lambda tube: tube.cell)
    for tube in tubes:
        offsets[tube.cell + 1 :] += 1
        masses[tube.cell] = np.logaddexp(masses[tube.cell], tube.log_mass)
    mixture = TubeMixture.empty()
    if tubes:
        mixture = TubeMixture(
            log_weight=np.array([tube.log_mass - masses[tube.cell] for tube in tubes]),
            u_mean=np.array([tube.u_mean for tube in tubes]),
            u_cov=pack(np.array([tube.u_cov for tube in tubes])),
            x_mean=np.array([tube.x_mean for tube in tubes]),
            jacobian=np.array([tube.jacobian for tube in tubes]),
            x_cov=pack(np.array([tube.x_cov for tube in tubes])),
            num_reflections=np.zeros(len(tubes), np.int8),
        )
    level = Level(window=WINDOW, grid=GRID, cell_offsets=offsets, cell_log_mass=masses, mixture=mixture)
    return StationContent(levels=(level,), lost_ray_share=0.0, coverage=(1.0,))


MakeTable = Callable[..., Table]


@pytest.fixture
def make_table(tmp_path: Path) -> MakeTable:
    def make(*tubes: Tube, stations: dict[str, Station] | None = None, free: NDArray[np.bool_] | None = None) -> Table:
        known = stations or {name: Station(id=name, position=position) for name, position in POSITIONS.items()}
        free_space = FreeSpace(
            origin=ORIGIN, voxel_size=1.0, free=np.ones((SIDE,) * 3, np.bool_) if free is None else free
        )
        scene = SceneContent(
            vertices=np.zeros((3, 3)),
            faces=np.array([[0, 1, 2]], np.int32),
            face_materials=np.array([-1], np.int16),
            materials=(),
            free_space=free_space,
            sha256="0" * 64,
        )
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.h5"
        write_table(
            path,
            site=SiteInfo(name="box", north=0.0, max_path_length=MAX_PATH_LENGTH, stations=tuple(known.values())),
            scene=scene,
            stations=[station_content([t for t in tubes if t.station_id == name]) for name in known],
            software_version="0",
        )
        return Table.open(path)

    return make


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
    nodes, weights = np.polynomial.hermite_e.hermegauss(4)  # exact up to the seventh power
    nodes = np.stack(np.meshgrid(nodes, nodes, nodes), axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", weights, weights, weights).ravel() / weights.sum() ** 3
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


def angle_of(tube: Tube, stdev: tuple[float, float] = (0.02, 0.03)) -> Angle:
    """Angle towards a place between a tube's middle and the centre of its cell, with these deviations, rad."""
    azimuth, zenith = GRID.centres[tube.cell]
    return Angle(
        station_id=tube.station_id,
        azimuth=float(azimuth + 0.4 * tube.u_mean[1] / np.sin(zenith)),
        zenith=float(zenith + 0.6 * tube.u_mean[2]),
        azimuth_stdev=stdev[0],
        zenith_stdev=stdev[1],
    )


Pattern = tuple[tuple[str, ...], float, Array, Array]
"""What each station's measurements are, the log evidence of it, and mean and covariance of the position."""


def one_gaussian(measurement: Measurement, wide: bool) -> tuple[Measurement, float]:
    """Measurement of which the error is of the one Gaussian or of the other, and the log probability of that."""
    assert not isinstance(measurement, LogRange)
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


def assert_equal(fix: Fix, expected: Posterior) -> None:
    assert fix.log_evidence == pytest.approx(expected.log_evidence, abs=1e-5)  # nats
    assert len(fix.candidates) == 1
    assert fix.candidates[0].probability == pytest.approx(1.0 - expected.lost, abs=1e-6)
    np.testing.assert_allclose(fix.candidates[0].position, expected.mean, rtol=0, atol=1e-6)  # m
    # m2, about 1e-2: of the oracle's hypotheses the far ones, of a probability of 1e-6, are a hill of their own.
    np.testing.assert_allclose(fix.candidates[0].covariance, expected.cov, rtol=0, atol=5e-6)
    assert [outcome.outlier_probability for outcome in fix.outcomes] == pytest.approx(expected.outlier, abs=1e-6)


TUBES = [line_of_sight("a"), line_of_sight("b", log_mass=0.3), line_of_sight("c", log_mass=-0.5)]
EXACT = FusionSettings(component_floor=1e-30, hypothesis_floor=1e-30, max_divergence=0.0)


def lengths(shift: float = 0.0) -> dict[str, float]:
    return {t.station_id: float(np.linalg.norm(t.x_mean - np.array(POSITIONS[t.station_id]))) + shift for t in TUBES}


def report_of(measurements: Sequence[Measurement]) -> Report:
    return Report(measurements=tuple(measurements))


def measured(kind: str, outlier: str = "") -> list[Measurement]:
    """Measurements of all stations with errors of about a deviation; the times of one of them may be 6 m late."""
    angles: list[Measurement] = [angle_of(tube) for tube in TUBES]
    errors = {"a": 0.3, "b": -0.2, "c": 0.4}
    times: list[Measurement] = []
    for name, true_length in lengths().items():
        length = true_length + (6.0 if name == outlier else 0.0)
        if "pt" in kind:
            times.append(Range(station_id=name, path_length=length + errors[name], stdev=0.4))
        if "toa" in kind:
            times.append(TimeOfArrival(station_id=name, path_length=length + 123.0 - errors[name], stdev=0.3))
    return angles + times


def test_the_tubes_are_what_they_seem() -> None:
    """A metre farther, or a little higher in the tangent plane, is a metre farther or higher in the hall."""
    for tube in TUBES:
        station = np.array(POSITIONS[tube.station_id])
        azimuth, zenith = GRID.centres[tube.cell]
        sine = np.sin(zenith)
        for step in ([0.1, 0.0, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 1e-3]):
            length, horizontal, vertical = tube.u_mean + step
            moved = station + length * direction(azimuth + horizontal / sine, zenith + vertical)
            np.testing.assert_allclose(tube.x_mean + tube.jacobian @ step, moved, rtol=0, atol=2e-5)  # m
        # Twice as far, a step of the angle moves twice as far: what the widening is made of.
        assert tube.u_mean[0] == pytest.approx(np.linalg.norm(tube.x_mean - station), abs=1e-5)


@pytest.mark.parametrize("kind", ["aoa", "aoa+pt", "aoa+toa", "aoa+pt+toa"])
@pytest.mark.parametrize("outlier", ["", "b"])
def test_a_fix_equals_its_closed_form(make_table: MakeTable, kind: str, outlier: str) -> None:
    measurements = measured(kind, outlier)
    fix = Locator(make_table(*TUBES), EXACT).locate(report_of(measurements))
    expected = oracle(TUBES, measurements)
    assert_equal(fix, expected)
    if outlier and kind != "aoa":
        assert expected.outlier[[i for i, m in enumerate(measurements) if m.station_id == "b"]][1] > 0.9


@pytest.mark.parametrize("kind", ["aoa", "aoa+pt"])
def test_a_fix_of_one_station_equals_its_closed_form(make_table: MakeTable, kind: str) -> None:
    measurements = [m for m in measured(kind) if m.station_id == "c"]
    fix = Locator(make_table(*TUBES), EXACT).locate(report_of(measurements))
    assert_equal(fix, oracle([TUBES[2]], measurements))


@pytest.mark.parametrize("kind", ["aoa", "aoa+pt", "aoa+toa"])
@pytest.mark.parametrize("outlier", ["", "b"])
def test_a_fix_of_heavy_tailed_errors_equals_its_closed_form(make_table: MakeTable, kind: str, outlier: str) -> None:
    """Angles and times whose errors are each of one of two Gaussians, independently."""
    models = {Angle: ErrorModel(tail_share=0.15, tail_scale=2.2), Range: ErrorModel(tail_share=0.3, tail_scale=4.0)}
    measurements = [replace(m, error_model=models.get(type(m), HEAVY_TAILED)) for m in measured(kind, outlier)]
    measurements = [m for m in measurements if m.station_id != "c"]
    fix = Locator(make_table(*TUBES), EXACT).locate(report_of(measurements))
    expected = oracle(TUBES[:2], measurements)
    assert fix.log_evidence == pytest.approx(expected.log_evidence, abs=1e-5)  # nats
    assert [outcome.outlier_probability for outcome in fix.outcomes] == pytest.approx(expected.outlier, abs=1e-6)
    if not outlier:  # otherwise the outlier is a second candidate, of a probability of 0.0004
        assert_equal(fix, expected)
    plain = oracle(TUBES[:2], [m for m in measured(kind, outlier) if m.station_id != "c"])
    assert np.abs(fix.candidates[0].position - plain.mean).max() > 1e-3  # m: it makes a difference


@pytest.mark.parametrize("kind", ["aoa", "aoa+pt", "aoa+toa"])
@pytest.mark.parametrize("height", [Height(z=1.3, stdev=0.2), Height(z=0.9, stdev=0.002), Height(z=1.0, stdev=50.0)])
def test_a_fix_of_known_height_equals_its_closed_form(make_table: MakeTable, kind: str, height: Height) -> None:
    measurements = measured(kind)
    fix = Locator(make_table(*TUBES), EXACT).locate(replace(report_of(measurements), height=height))
    assert_equal(fix, oracle(TUBES, measurements, height))


def test_a_sharp_height_cuts_the_posterior_at_its_plane(make_table: MakeTable) -> None:
    """The paper's two-dimensional case: the Gaussian over (x, y) given z, by the formula for conditional Gaussians."""
    never = FusionSettings(outlier_probability=1e-15, max_divergence=0.0)
    locator = Locator(make_table(*TUBES), never)
    whole = oracle(TUBES, measured("aoa+pt"))
    z = 1.35
    flat = locator.locate(replace(report_of(measured("aoa+pt")), height=Height(z=z, stdev=1e-3)))
    free = locator.locate(report_of(measured("aoa+pt")))
    mean, cov = free.candidates[0].position, free.candidates[0].covariance
    slope = cov[:2, 2] / cov[2, 2]
    expected = mean[:2] + slope * (z - mean[2])
    np.testing.assert_allclose(flat.candidates[0].position, [*expected, z], rtol=0, atol=1e-4)  # m
    left = cov[:2, :2] - np.outer(slope, cov[2, :2])
    np.testing.assert_allclose(flat.candidates[0].covariance[:2, :2], left, rtol=1e-3)
    assert np.abs(expected - whole.mean[:2]).max() > 1e-3  # m: it makes a difference


def test_a_height_out_of_the_building_is_refused(make_table: MakeTable) -> None:
    locator = Locator(make_table(*TUBES))
    report = replace(report_of(measured("aoa")), height=Height(z=120.0, stdev=0.5))
    with pytest.raises(ReportError, match=r"height is 120 m .* from -30.80 to 33.20 m; give a height there") as caught:
        locator.locate(report)
    assert caught.value.path == ("height",)


def test_a_stated_bias_is_as_none(make_table: MakeTable) -> None:
    """Measurements with the bias in them, and a table that knows it, against neither."""
    biases = {
        "a": StationBias(range=0.3, azimuth=0.02, zenith=-0.015),
        "b": StationBias(range=-0.2, azimuth=-0.03),
        "c": StationBias(range=0.15, zenith=0.04),
    }
    stations = {n: Station(id=n, position=p, bias=biases[n]) for n, p in POSITIONS.items()}
    known, plain = make_table(*TUBES, stations=stations), make_table(*TUBES)

    def biased(m: Measurement) -> Measurement:
        bias = biases[m.station_id]
        if isinstance(m, Angle):
            assert m.zenith is not None
            return replace(m, azimuth=m.azimuth + bias.azimuth, zenith=m.zenith + bias.zenith)
        if isinstance(m, TimeDifference):
            reference = biases[m.reference_station_id]
            return replace(m, length_difference=m.length_difference + bias.range - reference.range)
        assert not isinstance(m, LogRange)
        return replace(m, path_length=m.path_length + bias.range)

    for measurements in (measured("aoa+pt+toa"), differences("b")):
        expected = Locator(plain, EXACT).locate(report_of(measurements))
        found = Locator(known, EXACT).locate(report_of([biased(m) for m in measurements]))
        np.testing.assert_allclose(found.candidates[0].position, expected.candidates[0].position, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.candidates[0].covariance, expected.candidates[0].covariance, rtol=1e-9)
        assert found.log_evidence == pytest.approx(expected.log_evidence, abs=1e-9)
        unknown = Locator(plain, EXACT).locate(report_of([biased(m) for m in measurements]))
        assert np.abs(unknown.candidates[0].position - expected.candidates[0].position).max() > 0.05  # m


def test_all_measurements_may_be_outliers_with_the_probability_of_bayes_rule(make_table: MakeTable) -> None:
    """Two hypotheses: the angle is of the tube, of which little is there, or of anywhere."""
    tube = line_of_sight("a", log_mass=4.0)
    measurements: list[Measurement] = [angle_of(tube)]
    fix = Locator(make_table(tube), EXACT).locate(report_of(measurements))
    expected = oracle([tube], measurements)
    assert 0.1 < expected.lost < 0.9
    assert_equal(fix, expected)
    assert fix.outcomes[0].outlier_probability == pytest.approx(expected.lost, abs=1e-9)


def differences(reference: str, outlier: str = "") -> list[Measurement]:
    """Angles, and the time differences that the times of arrival of :func:`measured` make."""
    measurements = measured("aoa+toa", outlier)
    arrivals = [m for m in measurements if isinstance(m, TimeOfArrival)]
    (at_reference,) = [m for m in arrivals if m.station_id == reference]
    made = [
        TimeDifference(
            station_id=m.station_id,
            reference_station_id=reference,
            length_difference=m.path_length - at_reference.path_length,
            stdev=float(np.sqrt(2.0)) * m.stdev,
        )
        for m in arrivals
        if m is not at_reference
    ]
    return [*(m for m in measurements if isinstance(m, Angle)), *made]


@pytest.mark.parametrize("offset", [2.0**20, -(2.0**26), 0.0])
def test_the_clock_of_times_of_arrival_does_not_matter(make_table: MakeTable, offset: float) -> None:
    def fine(m: Measurement) -> Measurement:
        # Multiples of 2^-20 m, about a micrometre, stay exact when the offset is added.
        return replace(m, path_length=round(m.path_length * 2**20) / 2**20) if isinstance(m, TimeOfArrival) else m

    locator = Locator(make_table(*TUBES), EXACT)
    measurements = [fine(m) for m in measured("aoa+toa")]
    late = [replace(m, path_length=m.path_length + offset) if isinstance(m, TimeOfArrival) else m for m in measurements]
    first, second = locator.locate(report_of(measurements)), locator.locate(report_of(late))
    np.testing.assert_allclose(second.candidates[0].position, first.candidates[0].position, rtol=0, atol=1e-9)  # m
    assert second.log_evidence == pytest.approx(first.log_evidence, abs=1e-9)


TREES = ["ab ac", "ba bc", "ca cb", "ab bc", "ca ab", "bc ca", "ab bc ca", "ab ba ac bc"]
"""Differences that connect all stations: stars, chains, and more of them than needed."""


@pytest.mark.parametrize("model", [GAUSSIAN, HEAVY_TAILED])
@pytest.mark.parametrize("tree", TREES)
def test_any_differences_that_connect_all_arrivals_say_the_same(
    make_table: MakeTable, tree: str, model: ErrorModel
) -> None:
    measurements = [replace(m, error_model=model) if isinstance(m, TimeOfArrival) else m for m in measured("aoa+toa")]
    arrivals = {m.station_id: m for m in measurements if isinstance(m, TimeOfArrival)}
    differences = [
        TimeDifference(
            station_id=first,
            reference_station_id=second,
            length_difference=arrivals[first].path_length - arrivals[second].path_length,
            stdev=float(np.sqrt(2.0)) * arrivals[first].stdev,
            error_model=model,
        )
        for first, second in tree.split()
    ]
    locator = Locator(make_table(*TUBES), EXACT)
    expected = locator.locate(report_of(measurements))
    fix = locator.locate(report_of([m for m in measurements if isinstance(m, Angle)] + differences))
    assert fix.log_evidence == pytest.approx(expected.log_evidence, abs=1e-8)
    np.testing.assert_allclose(fix.candidates[0].position, expected.candidates[0].position, rtol=0, atol=1e-8)  # m
    np.testing.assert_allclose(fix.candidates[0].covariance, expected.candidates[0].covariance, rtol=1e-8)


def test_a_reference_that_is_late_spoils_all_its_differences(make_table: MakeTable) -> None:
    locator = Locator(make_table(*TUBES), EXACT)
    for late, spoilt in [("a", [True, True]), ("b", [True, False]), ("c", [False, True])]:
        outcomes = locator.locate(report_of(differences("a", late))).outcomes
        assert [(outcome.outlier_probability or 0.0) > 0.8 for outcome in outcomes] == [False] * 3 + spoilt


def test_time_differences_to_one_reference_are_correlated(make_table: MakeTable) -> None:
    """Generalised least squares with the covariance s^2 (I + 1 1^T) of two differences of deviation sqrt(2) s."""
    never = FusionSettings(outlier_probability=1e-15, max_divergence=0.0)
    measurements = differences("a")
    fix = Locator(make_table(*TUBES), never).locate(report_of(measurements))
    covs = []
    for correlation in (0.5, 0.0):
        product, state = Product(12), np.eye(12)
        for n, tube in enumerate(TUBES):
            angle = measurements[n]
            assert isinstance(angle, Angle)
            product.multiply_tube(state, n, tube, angle)
        times = [m for m in measurements if isinstance(m, TimeDifference)]
        value = np.array([m.length_difference for m in times])
        noise = times[0].stdev ** 2 * np.array([[1.0, correlation], [correlation, 1.0]])
        product.multiply(state[[6, 9]] - state[3], value, noise)
        _, mean, cov = product.integral()
        covs.append(cov[:3, :3])
        if correlation:
            np.testing.assert_allclose(fix.candidates[0].position, mean[:3], rtol=0, atol=1e-6)  # m
    np.testing.assert_allclose(fix.candidates[0].covariance, covs[0], rtol=1e-5, atol=1e-9)
    assert np.abs(covs[1] - covs[0]).max() > 1e-4  # m2: it makes a difference


def test_two_propagation_times_of_a_path_are_their_mean(make_table: MakeTable) -> None:
    never = replace(EXACT, outlier_probability=1e-15)
    locator = Locator(make_table(*TUBES), never)
    once = measured("aoa+pt")
    noisy = [replace(m, stdev=m.stdev * float(np.sqrt(2.0))) if isinstance(m, Range) else m for m in once]
    below = [replace(m, path_length=m.path_length - 0.3) if isinstance(m, Range) else m for m in noisy]
    above = [replace(m, path_length=m.path_length + 0.3) for m in noisy if isinstance(m, Range)]
    expected, fix = locator.locate(report_of(once)), locator.locate(report_of(below + above))
    np.testing.assert_allclose(fix.candidates[0].position, expected.candidates[0].position, rtol=0, atol=1e-9)  # m
    np.testing.assert_allclose(fix.candidates[0].covariance, expected.candidates[0].covariance, rtol=1e-9)


def test_paths_of_one_station_are_as_of_stations_in_one_place(make_table: MakeTable) -> None:
    """Two angles and two ranges of a station, against one of each at either of two stations that hear the same."""
    mirrored = line_of_sight("a", UE + np.array([-7.0, 3.0, 0.0]), log_mass=0.4)
    # The signal that seems to come from there is the UE's.
    mirrored = replace(mirrored, x_mean=UE + np.array([0.2, -0.1, 0.05]))
    stations = {
        "a": Station(id="a", position=POSITIONS["a"]),
        "twin": Station(id="twin", position=POSITIONS["a"]),
    }
    tubes = [TUBES[0], mirrored]
    both = [*tubes, *(replace(tube, station_id="twin") for tube in tubes)]
    locator = Locator(make_table(*both, stations=stations), EXACT)
    paths = [
        (angle_of(tube), Range(station_id="a", path_length=float(tube.u_mean[0]) + 0.2, stdev=0.4)) for tube in tubes
    ]
    one = locator.locate(report_of([m for path in paths for m in path]))
    split = [replace(m, station_id="twin") for m in paths[1]]
    two = locator.locate(report_of([*paths[0], *split]))
    assert one.log_evidence == pytest.approx(two.log_evidence, abs=1e-9)
    np.testing.assert_allclose(one.candidates[0].position, two.candidates[0].position, rtol=0, atol=1e-9)  # m
    np.testing.assert_allclose(one.candidates[0].covariance, two.candidates[0].covariance, rtol=1e-9)
    for mine, other in zip(one.outcomes, two.outcomes, strict=True):
        assert mine.outlier_probability == pytest.approx(other.outlier_probability, abs=1e-9)
    alone = locator.locate(report_of(paths[0]))
    assert np.trace(one.candidates[0].covariance) < 0.9 * np.trace(alone.candidates[0].covariance)


def test_two_symmetric_rooms_are_ambiguous(make_table: MakeTable) -> None:
    """One station, a mirror behind it: what it hears from either side looks the same."""
    left = right = line_of_sight("a", length_stdev=0.3, log_mass=12.0)
    right = replace(right, x_mean=right.x_mean + np.array([-9.0, 2.0, 0.0]), log_mass=left.log_mass - 0.5)
    fix = Locator(make_table(left, right)).locate(report_of([angle_of(left)]))
    assert fix.status == "ambiguous"
    odds = fix.candidates[0].probability / fix.candidates[1].probability
    assert odds == pytest.approx(np.exp(0.5), rel=1e-5)
    np.testing.assert_allclose(
        fix.candidates[0].position - fix.candidates[1].position, [9.0, -2.0, 0.0], rtol=0, atol=1e-5
    )


def test_two_stations_that_contradict_each_other_are_inconsistent(make_table: MakeTable) -> None:
    near, far = (UE, UE + np.array([6.0, 8.0, 0.0]))
    tubes = [
        line_of_sight("a", near, length_stdev=0.3, log_mass=12.0),
        line_of_sight("b", far, length_stdev=0.3, log_mass=12.0),
    ]
    fix = Locator(make_table(*tubes)).locate(report_of([angle_of(tube) for tube in tubes]))
    assert fix.status == "inconsistent"
    assert sum(outcome.outlier_probability or 0.0 for outcome in fix.outcomes) == pytest.approx(1.0, abs=0.1)


def test_a_long_tube_alone_is_insufficient(make_table: MakeTable) -> None:
    tube = line_of_sight("a", length_stdev=5.0, log_mass=12.0)
    assert Locator(make_table(tube)).locate(report_of([angle_of(tube)])).status == "insufficient"


def test_a_candidate_moves_out_of_a_solid(make_table: MakeTable) -> None:
    """All but the lower half of the cube is solid, and the UE seems to be 0.2 m inside."""
    free = np.ones((SIDE,) * 3, np.bool_)
    free[:, :, 32:] = False  # z > 1.2
    tubes = [line_of_sight(name, UE + np.array([0.0, 0.0, 0.2]), width=0.01) for name in POSITIONS]
    aimed: list[Measurement] = []
    for tube in tubes:
        azimuth, zenith = angles_of(tube.x_mean - np.array(POSITIONS[tube.station_id]))
        precise = angle_of(tube, stdev=(1e-3, 1e-3))
        aimed.append(replace(precise, azimuth=float(azimuth), zenith=float(zenith)))
    fix = Locator(make_table(*tubes, free=free)).locate(report_of(aimed))
    np.testing.assert_allclose(fix.candidates[0].position, [9.0, 8.0, 1.2], rtol=0, atol=0.03)  # m
    assert fix.candidates[0].position[2] < 1.2
    unmoved = Locator(make_table(*tubes)).locate(report_of(aimed))
    assert unmoved.candidates[0].position[2] == pytest.approx(1.4, abs=0.03)
