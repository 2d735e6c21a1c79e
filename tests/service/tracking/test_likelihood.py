"""The likelihood of a report is its posterior without the prior."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from rayfix_service.fusion.measurements.report import Height
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import height_prior
from rayfix_service.tracking.likelihood import likelihood_of
from rayfix_tables.freespace import FreeSpace

HEIGHT = Height(z=1.2, stdev=0.3)

LOG_VOLUME = 5.0


def random_hypotheses(rng: np.random.Generator, count: int = 4) -> Hypotheses:
    roots = rng.normal(size=(count, 3, 3))
    return Hypotheses(
        log_weight=rng.normal(size=count),
        mean=rng.normal(scale=2.0, size=(count, 3)),
        cov=roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(3),
        outlier=np.zeros((count, 1), np.int8),
        log_all_outlier=-7.0,
    )


def test_times_the_uniform_prior_it_is_the_product():
    rng = np.random.default_rng(3)
    hypotheses = random_hypotheses(rng)
    points = rng.normal(scale=2.0, size=(50, 3))
    product = sum(
        np.exp(w) * multivariate_normal(m, c).pdf(points)
        for w, m, c in zip(hypotheses.log_weight, hypotheses.mean, hypotheses.cov, strict=True)
    )
    expected = np.log(product + np.exp(hypotheses.log_all_outlier - LOG_VOLUME))
    found = likelihood_of(hypotheses, LOG_VOLUME).log_density(points) - LOG_VOLUME
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_what_counts_of_the_height_weighs_by_the_distance_from_it(share: float, free_space: FreeSpace):
    rng = np.random.default_rng(4)
    hypotheses = random_hypotheses(rng)
    points = rng.normal(size=(20, 3))
    height = height_prior(HEIGHT, free_space)
    without = likelihood_of(hypotheses, LOG_VOLUME).log_density(points)
    found = likelihood_of(hypotheses, LOG_VOLUME, height=height, height_share=share)
    ratio = found.log_density(points) - without
    np.testing.assert_allclose(ratio, -0.5 * share * ((points[:, 2] - HEIGHT.z) / HEIGHT.stdev) ** 2, atol=1e-8)


def test_no_direction_has_a_negative_precision(free_space: FreeSpace):
    """However sharp the height and however wide the hypotheses: nothing is divided out."""
    hypotheses = random_hypotheses(np.random.default_rng(5))
    for share in (0.0, 0.1, 1.0):
        height = height_prior(Height(z=1.2, stdev=0.01), free_space)
        information = likelihood_of(hypotheses, LOG_VOLUME, height=height, height_share=share).information
        assert np.linalg.eigvalsh(information).min() >= -1e-9
