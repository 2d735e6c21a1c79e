"""Fixes of wide errors in an empty room against sums over a dense grid."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import exponnorm, vonmises_fisher

from rayfix_service.fusion.measurements.report import GAUSSIAN, Angle, ErrorModel, Height, Range, Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.locator import Locator
from rayfix_tables.geometry.angles import angles_of, local_to_scene
from rayfix_tables.site import Station
from rayfix_tables.table import Table
from tests.support.tables.open_room import HEIGHT, POSITIONS, SIDE, open_room_table

Array = NDArray[np.float64]
TRUTH = np.array([2.2, 3.7, 1.1])
TAILS = ErrorModel(tail_share=0.2, tail_scale=3.0)
OUTLIER, SPREAD, DETOUR = 0.01, 0.3, 2.5
STEP = 0.05  # m, of the oracle's grid


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Table:
    """Write the table of the room."""
    return open_room_table(tmp_path_factory.mktemp("room") / "room.h5")


@pytest.fixture(scope="module")
def places() -> Array:
    """Centres of the oracle's cells."""
    axes = (np.arange(0.5 * STEP, side, STEP) for side in (SIDE, SIDE, HEIGHT))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def angle(name: str, degrees: float, errors: tuple[float, float], model: ErrorModel = GAUSSIAN) -> Angle:
    """Measure the direction of the truth with errors in standard deviations."""
    azimuth, zenith = angles_of(TRUTH - POSITIONS[name])
    stdev = float(np.deg2rad(degrees))
    return Angle(
        station_id=name,
        azimuth=float(azimuth) + errors[0] * stdev,
        zenith=float(zenith) + errors[1] * stdev,
        azimuth_stdev=stdev,
        zenith_stdev=stdev,
        error_model=model,
    )


def normal(error: Array, stdev: float, model: ErrorModel = GAUSSIAN) -> Array:
    """Density of an error, a mixture of two normals."""
    total = np.zeros_like(error)
    for share, scale in ((1.0 - model.tail_share, 1.0), (model.tail_share, model.tail_scale)):
        if share > 0.0:
            wide = scale * stdev
            total += share * np.exp(-0.5 * (error / wide) ** 2) / (np.sqrt(2.0 * np.pi) * wide)
    return total


def of_unmodelled(own: list[Angle | Range], apart: Array, spread: float, detour: float) -> Array:
    """Density of a path that the map does not know: von Mises-Fisher by exponential with the error of the length.

    Three in ten have a quarter of the spread and no detour.
    """
    distance = np.linalg.norm(apart, axis=1)
    total = np.zeros(len(apart))
    for share, wide, longer in ((0.3, 0.25 * spread, 0.0), (0.7, spread, detour)):
        part = np.full(len(apart), share)
        for each in own:
            if isinstance(each, Range):
                error = each.path_length - distance
                if longer == 0.0:
                    part *= normal(error, each.stdev)
                else:
                    part *= exponnorm.pdf(error, longer / each.stdev, scale=each.stdev)
            elif each.zenith is None:
                part /= 2.0 * np.pi
            else:
                sine, cosine = np.sin(each.zenith), np.cos(each.zenith)
                heading = np.array([sine * np.cos(each.azimuth), sine * np.sin(each.azimuth), cosine])
                part *= vonmises_fisher(heading, 1.0 / wide**2).pdf(apart / distance[:, None])
        total += part
    return total


