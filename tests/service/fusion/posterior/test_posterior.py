"""The whole posterior: density, samples and evidence, among solids and at a known height."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from rayfix_service.fusion.measurements.report import Angle, Height, Report, TimeOfArrival
from rayfix_service.fusion.posterior.posterior import Posterior, free_shares, make_posterior
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import Prior, height_prior, uniform_prior
from rayfix_service.locator import Locator
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.table import Table
from tests.support.oracles import kernel_twins

Array = NDArray[np.float64]

# 4 x 4 x 2 m with a pillar, a lowered ceiling over one half, and a box that nobody can be in.
FREE = np.ones((20, 20, 10), np.bool_)
FREE[8:11, 8:12] = False
FREE[:8, :, 7:] = False
FREE[14:18, 3:9, :4] = False
SPACE = FreeSpace(origin=np.array([-1.0, 2.0, 0.5]), voxel_size=0.2, free=FREE)


def hypotheses(seed: int, count: int = 12, lost: float = 0.1) -> Hypotheses:
    """Wide Gaussians, many of them partly in solids; a log evidence of about -7."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((count, 3, 3)) + 1.2 * np.eye(3)
    return Hypotheses(
        log_weight=np.log(rng.dirichlet(np.ones(count))) - 7.0,
        mean=rng.uniform([-1.0, 2.0, 0.5], [3.0, 6.0, 2.5], (count, 3)),
        cov=0.06 * root @ root.transpose(0, 2, 1) + 0.01 * np.eye(3),
        outlier=np.zeros((count, 1), np.int8),
        log_all_outlier=math.log(lost) - 7.0,
    )


PRIORS = {"even": uniform_prior(SPACE), "height": height_prior(Height(z=1.3, stdev=0.3), SPACE)}


