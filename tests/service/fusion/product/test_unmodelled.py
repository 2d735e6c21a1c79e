"""Paths that the table does not know: densities that integrate to one, their Gaussians, and what they do to a fix."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad

from rayfix_service.fusion.measurements.directions import Direction
from rayfix_service.fusion.measurements.likelihood import Term
from rayfix_service.fusion.measurements.observations import Observation
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.product.unmodelled import (
    UnmodelledPath,
    detours,
    unmodelled_density,
    unmodelled_gaussians,
    unmodelled_path,
)
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from rayfix_tables.geometry.angles import angles_of, direction
from rayfix_tables.table import Table
from tests.support.tables.open_room import POSITIONS, open_room_table

Array = NDArray[np.float64]
SETTINGS = FusionSettings(unmodelled_probability=0.2, unmodelled_spread=0.3, unmodelled_detour=2.0)
STATION = np.array([1.0, 2.0, 2.5])
AZIMUTH, ZENITH, LENGTH = 0.7, 1.9, 9.0


def path_to(azimuth: float, zenith: float, length: float | None, settings: FusionSettings = SETTINGS) -> UnmodelledPath:
    lengths = () if length is None else ((Term(0.0, length, 0.25),),)
    seen = Observation("a", Direction(azimuth=azimuth, zenith=zenith, cov=3e-4 * np.eye(2)), lengths=lengths)
    terms = [] if length is None else [(0.0, length, 0.25)]
    found = unmodelled_path(seen, terms, STATION, -np.log(30.0), settings)
    assert found is not None
    return found


def densities(path: UnmodelledPath, places: Array, spread: float = 0.0) -> Array:
    return np.array([unmodelled_density(tuple(path), *place, spread)[0] for place in places])


def test_slices_have_the_moments_of_an_exponential_density() -> None:
    share, mean, variance = np.array(detours()).T
    assert share.sum() == pytest.approx(1.0)
    assert share @ mean == pytest.approx(1.0)
    assert share @ (variance + mean**2) == pytest.approx(2.0)
    ends = [0.0, 0.35, 0.9, 1.9, np.inf]
    for n in range(4):
        assert share[n] == pytest.approx(quad(lambda t: np.exp(-t), *ends[n : n + 2])[0])
        assert share[n] * mean[n] == pytest.approx(quad(lambda t: t * np.exp(-t), *ends[n : n + 2])[0])


@pytest.mark.parametrize("timed", [True, False])
def test_the_density_of_measurements_integrates_to_its_probability(timed: bool) -> None:
    """Over all directions, and all lengths or those that a time may be: of a path to a place along the x axis."""
    settings = replace(SETTINGS, unmodelled_without_length=0.2)
    place = STATION + np.array([[6.0, 0.0, 0.0]])
    node, weight = np.polynomial.legendre.leggauss(60)
    angle = np.pi * (0.5 * (node + 1.0)) ** 2  # most nodes where the density is sharp
    weight = weight * 0.5 * np.pi * (node + 1.0) * 2.0 * np.pi * np.sin(angle)
    step = 0.2
    lengths = np.arange(2.0, 30.0, step).tolist() if timed else [None]
    of_length = [
        sum(
            w * densities(path_to(a, 0.5 * np.pi, length, settings), place)[0]
            for a, w in zip(angle, weight, strict=True)
        )
        for length in lengths
    ]
    assert sum(of_length) * (step if timed else 30.0) == pytest.approx(0.2, rel=1e-3)


@pytest.mark.parametrize("length", [LENGTH, None])
def test_gaussians_stand_for_the_density(length: float | None) -> None:
    """Where the density is high, their sum is within 45 % at nine of ten places, and within 12 % in the mean.

    The density of such paths is a guess within a factor, so that is enough.
    """
    settings = replace(SETTINGS, unmodelled_without_length=0.2)
    path = path_to(AZIMUTH, ZENITH, length, settings)
    log_mass, mean, cov = unmodelled_gaussians(tuple(path), 20.0)
    rng = np.random.default_rng(1)
    headings = direction(AZIMUTH + rng.normal(0.0, 0.2, 4000), ZENITH + rng.normal(0.0, 0.2, 4000))
    distance = rng.uniform(1.0, 9.0, 4000) if length is not None else rng.uniform(1.0, 15.0, 4000)
    places = STATION + distance[:, None] * headings
    exact = densities(path, places)
    found = np.zeros(len(places))
    for n in range(len(log_mass)):
        apart = places - mean[n, :3]
        root = np.linalg.cholesky(cov[n, :3, :3])
        white = np.linalg.solve(root, apart.T)
        log_norm = log_mass[n] - 1.5 * np.log(2.0 * np.pi) - np.log(np.diag(root)).sum()
        found += np.exp(log_norm - 0.5 * (white**2).sum(axis=0))
    # The narrow part's needle is sharper in angle than the points lie: the broad part is what they see.
    high = exact > 0.1 * np.quantile(exact, 0.99)
    ratio = found[high] / exact[high]
    assert abs(np.mean(np.log(ratio))) < 0.12
    assert np.quantile(np.abs(np.log(ratio)), 0.9) < 0.45


def test_surroundings_are_averaged_over() -> None:
    """Over a cube whose positions have a variance, the density averages to that of the blurred one."""
    path = path_to(AZIMUTH, ZENITH, LENGTH)
    place, side = STATION + 6.5 * direction(AZIMUTH + 0.1, ZENITH), 0.5
    grid = (np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 24, endpoint=False)] * 3), -1) + 0.5 / 24).reshape(-1, 3)
    mean = densities(path, place + side * grid).mean()
    assert densities(path, place[None], side**2 / 12.0)[0] == pytest.approx(mean, rel=0.05)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Table:
    return open_room_table(tmp_path_factory.mktemp("room") / "room.h5")


TRUTH = np.array([2.2, 3.7, 1.1])


def report_with_one_bent_path(bend_deg: float, stdev_deg: float) -> Report:
    """Four stations with angles and times; the first has a path bent by some degrees and half a metre longer."""
    measurements: list[Angle | Range] = []
    for n, (name, position) in enumerate(POSITIONS.items()):
        azimuth, zenith = (float(v) for v in angles_of(TRUTH - position))
        bend, longer = (np.deg2rad(bend_deg), 0.5) if n == 0 else (0.0, 0.0)
        stdev = float(np.deg2rad(stdev_deg))
        measurements += [
            Angle(station_id=name, azimuth=azimuth + bend, zenith=zenith, azimuth_stdev=stdev, zenith_stdev=stdev),
            Range(station_id=name, path_length=float(np.linalg.norm(TRUTH - position)) + longer, stdev=0.3),
        ]
    return Report(measurements=tuple(measurements))


def located(table: Table, report: Report, probability: float) -> Fix:
    return Locator(table, FusionSettings(unmodelled_probability=probability)).locate(report)


def test_a_bent_path_is_told_from_the_others(table: Table) -> None:
    """Its angle is an outlier, and so is its time."""
    fix = located(table, report_with_one_bent_path(25.0, 3.0), 0.1)
    assert fix.status == "ok"
    assert fix.outcomes[0].outlier_probability is not None
    assert fix.outcomes[0].outlier_probability > 0.99
    assert all(o.outlier_probability is not None and o.outlier_probability < 0.1 for o in fix.outcomes[2:])
    assert fix.position is not None
    assert np.linalg.norm(fix.position - TRUTH) < 0.25


def test_a_path_that_hardly_bends_makes_the_region_larger(table: Table) -> None:
    """Four deviations off: no outlier, but doubtful, which the region shows."""
    report = report_with_one_bent_path(12.0, 3.0)
    without, with_term = located(table, report, 0.0), located(table, report, 0.1)
    assert without.regions is not None
    assert with_term.regions is not None
    assert with_term.outcomes[0].outlier_probability is not None
    assert without.outcomes[0].outlier_probability is not None
    assert with_term.outcomes[0].outlier_probability > without.outcomes[0].outlier_probability + 0.2


def test_regions_of_inconsistent_fixes_are_stretched(table: Table) -> None:
    sound = report_with_one_bent_path(0.0, 3.0)
    bent = [
        replace(m, azimuth=m.azimuth + 0.8) if isinstance(m, Angle) and m.station_id in "ab" else m
        for m in sound.measurements
    ]
    fix = located(table, Report(measurements=tuple(bent)), 0.1)
    assert fix.status == "inconsistent"
    assert fix.regions is not None
    assert fix.regions.stretch == 1.5
    agreed = located(table, sound, 0.1).regions
    assert agreed is not None
    assert agreed.stretch == 1.0


def test_no_probability_leaves_everything_as_it_is() -> None:
    none = FusionSettings(unmodelled_probability=0.0)
    seen = Observation(
        "a", Direction(azimuth=0.5, zenith=1.5, cov=3e-4 * np.eye(2)), lengths=((Term(0.0, 5.0, 0.25),),)
    )
    assert unmodelled_path(seen, [(0.0, 5.0, 0.25)], STATION, -3.0, none) is None
    assert unmodelled_path(seen._replace(lengths=()), [], STATION, -3.0, SETTINGS) is None


def test_a_known_line_of_sight_leaves_little_to_bent_paths() -> None:
    seen = Observation(
        "a", Direction(azimuth=0.5, zenith=1.5, cov=3e-4 * np.eye(2)), lengths=((Term(0.0, 5.0, 0.25),),)
    )
    lengths = [(0.0, 5.0, 0.25)]
    plain = unmodelled_path(seen, lengths, STATION, -3.0, SETTINGS)
    direct = unmodelled_path(seen._replace(los_probability=1.0), lengths, STATION, -3.0, SETTINGS)
    assert plain is not None
    assert direct is not None
    assert direct.terms[:, 0].sum() == pytest.approx(2.0 * SETTINGS.sight_error * plain.terms[:, 0].sum())