def log_likelihood(report: Report, places: Array, unmodelled: float = 0.1, *, alone: bool = False) -> Array:
    """Sum of the logs of the stations' densities, in the units of rayfix's evidence.

    ``alone`` says whether unmodelled paths may be those of angles without a time.
    """
    total = np.zeros(len(places))
    for name in {measurement.station_id for measurement in report.measurements}:
        own = [measurement for measurement in report.measurements if measurement.station_id == name]
        azimuth, zenith = angles_of(places - POSITIONS[name])
        good, any_length, any_direction = np.ones(len(places)), 1.0, 1.0
        lengths = np.ones(len(places))
        for each in own:
            if isinstance(each, Angle):
                aside = np.angle(np.exp(1j * (azimuth - each.azimuth)))
                any_direction = 2.0 * np.pi
                if each.zenith is None or each.zenith_stdev is None:
                    good = normal(aside, each.azimuth_stdev, each.error_model)
                    continue
                any_direction = 4.0 * np.pi
                model = each.error_model
                good = np.zeros(len(places))
                for share, scale in ((1.0 - model.tail_share, 1.0), (model.tail_share, model.tail_scale)):
                    if share > 0.0:
                        good += (
                            share
                            * normal(aside, scale * each.azimuth_stdev)
                            * normal(zenith - each.zenith, scale * each.zenith_stdev)
                        )
                good /= np.sin(each.zenith)
            if isinstance(each, Range):
                distance = np.linalg.norm(places - POSITIONS[name], axis=1)
                lengths = normal(distance - each.path_length, each.stdev)
                any_length = 30.0 + np.sqrt(2.0 * np.pi) * each.stdev
        if any_direction > 1.0 and any_length > 1.0:  # the time alone may be an outlier
            lengths = (1.0 - OUTLIER) * lengths + OUTLIER / any_length
        density = (1.0 - OUTLIER) * good * lengths + OUTLIER / any_length / any_direction
        if any_direction == 4.0 * np.pi and (any_length > 1.0 or alone):
            density -= unmodelled * good * lengths
            density += unmodelled * of_unmodelled(own, places - POSITIONS[name], SPREAD, DETOUR)
        total += np.log(density)
    return total


def exact(report: Report, places: Array, unmodelled: float = 0.1, *, alone: bool = False) -> tuple[float, Array, Array]:
    """Log evidence, mean and covariance of the posterior, summed over the cells."""
    prior = np.zeros(len(places))
    if report.height is not None:
        prior = -0.5 * ((places[:, 2] - report.height.z) / report.height.stdev) ** 2
    log = log_likelihood(report, places, unmodelled, alone=alone) + prior - np.logaddexp.reduce(prior)
    evidence = float(np.logaddexp.reduce(log))
    share = np.exp(log - evidence)
    mean = share @ places
    apart = places - mean
    return evidence, mean, np.einsum("n,ni,nj->ij", share, apart, apart)


REPORTS = {
    "one": [angle("a", 10.0, (0.6, -0.4))],
    "two": [angle("a", 8.0, (0.6, -0.4)), angle("b", 8.0, (-1.0, 0.3))],
    "four": [angle(name, 5.0, (0.5 * n - 0.7, 0.4)) for n, name in enumerate(POSITIONS)],
    "azimuths": [
        replace(angle(name, 10.0, (0.5 * n - 0.7, 0.0)), zenith=None, zenith_stdev=None)
        for n, name in enumerate(POSITIONS)
    ],
    "tails": [angle(name, 6.0, (2.5 * n - 3.0, 0.4), TAILS) for n, name in enumerate("abc")],
    "ranges": [
        Range(station_id=name, path_length=float(np.linalg.norm(TRUTH - POSITIONS[name])) + 0.2, stdev=0.3)
        for name in POSITIONS
    ],
    "both": [
        angle("a", 10.0, (0.6, -0.4)),
        Range(station_id="a", path_length=float(np.linalg.norm(TRUTH - POSITIONS["a"])) - 0.2, stdev=0.4),
        angle("d", 10.0, (-0.3, 0.7)),
    ],
}


@pytest.mark.parametrize("height", [None, 0.3, 0.05], ids=["free", "thick", "thin"])
@pytest.mark.parametrize("name", sorted(REPORTS))
def test_against_the_dense_grid(table: Table, places: Array, name: str, height: float | None) -> None:
    """Position within a tenth of its deviation, deviations to 8 %, evidence to 0.05 nats."""
    known = None if height is None else Height(z=1.3, stdev=height)
    report = Report(measurements=tuple(REPORTS[name]), height=known)
    fix = Locator(table).locate(report)
    evidence, mean, cov = exact(report, places)
    assert len(fix.candidates) == 1 or fix.candidates[0].probability > 0.9
    assert fix.position is not None
    assert fix.covariance is not None
    if fix.candidates[0].probability > 0.999:
        off = fix.position - mean
        assert np.all(np.abs(off) < 0.1 * np.sqrt(np.diag(cov)) + 0.005)
        assert np.sqrt(np.diag(fix.covariance)) == pytest.approx(np.sqrt(np.diag(cov)), rel=0.08)
    assert fix.log_evidence == pytest.approx(evidence, abs=0.05)


