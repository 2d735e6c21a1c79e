"""Whole fixes on tables by hand, against their closed form."""

from dataclasses import replace

import numpy as np
import pytest

from rayfix_service.fusion.measurements.report import (
    HEAVY_TAILED,
    Angle,
    ErrorModel,
    Height,
    LogRange,
    Measurement,
    Range,
    TimeDifference,
)
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from rayfix_tables.errors import ReportError
from rayfix_tables.geometry.angles import direction
from rayfix_tables.site import Station, StationBias
from tests.support.messages.hand_reports import EXACT, TUBES, angle_of, differences, measured, report_of
from tests.support.oracles.gaussian_oracle import Posterior, oracle
from tests.support.tables.hand_tables import GRID, POSITIONS, UE, MakeTable, line_of_sight


def assert_equal(fix: Fix, expected: Posterior) -> None:
    assert fix.log_evidence == pytest.approx(expected.log_evidence, abs=1e-5)  # nats
    assert len(fix.candidates) == 1
    assert fix.candidates[0].probability == pytest.approx(1.0 - expected.lost, abs=1e-6)
    np.testing.assert_allclose(fix.candidates[0].position, expected.mean, rtol=0, atol=1e-6)  # m
    # m2, about 1e-2: of the oracle's hypotheses the far ones, of a probability of 1e-6, are a mode of their own.
    np.testing.assert_allclose(fix.candidates[0].covariance, expected.cov, rtol=0, atol=5e-6)
    assert [outcome.outlier_probability for outcome in fix.outcomes] == pytest.approx(expected.outlier, abs=1e-6)


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
    never = FusionSettings(outlier_probability=1e-15, unmodelled_probability=0.0, max_divergence=0.0)
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
