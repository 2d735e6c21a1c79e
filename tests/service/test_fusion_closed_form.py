"""Whole fixes on hand-made tables, which have a closed form.

Each station's cells are empty but for those given; a cell holds one tube, that of the line of sight::

    z                      b o  (6, 14, 2.4)
    |   y         x UE
    |  /        /   \\
    | /    a o        o c  (16, 2, 2.4)         a hall of 20 x 20 x 5 m, all of it free
    |/_____________________ x

The oracle knows nothing of beams, clocks or remainders: it multiplies all densities as one Gaussian over the position
and the ray coordinates of all stations, once for each way in which measurements can be outliers.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.fusion.report import (
    Angle,
    Fix,
    Measurement,
    Range,
    Report,
    TimeOfArrival,
)
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.angles import angles_of, direction
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.grid import AngularGrid
from rayfix_tables.mixture import TubeMixture, pack
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.table import Table
from rayfix_tables.write import LevelContent, SceneContent, StationContent, write_table

Array = NDArray[np.float64]

WINDOW = float(np.deg2rad(5.0))
GRID = AngularGrid.from_spacing(WINDOW / 0.8)
MAX_PATH_LENGTH = 40.0
VOLUME = 20.0 * 20.0 * 5.0
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
    level = LevelContent(window=WINDOW, grid=GRID, cell_offsets=offsets, cell_log_mass=masses, mixture=mixture)
    return StationContent(levels=(level,), lost_ray_share=0.0, coverage=(1.0,))


MakeTable = Callable[..., Table]


@pytest.fixture
def make_table(tmp_path: Path) -> MakeTable:
    def make(*tubes: Tube, stations: dict[str, Station] | None = None, free: NDArray[np.bool_] | None = None) -> Table:
        known = stations or {name: Station(id=name, position=position) for name, position in POSITIONS.items()}
        free_space = FreeSpace(
            origin=np.zeros(3), voxel_size=0.25, free=np.ones((80, 80, 20), np.bool_) if free is None else free
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

    def integral(self) -> tuple[float, Array, Array]:
        """Log integral, and mean and covariance of the state."""
        cov = np.linalg.inv(self.information)
        mean = cov @ self.eta
        return self.log_scale + 0.5 * (mean @ self.eta + np.linalg.slogdet(2.0 * np.pi * cov)[1]), mean, cov


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """What the oracle says: one candidate, and the probability of each measurement to be an outlier."""

    log_evidence: float
    lost: float
    mean: Array
    cov: Array
    outlier: Array


def angle_of(
    tube: Tube, shift: tuple[float, float] = (0.01, -0.015), stdev: tuple[float, float] = (0.02, 0.03)
) -> Angle:
    """Angle towards a tube's middle, off by this many rad."""
    azimuth, zenith = angles_of(tube.x_mean - np.array(POSITIONS[tube.station_id]))
    return Angle(
        station_id=tube.station_id,
        azimuth=float(azimuth) + shift[0],
        zenith=float(zenith) + shift[1],
        azimuth_stdev=stdev[0],
        zenith_stdev=stdev[1],
    )