def grid(step: int) -> tuple[Array, float]:
    """Middles of the cells that free voxels are cut into, and their volume, m3."""
    corners = np.argwhere(FREE)
    inner = (np.stack(np.meshgrid(*[np.arange(step)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / step
    places = SPACE.origin + SPACE.voxel_size * (corners[:, None, :] + inner).reshape(-1, 3)
    return places, (SPACE.voxel_size / step) ** 3


@pytest.mark.parametrize("prior", [*PRIORS])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_density_integrates_to_one_over_the_free_space(seed: int, prior: str) -> None:
    posterior = make_posterior(hypotheses(seed), PRIORS[prior], SPACE)
    places, volume = grid(3)
    density = np.exp(posterior.log_density(places))
    assert density.sum() * volume == pytest.approx(1.0, abs=0.005)
    # Before the cut a good part lay in solids.
    assert 0.2 < np.exp(posterior.log_weight).sum() - (1.0 - posterior.prior_share) < 3.0


@pytest.mark.parametrize("prior", [*PRIORS])
def test_the_density_is_that_of_the_twin_in_the_free_space_and_none_elsewhere(prior: str) -> None:
    given = hypotheses(3)
    posterior = make_posterior(given, PRIORS[prior], SPACE)
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.5, 1.5, 0.0], [3.5, 6.5, 3.0], (3000, 3))
    free = SPACE.contains(points)
    assert 0.2 < free.mean() < 0.8
    height = Height(z=1.3, stdev=0.3)
    z = points[free, 2]
    flat = np.full(len(z), 1.0) if prior == "even" else np.exp(-0.5 * ((z - height.z) / height.stdev) ** 2)
    places, volume = grid(4)
    whole = len(places) * volume
    if prior == "height":
        whole = float(np.exp(-0.5 * ((places[:, 2] - height.z) / height.stdev) ** 2).sum()) * volume
    joint = np.exp(kernel_twins.mixture_log_density(points[free], given.log_weight, given.mean, given.cov))
    joint += np.exp(given.log_all_outlier) * flat / whole
    found = posterior.log_density(points)
    np.testing.assert_allclose(found[free] + posterior.log_evidence, np.log(joint), rtol=0, atol=2e-3)
    assert (found[~free] == -np.inf).all()


@pytest.mark.parametrize("prior", [*PRIORS])
@pytest.mark.parametrize("lost", [1e-9, 0.5, 100.0])
def test_samples_are_of_the_density(prior: str, lost: float) -> None:
    """Counts in blocks of voxels against the density's integral there, by Pearson's test."""
    posterior = make_posterior(hypotheses(4, lost=lost), PRIORS[prior], SPACE)
    count = 40_000
    drawn = posterior.sample(count, np.random.default_rng(5))
    assert drawn.shape == (count, 3)
    assert SPACE.contains(drawn).all()
    places, volume = grid(3)
    expected = np.exp(posterior.log_density(places)) * volume
    blocks = [((p - SPACE.origin) / 0.8).astype(np.int64) @ np.array([100, 10, 1]) for p in (places, drawn)]
    share = np.bincount(blocks[0], expected, 1000)
    share /= share.sum()
    tally = np.bincount(blocks[1], minlength=1000)
    often = count * share > 20
    statistic = ((tally - count * share)[often] ** 2 / (count * share)[often]).sum()
    assert tally[~often].sum() <= 40 * max((~often & (share > 0)).sum(), 1)
    assert statistic < chi2.ppf(0.9999, often.sum() - 1)
    # And a picture with the samples shuffled up would not pass.
    assert ((tally[often] - count / often.sum()) ** 2 / (count * share)[often]).sum() > 10 * statistic


def test_samples_of_a_known_height_stay_free_at_the_edges_of_voxels() -> None:
    """Of half a million, hundreds are within a millimetre of an edge."""
    posterior = make_posterior(None, PRIORS["height"], SPACE)
    drawn = posterior.sample(500_000, np.random.default_rng(6))
    assert SPACE.contains(drawn).all()


def test_samples_follow_from_the_generator() -> None:
    posterior = make_posterior(hypotheses(4), PRIORS["even"], SPACE)
    one, same = (posterior.sample(50, np.random.default_rng(8)) for _ in range(2))
    np.testing.assert_array_equal(one, same)
    assert (posterior.sample(50, np.random.default_rng(9)) != one).any()
    assert posterior.sample(0, np.random.default_rng(9)).shape == (0, 3)


def test_free_shares_are_those_of_samples() -> None:
    given = hypotheses(6)
    rng = np.random.default_rng(1)
    drawn = [
        SPACE.contains(rng.multivariate_normal(m, c, 40_000)).mean() for m, c in zip(given.mean, given.cov, strict=True)
    ]
    np.testing.assert_allclose(free_shares(given.mean, given.cov, SPACE), drawn, rtol=0, atol=0.03)


def test_without_hypotheses_the_posterior_is_the_prior() -> None:
    for nothing in (None, hypotheses(0, count=0)):
        posterior = make_posterior(nothing, PRIORS["even"], SPACE)
        assert posterior.prior_share == 1.0
        density = np.exp(posterior.log_density(SPACE.origin + 0.1))
        assert density == pytest.approx(1.0 / SPACE.volume)
        assert SPACE.contains(posterior.sample(100, np.random.default_rng(0))).all()


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> Locator:
    return Locator(Table.open(hall_table_path))


def report(height: Height | None = None) -> Report:
    """Three angles and arrivals of the bundled hall, from about (7, 4, 1.5)."""
    stdev = math.radians(2.0)
    seen = {"bs1": (29.9, 96.1, 7.8), "bs2": (102.4, 103.3, 4.1), "bs3": (-93.2, 93.1, 14.0)}
    angles = [
        Angle(station_id=n, azimuth=math.radians(a), zenith=math.radians(z), azimuth_stdev=stdev, zenith_stdev=stdev)
        for n, (a, z, _) in seen.items()
    ]
    arrivals = [TimeOfArrival(station_id=n, path_length=r + 50.0, stdev=0.5) for n, (*_, r) in seen.items()]
    return Report(measurements=(*angles, *arrivals), height=height)


def mean_of(posterior: Posterior) -> tuple[Array, Array]:
    drawn = posterior.sample(20_000, np.random.default_rng(2))
    return drawn.mean(axis=0), np.cov(drawn.T)


def test_samples_lie_where_the_fix_says(locator: Locator) -> None:
    fix = locator.locate(report())
    best = fix.candidates[0]
    assert best.probability > 0.95
    posterior = locator.posterior(report())
    assert posterior.log_evidence == pytest.approx(fix.log_evidence, abs=0.1)
    drawn = posterior.sample(5000, np.random.default_rng(2))
    apart = drawn - best.position
    inside = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(best.covariance), apart) < chi2.ppf(0.95, 3)
    assert inside.mean() > 0.85
    # At the fix there is more than almost anywhere.
    heights = posterior.log_density(drawn)
    assert posterior.log_density(best.position)[0] > np.quantile(heights, 0.6)


def test_a_known_height_moves_the_whole_posterior(locator: Locator) -> None:
    free, cov = mean_of(locator.posterior(report()))
    known, left = mean_of(locator.posterior(report(Height(z=free[2] + 0.1, stdev=0.02))))
    assert known[2] == pytest.approx(free[2] + 0.1, abs=0.01)
    assert left[2, 2] < 0.1 * cov[2, 2]


def test_evidence_compares_reports(locator: Locator) -> None:
    """Measurements that agree are likelier than the same with one of them off."""
    good = report()
    off = Report(measurements=(*good.measurements[:-1], TimeOfArrival(station_id="bs3", path_length=70.0, stdev=0.5)))
    assert locator.posterior(good).log_evidence > locator.posterior(off).log_evidence + 3.0


def test_prior_is_normalised_over_the_free_space() -> None:
    places, volume = grid(4)
    for prior in PRIORS.values():
        assert isinstance(prior, Prior)
        logs = prior.eta * places[:, 2] - 0.5 * prior.precision * places[:, 2] ** 2 - prior.log_volume
        assert np.exp(logs).sum() * volume == pytest.approx(1.0, abs=2e-3)