def test_regions_hold_what_they_say(table: Table, places: Array) -> None:
    """The 90 % region has 90 % of the exact posterior."""
    report = Report(measurements=tuple(REPORTS["two"]))
    fix = Locator(table).locate(report)
    assert fix.regions is not None
    log = log_likelihood(report, places)
    share = np.exp(log - np.logaddexp.reduce(log))
    for probability in (0.5, 0.9):
        region = fix.regions.ellipsoid(probability)
        apart = places - region.centre
        inside = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(region.shape), apart) <= 1.0
        assert float(share[inside].sum()) == pytest.approx(probability, abs=0.03)


def test_outliers_are_told(table: Table) -> None:
    """Three stations agree, and the angle of the fourth is 100 deg off."""
    wrong = angle("d", 5.0, (20.0, 0.0))
    fix = Locator(table).locate(Report(measurements=(*REPORTS["four"][:3], wrong)))
    assert fix.status == "ok"
    told = [outcome.outlier_probability for outcome in fix.outcomes]
    assert told[3] > 0.99
    assert max(told[:3]) < 0.05


def test_wide_errors_make_one_smooth_hill(table: Table) -> None:
    """Angles of 10 and 15 deg in an empty room: no fix is ambiguous."""
    rng = np.random.default_rng(5)
    locator = Locator(table)
    statuses = []
    for degrees in (10.0, 15.0):
        for _ in range(20):
            angles = tuple(angle(name, degrees, tuple(rng.standard_normal(2).tolist())) for name in POSITIONS)
            statuses.append(locator.locate(Report(measurements=angles)).status)
    assert "ambiguous" not in statuses


def test_angles_of_a_tilted_array_have_the_errors_of_its_own_frame(tmp_path: Path, places: Array) -> None:
    """An array that looks straight down: the UE is near the pole of the scene's angles, where azimuths mean little."""
    orientation = (0.3, 0.5 * np.pi, 0.0)
    at = (2.0, 3.5, 2.8)
    table = open_room_table(tmp_path / "down.h5", stations=(Station(id="a", position=at, orientation=orientation),))
    stdev = float(np.deg2rad(10.0))
    rotation = local_to_scene(orientation)
    azimuth, zenith = (float(value) for value in angles_of(rotation.T @ (TRUTH - np.array(at))))
    measured = Angle(
        station_id="a",
        azimuth=azimuth + 0.1,
        zenith=zenith - 0.05,
        azimuth_stdev=stdev,
        zenith_stdev=stdev,
        frame="lcs",
    )
    fix = Locator(table).locate(Report(measurements=(measured,)))
    own_azimuth, own_zenith = angles_of((places - np.array(at)) @ rotation)
    density = normal(np.angle(np.exp(1j * (own_azimuth - measured.azimuth))), stdev)
    density *= normal(own_zenith - (zenith - 0.05), stdev) / np.sin(zenith - 0.05)
    log = np.log((1.0 - OUTLIER) * density + OUTLIER / (4.0 * np.pi)) - np.log(len(places))
    evidence = float(np.logaddexp.reduce(log))
    mean = np.exp(log - evidence) @ places
    assert fix.log_evidence == pytest.approx(evidence, abs=0.03)
    assert fix.position == pytest.approx(mean, abs=0.06)


def test_no_candidate_lies_in_a_solid(tmp_path: Path) -> None:
    """A pillar stands where the mean would be."""
    free = np.ones((60, 60, 30), bool)
    free[18:30, 30:44, :] = False
    space = replace(open_room_table(tmp_path / "a.h5").scene.free_space, free=free)
    locator = Locator(open_room_table(tmp_path / "b.h5", space))
    rng = np.random.default_rng(2)
    for _ in range(30):
        angles = tuple(angle(name, 10.0, tuple(rng.standard_normal(2).tolist())) for name in POSITIONS)
        fix: Fix = locator.locate(Report(measurements=angles))
        assert all(space.contains(candidate.position) for candidate in fix.candidates)
        assert sum(candidate.probability for candidate in fix.candidates) <= 1.0 + 1e-9


def test_the_same_report_gives_the_same_fix(table: Table) -> None:
    report = Report(measurements=tuple(REPORTS["four"]))
    first, second = (Locator(table).locate(report) for _ in range(2))
    assert first.position is not None
    assert second.position is not None
    assert first.position.tobytes() == second.position.tobytes()
