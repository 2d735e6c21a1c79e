"""Time differences and times of arrival with an unknown clock, on tables by hand."""

from dataclasses import replace

import numpy as np
import pytest

from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    HEAVY_TAILED,
    Angle,
    ErrorModel,
    Measurement,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from tests.support.messages.hand_reports import EXACT, TUBES, differences, measured, report_of
from tests.support.oracles.gaussian_oracle import Product
from tests.support.tables.hand_tables import MakeTable


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
    never = FusionSettings(outlier_probability=1e-15, unmodelled_probability=0.0, max_divergence=0.0)
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