def oracle(tubes: list[Tube], measurements: list[Measurement]) -> Posterior:
    """Posterior of a report with one angle and any times per station, by one big Gaussian per outlier pattern.

    The ToAs of a report share a clock; of TDoAs there is one set, all against ``tubes[0]``, with deviations of
    sqrt(2) s, which is the same as ToAs of deviation s.
    """
    num = len(tubes)
    arrivals = [m for m in measurements if isinstance(m, TimeOfArrival)]
    places = {tube.station_id: n for n, tube in enumerate(tubes)}
    angles = {places[m.station_id]: m for m in measurements if isinstance(m, Angle)}
    size = 3 + 3 * num + (1 if arrivals else 0)
    patterns = []
    for kinds in itertools.product(("good", "late", "bad"), repeat=num):
        timed = [
            [m for m in measurements if not isinstance(m, Angle) and places[m.station_id] == n] for n in range(num)
        ]
        if any(kind == "late" and not (timed[n] and n in angles) for n, kind in enumerate(kinds)):
            continue
        product, log_prior, clock_known = Product(size), 0.0, False
        state = np.eye(size)
        for n, (tube, kind) in enumerate(zip(tubes, kinds, strict=True)):
            u = state[3 + 3 * n : 6 + 3 * n]
            log_any = -sum(np.log(MAX_PATH_LENGTH + np.sqrt(2.0 * np.pi) * m.stdev) for m in timed[n])
            product.multiply(u, tube.u_mean, tube.u_cov)
            if kind == "bad":
                log_prior += np.log(EPSILON) + log_any - (np.log(4.0 * np.pi) if n in angles else 0.0)
                continue
            log_prior += tube.log_mass + np.log1p(-EPSILON)
            if n in angles and timed[n]:
                log_prior += np.log(EPSILON) + log_any if kind == "late" else np.log1p(-EPSILON)
            product.multiply(state[:3] - tube.jacobian @ u, tube.x_mean - tube.jacobian @ tube.u_mean, tube.x_cov)
            if n in angles:
                centre_azimuth, centre_zenith = GRID.centres[tube.cell]
                sine = np.sin(centre_zenith)
                a = np.array([sine * (angles[n].azimuth - centre_azimuth), angles[n].zenith - centre_zenith])
                noise = np.diag([(sine * angles[n].azimuth_stdev) ** 2, angles[n].zenith_stdev ** 2])
                product.multiply(u[1:], a, noise)
                product.multiply(u[1:], np.zeros(2), WINDOW**2 * np.eye(2), sign=-1.0)
            for m in timed[n] if kind == "good" else []:
                clock_known |= isinstance(m, TimeOfArrival)
                row = u[:1] + (state[-1:] if isinstance(m, TimeOfArrival) else 0.0)
                product.multiply(row, np.array([m.path_length]), np.array([[m.stdev**2]]))
        log_prior -= np.log(VOLUME)
        if all(kind == "bad" for kind in kinds):
            patterns.append((kinds, log_prior + np.log(VOLUME), np.full(3, np.nan), np.full((3, 3), np.nan)))
            continue
        if arrivals:
            log_prior -= np.log(MAX_PATH_LENGTH)
            if not clock_known:
                # Anywhere in a range of this length.
                log_prior += np.log(MAX_PATH_LENGTH)
                product.multiply(state[-1:], np.zeros(1), np.eye(1))
        log_integral, mean, cov = product.integral()
        patterns.append((kinds, log_prior + log_integral, mean[:3], cov[:3, :3]))
    logs = np.array([pattern[1] for pattern in patterns])
    log_evidence = float(logs.max() + np.log(np.exp(logs - logs.max()).sum()))
    weight = np.exp(logs - log_evidence)
    lost = float(sum(w for w, p in zip(weight, patterns, strict=True) if set(p[0]) == {"bad"}))
    share = [(w / (1.0 - lost), p) for w, p in zip(weight, patterns, strict=True) if set(p[0]) != {"bad"}]
    mean = np.asarray(sum(w * p[2] for w, p in share))
    cov = np.asarray(sum(w * (p[3] + np.outer(p[2] - mean, p[2] - mean)) for w, p in share))
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
    np.testing.assert_allclose(fix.candidates[0].covariance, expected.cov, rtol=1e-5, atol=1e-7)  # m2, about 1e-2
    assert [outcome.outlier_probability for outcome in fix.outcomes] == pytest.approx(expected.outlier, abs=1e-6)


TUBES = [line_of_sight("a"), line_of_sight("b", log_mass=0.3), line_of_sight("c", log_mass=-0.5)]
EXACT = FusionSettings(component_floor=1e-30, hypothesis_floor=1e-30)


def lengths(shift: float = 0.0) -> dict[str, float]:
    return {t.station_id: float(np.linalg.norm(t.x_mean - np.array(POSITIONS[t.station_id]))) + shift for t in TUBES}


def report_of(measurements: list[Measurement]) -> Report:
    return Report(measurements=tuple(measurements))


def measured(kind: str) -> list[Measurement]:
    """Measurements of all stations with errors of about a deviation."""
    angles: list[Measurement] = [angle_of(tube) for tube in TUBES]
    errors = {"a": 0.3, "b": -0.2, "c": 0.4}
    times: list[Measurement] = []
    for name, length in lengths().items():
        if "pt" in kind:
            times.append(Range(station_id=name, path_length=length + errors[name], stdev=0.4))
        if "toa" in kind:
            times.append(TimeOfArrival(station_id=name, path_length=length + 123.0 - errors[name], stdev=0.3))
    return times if kind.startswith("only") else angles + times
