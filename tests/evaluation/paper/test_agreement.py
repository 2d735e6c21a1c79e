"""rayfix's closed forms are the limit of the paper's algorithms with many points.

The table holds the paper's prior (points along rays alike), outliers are switched off, and what is compared is the
posterior before it is cut to the free space, which the paper does not do.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_evaluation.paper.algorithms import PaperSettings, algorithm_1, algorithm_2_joint
from rayfix_evaluation.paper.locate import PaperLocator
from rayfix_evaluation.paper.mixtures import Mixture, multiply
from rayfix_evaluation.paper.points import Launcher, RayPoints, draw_directions, points_on_rays
from rayfix_evaluation.paper.selection import RelativeLength, select_by_length
from rayfix_service.fusion.measurements.directions import NO_DIRECTION, Direction
from rayfix_service.fusion.measurements.observations import sort_report
from rayfix_service.fusion.measurements.report import Angle, Measurement, Range, Report, TimeDifference
from rayfix_service.fusion.product import beam
from rayfix_service.fusion.product.factors import make_factor
from rayfix_service.fusion.product.prior import Prior
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.geometry.angles import angles_of
from rayfix_tables.table import Table

Array = NDArray[np.float64]

UE = np.array([1.6, 3.4, 1.1])
NO_OUTLIERS = FusionSettings(
    outlier_probability=1e-9, unmodelled_probability=0.0, component_floor=1e-9, beam_width=200_000
)
STDEV = float(np.deg2rad(1.0))


def place(table: Table, name: str) -> Array:
    (station,) = [s for s in table.site.stations if s.id == name]
    return np.array(station.position)


def angle_to(table: Table, name: str) -> Angle:
    """Direction to the UE, a little off."""
    azimuth, zenith = angles_of(UE - place(table, name))
    return Angle(
        station_id=name,
        azimuth=float(azimuth) + 0.004,
        zenith=float(zenith) - 0.006,
        azimuth_stdev=STDEV,
        zenith_stdev=STDEV,
    )


def range_to(table: Table, name: str, stdev: float) -> Range:
    """Distance of the UE and 0.1 m."""
    return Range(station_id=name, path_length=float(np.linalg.norm(UE - place(table, name))) + 0.1, stdev=stdev)


def closed_form(table: Table, *measurements: Measurement) -> tuple[Array, Array]:
    """Mean and covariance of rayfix's posterior before the cut to the free space."""
    sorted_report = sort_report(Report(measurements=measurements), table.site)
    limits = {"max_path_length": table.site.max_path_length, "prior": Prior(log_volume=float(np.log(60.0)))}
    factors = []
    for observation in sorted_report.observations:
        station = StationMixtures(table.parts[observation.station_id])
        factor = make_factor(observation, station, num_clocks=sorted_report.num_clocks, settings=NO_OUTLIERS, **limits)
        assert factor is not None
        factors.append(factor)
    found = beam.multiply(
        factors,
        width=NO_OUTLIERS.beam_width,
        max_divergence=NO_OUTLIERS.max_divergence,
        **limits,
    )
    return Mixture(log_weight=found.log_weight, mean=found.mean, cov=found.cov).moments()


def points_towards(table: Table, name: str, count: int, angle: Angle | None, step: float = 0.03) -> RayPoints:
    rng = np.random.default_rng([7, ord(name)])
    measured = NO_DIRECTION
    if angle is not None:
        cov = np.diag([angle.azimuth_stdev**2, STDEV**2])
        measured = Direction(azimuth=angle.azimuth, zenith=angle.zenith, cov=cov)
    directions = draw_directions(measured, count, rng)
    return points_on_rays(Launcher.of_table(table), place(table, name), directions, step=step, rng=rng)


def assert_close(found: tuple[Array, Array], expected: tuple[Array, Array], share: float) -> None:
    """Means within a share of the expected deviations, deviations within the same share of themselves."""
    deviation = np.sqrt(np.diag(expected[1]))
    np.testing.assert_array_less(np.abs(found[0] - expected[0]) / deviation, share)
    np.testing.assert_allclose(np.sqrt(np.diag(found[1])) / deviation, 1.0, rtol=0, atol=share)
    correlation = expected[1] / np.outer(deviation, deviation)
    np.testing.assert_allclose(found[1] / np.outer(deviation, deviation), correlation, rtol=0, atol=2.0 * share)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a", "b", "c"])
