"""Sums of Gaussians that stand for likelihoods, against the likelihoods."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from rayfix_service.fusion.measurements.likelihood import (
    Term,
    gaussian_terms,
    log_normal_terms,
    product,
    spreads,
    total_variance,
)
from rayfix_service.fusion.measurements.report import GAUSSIAN, HEAVY_TAILED, ErrorModel

PATHS = np.linspace(0.01, 200.0, 40_000)


def density(terms: tuple[Term, ...], path: np.ndarray) -> np.ndarray:
    return np.asarray(sum(math.exp(t.log_weight) * norm.pdf(path, t.value, math.sqrt(t.variance)) for t in terms))


def test_a_contaminated_gaussian_is_its_two_parts() -> None:
    terms = gaussian_terms(7.0, 0.5, ErrorModel(tail_share=0.25, tail_scale=4.0))
    expected = 0.75 * norm.pdf(PATHS, 7.0, 0.5) + 0.25 * norm.pdf(PATHS, 7.0, 2.0)
    np.testing.assert_allclose(density(terms, PATHS), expected, rtol=1e-12, atol=1e-300)
    assert total_variance(terms) == pytest.approx(0.75 * 0.25 + 0.25 * 4.0)


@pytest.mark.parametrize("model", [GAUSSIAN, ErrorModel(tail_share=0.3), ErrorModel(tail_scale=5.0)])
def test_no_tail_is_one_gaussian(model: ErrorModel) -> None:
    assert spreads(model) == ((0.0, 1.0),)


def test_the_documented_tails() -> None:
    assert math.exp(spreads(HEAVY_TAILED)[1].log_weight) == pytest.approx(0.1)
    assert spreads(HEAVY_TAILED)[1].scale == 3.0


@pytest.mark.parametrize("log_stdev", [0.01, 0.04, 0.06, 0.2, 0.3, 0.46, 0.7, 1.1, 1.5])
@pytest.mark.parametrize("value", [1.5, 8.0])
def test_a_log_normal_likelihood_is_met_to_a_few_per_cent(value: float, log_stdev: float) -> None:
    terms = log_normal_terms(value, log_stdev)
    expected = norm.pdf(np.log(value / PATHS), scale=log_stdev) / value
    found = density(terms, PATHS)
    assert np.abs(found - expected).sum() < 0.04 * expected.sum()
    if log_stdev < 1.5:
        assert np.abs(found - expected).max() < 0.07 * expected.max()
    # Its integral over all path lengths has a closed form.
    assert sum(math.exp(t.log_weight) for t in terms) == pytest.approx(math.exp(0.5 * log_stdev**2), rel=1e-12)
    # Of one Gaussian in its place a fifth or more would be wrong.
    if log_stdev >= 0.3:
        middle = value * math.exp(1.5 * log_stdev**2)
        single = expected.sum() * norm.pdf(PATHS, middle, middle * math.sqrt(math.expm1(log_stdev**2)))
        single *= PATHS[1] - PATHS[0]
        assert np.abs(single - expected).sum() > 0.2 * expected.sum()


def test_a_log_normal_scales_with_its_length() -> None:
    near, far = log_normal_terms(2.0, 0.5), log_normal_terms(6.0, 0.5)
    for one, three in zip(near, far, strict=True):
        assert (three.log_weight, three.value) == pytest.approx((one.log_weight, 3.0 * one.value))
        assert three.variance == pytest.approx(9.0 * one.variance)


@pytest.mark.parametrize("bias_stdev", [0.0, 0.4])
def test_a_product_is_the_integral_over_the_common_error(bias_stdev: float) -> None:
    terms = (Term(-0.3, 7.0, 0.25), Term(0.2, 7.9, 0.5), Term(-1.0, 6.6, 0.09))
    path = np.linspace(4.0, 10.0, 61)
    bias = np.linspace(-6.0, 6.0, 4001) * max(bias_stdev, 1e-3)
    weight = norm.pdf(bias, scale=max(bias_stdev, 1e-3)) * (bias[1] - bias[0])
    at = path[:, None] + bias
    together = math.prod(density((term,), at) for term in terms)
    expected = np.asarray(together) @ weight
    found = density((product(terms, bias_stdev**2),), path)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-9)
    assert product(terms[:1], 0.0) == pytest.approx(terms[0])
