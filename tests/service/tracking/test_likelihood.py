"""The likelihood of a report is its posterior without the prior."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from rayfix_service.fusion.measurements.report import Height
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import height_prior, uniform_prior
from rayfix_service.tracking.likelihood import likelihood_of
from rayfix_tables.freespace import FreeSpace

HEIGHT = Height(z=1.2, stdev=0.3)


def random_hypotheses(rng: np.random.Generator, count: int = 4) -> Hypotheses:
    roots = rng.normal(size=(count, 3, 3))
    # The product with a known height is no wider than that.
    precision = np.linalg.inv(roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(3))
    precision[:, 2, 2] += HEIGHT.stdev**-2
    return Hypotheses(
        log_weight=rng.normal(size=count),
        mean=rng.normal(scale=2.0, size=(count, 3)),
        cov=np.linalg.inv(precision),
        outlier=np.zeros((count, 1), np.int8),
        log_all_outlier=-7.0,
    )


@pytest.mark.parametrize("known", [False, True])
def test_times_the_prior_it_is_the_product(known: bool, free_space: FreeSpace):
    rng = np.random.default_rng(3)
    hypotheses = random_hypotheses(rng)
    prior = height_prior(HEIGHT, free_space) if known else uniform_prior(free_space)
    points = rng.normal(scale=2.0, size=(50, 3))
    log_prior = prior.eta * points[:, 2] - 0.5 * prior.precision * points[:, 2] ** 2 - prior.log_volume
    product = sum(
        np.exp(w) * multivariate_normal(m, c).pdf(points)
        for w, m, c in zip(hypotheses.log_weight, hypotheses.mean, hypotheses.cov, strict=True)
    )
    expected = np.log(product + np.exp(hypotheses.log_all_outlier + log_prior))
    found = likelihood_of(hypotheses, prior, height_share=0.0).log_density(points) + log_prior
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_what_is_left_of_the_height_weighs_by_the_distance_from_it(free_space: FreeSpace):
    rng = np.random.default_rng(4)
    hypotheses = random_hypotheses(rng)
    points = rng.normal(size=(20, 3))
    prior = height_prior(HEIGHT, free_space)
    without, some = (likelihood_of(hypotheses, prior, height_share=s).log_density(points) for s in (0.0, 0.25))
    lost = np.exp(hypotheses.log_all_outlier)  # says nothing of the height either way
    ratio = np.log(np.exp(some) - lost) - np.log(np.exp(without) - lost)
    np.testing.assert_allclose(ratio, -0.25 * 0.5 * ((points[:, 2] - HEIGHT.z) / HEIGHT.stdev) ** 2, atol=1e-8)