@pytest.mark.parametrize("stdev", [0.5, 0.2, None])
def test_reweighting_is_the_selection_of_points(room_table: Table, name: str, stdev: float | None) -> None:
    """Algorithm 1 with AoA, up to its fit: thousands of rays, tens of thousands of selected points."""
    angle = angle_to(room_table, name)
    points = points_towards(room_table, name, 4000, angle)
    times: list[Measurement] = []
    if stdev is not None:
        measured = range_to(room_table, name, stdev)
        points = select_by_length(points, measured.path_length, stdev, np.random.default_rng(2))
        times.append(measured)
    selected = points.position
    expected = closed_form(room_table, angle, *times)
    # 4,000 independent rays: the Monte-Carlo error of a mean is 0.016 deviations; the rest is the table's fit.
    assert_close((selected.mean(axis=0), np.cov(selected.T)), expected, 0.06)


@pytest.mark.slow
def test_reweighting_without_an_angle_is_the_selection_of_points(room_table: Table) -> None:
    """Algorithm 1 without AoA: rays from all around, a shell of points."""
    measured = range_to(room_table, "a", 0.5)
    points = points_towards(room_table, "a", 40_000, None)
    selected = select_by_length(points, measured.path_length, 0.5, np.random.default_rng(2)).position
    assert_close((selected.mean(axis=0), np.cov(selected.T)), closed_form(room_table, measured), 0.06)


@pytest.mark.slow
@pytest.mark.parametrize("order", ["select_first", "fit_first"])
def test_the_product_is_that_of_the_fits(room_table: Table, order: str) -> None:
    """Algorithm 1 in both orders, EM and product, for three stations."""
    settings = PaperSettings(num_points=20_000, num_components=20, order=order)  # type: ignore[arg-type]
    measurements: list[Measurement] = []
    mixtures = []
    for name in "abc":
        angle, measured = angle_to(room_table, name), range_to(room_table, name, 0.5)
        measurements += [angle, measured]
        points = points_towards(room_table, name, 2000, angle)
        fitted = algorithm_1(points, (measured.path_length, 0.5), settings, np.random.default_rng(5))
        assert fitted is not None
        mixtures.append(fitted)
    expected = closed_form(room_table, *measurements)
    # EM widens the thin tubes by its floor of 2 cm, where the posterior's deviations are 4 cm.
    assert_close(multiply(mixtures, 10_000).moments(), expected, 0.15)


@pytest.mark.slow
@pytest.mark.parametrize("stdev", [0.1, 0.5])
def test_time_differences_are_the_pairs_of_algorithm_2(room_table: Table, stdev: float) -> None:
    angles = [angle_to(room_table, name) for name in "ab"]
    lengths = [float(np.linalg.norm(UE - place(room_table, name))) for name in "ab"]
    difference = lengths[1] - lengths[0] + 0.1
    measured = TimeDifference(station_id="b", reference_station_id="a", length_difference=difference, stdev=stdev)
    points = [points_towards(room_table, name, 2000, angle) for name, angle in zip("ab", angles, strict=True)]
    settings = PaperSettings(num_points=20_000, num_components=20, bins_per_stdev=8)
    found = algorithm_2_joint(
        points[0],
        [points[1]],
        [RelativeLength(length_difference=difference, stdev=stdev)],
        settings,
        np.random.default_rng(4),
    )
    assert found is not None
    assert_close(found.moments(), closed_form(room_table, *angles, measured), 0.15)
    # The time says something: without it the answer would be told from this one.
    if stdev < 0.2:
        without = closed_form(room_table, *angles)
        assert np.linalg.norm(without[0] - found.moments()[0]) > 0.01


@pytest.mark.slow
def test_a_report_is_located(room_table: Table) -> None:
    """The paper's method as a whole finds the UE to within some deviations, 4 cm, by propagation times and by RPTs."""
    locator = PaperLocator.of_table(room_table)
    angles: list[Measurement] = [angle_to(room_table, name) for name in "abc"]
    ranges: list[Measurement] = [range_to(room_table, name, 0.5) for name in "abc"]
    lengths = {name: float(np.linalg.norm(UE - place(room_table, name))) for name in "abc"}
    differences: list[Measurement] = [
        TimeDifference(station_id=n, reference_station_id="a", length_difference=lengths[n] - lengths["a"], stdev=0.3)
        for n in "bc"
    ]
    for times in ([], ranges, differences):
        found = locator.locate(Report(measurements=(*angles, *times)), np.random.default_rng(1))
        assert found is not None
        assert np.linalg.norm(found - UE) < 0.15


@pytest.mark.slow
def test_nothing_agrees_and_nothing_is_found(room_table: Table) -> None:
    locator = PaperLocator.of_table(room_table)
    far = Range(station_id="a", path_length=500.0, stdev=0.5)
    assert locator.locate(Report(measurements=(far,)), np.random.default_rng(1)) is None
