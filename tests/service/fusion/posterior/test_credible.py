"""Credible regions: Gaussians in the open, several modes, walls, and what holds of any points."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

from rayfix_service.fusion.posterior.credible import CredibleRegions, Ellipsoid
from rayfix_service.fusion.posterior.points import DrawnPoints, draw_points
from rayfix_service.fusion.posterior.posterior import make_posterior
from rayfix_service.fusion.posterior.principal_axes import semi_axes
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import uniform_prior
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.normal_points import normal_points
from tests.support.oracles import kernel_twins

Array = NDArray[np.float64]

POINTS = normal_points(1024)
OPEN = FreeSpace(origin=np.full(3, -50.0), voxel_size=2.0, free=np.ones((50, 50, 50), np.bool_))
COV = np.array([[0.5, 0.2, 0.05], [0.2, 0.3, 0.1], [0.05, 0.1, 0.4]])
SHARES = (0.5, 0.68, 0.9, 0.99)


def points_of(log_weight: Array, mean: Array, cov: Array, free_space: FreeSpace) -> DrawnPoints:
    """Points of a mixture of Gaussians."""
    space = free_space.origin, free_space.voxel_size, free_space.free
    drawn_mean, root, owner = draw_points(log_weight, mean, cov, POINTS, *space)
    return DrawnPoints(mean=drawn_mean, root=root, owner=owner)


def regions_of(
    log_weight: Array, mean: Array, cov: Array, free_space: FreeSpace = OPEN, *, share: float = 1.0
) -> CredibleRegions:
    """Regions around the first of some Gaussians."""
    points = points_of(log_weight, mean, cov, free_space)
    return CredibleRegions(position=mean[0], covariance=cov[0], points=points, share=share)


def around(cov: Array, mean: Array | None = None, *, share: float = 1.0) -> CredibleRegions:
    """Regions of one Gaussian in the open."""
    place = np.array([1.0, 2.0, 3.0]) if mean is None else mean
    return regions_of(np.zeros(1), place[None], cov[None], share=share)


def held(ellipsoid: Ellipsoid, points: Array) -> float:
    return float(np.mean([ellipsoid.holds(point) for point in points]))


def test_regions_are_stretched() -> None:
    regions = around(np.diag([0.04, 0.09, 0.01]))
    larger = replace(regions, stretch=1.5)
    assert larger.horizontal_radius(0.9) == pytest.approx(1.5 * regions.horizontal_radius(0.9))
    assert larger.horizontal_radii([0.5, 0.9]) == pytest.approx([1.5 * r for r in regions.horizontal_radii([0.5, 0.9])])
    assert larger.vertical_half_height(0.9) == pytest.approx(1.5 * regions.vertical_half_height(0.9))
    assert larger.ellipsoid(0.9).semi_axes == pytest.approx(1.5 * regions.ellipsoid(0.9).semi_axes)
    assert larger.upright_ellipsoid(0.9).semi_axes == pytest.approx(1.5 * regions.upright_ellipsoid(0.9).semi_axes)
    assert larger.moved(np.ones(3)).stretch == 1.5


# --- one Gaussian in the open ----------------------------------------------------------------------------


@pytest.mark.parametrize("probability", SHARES)
@pytest.mark.parametrize("stdev", [0.01, 1.0, 4.0])
def test_regions_of_a_gaussian_are_its_quantiles(probability: float, stdev: float) -> None:
    regions = around(stdev**2 * np.diag([1.0, 1.0, 0.25]))
    radius = math.sqrt(chi2.ppf(probability, 3))
    expected = stdev * radius * np.array([1.0, 1.0, 0.5])
    # The shape may be that of the points themselves, which is less exact than their number in it.
    for ellipsoid, tolerance in (
        (regions.ellipsoid(probability), 0.05),
        (regions.upright_ellipsoid(probability), 0.02),
    ):
        lengths = np.linalg.norm(ellipsoid.semi_axes, axis=1)
        np.testing.assert_allclose(lengths, expected, rtol=tolerance)
        assert np.prod(lengths) == pytest.approx(np.prod(expected), rel=0.04)
        assert ellipsoid.probability == probability
    assert regions.horizontal_radius(probability) == pytest.approx(
        stdev * math.sqrt(chi2.ppf(probability, 2)), rel=0.02
    )
    half = 0.5 * stdev * norm.ppf(0.5 + 0.5 * probability)
    assert regions.vertical_half_height(probability) == pytest.approx(half, rel=0.02)


@pytest.mark.parametrize("probability", SHARES)
def test_regions_of_a_slanted_gaussian_hold_what_they_say(probability: float) -> None:
    """Samples tell, also of the upright ellipsoid, which leaves the correlation with the height aside."""
    regions = around(COV)
    drawn = np.random.default_rng(0).multivariate_normal(regions.position, COV, 20_000)
    apart = drawn - regions.position
    tolerance = 0.01 if probability < 0.95 else 0.004
    for ellipsoid in (regions.ellipsoid(probability), regions.upright_ellipsoid(probability)):
        assert held(ellipsoid, drawn) == pytest.approx(probability, abs=tolerance)
    in_circle = np.hypot(*apart[:, :2].T) <= regions.horizontal_radius(probability)
    assert in_circle.mean() == pytest.approx(probability, abs=tolerance)
    in_layer = np.abs(apart[:, 2]) <= regions.vertical_half_height(probability)
    assert in_layer.mean() == pytest.approx(probability, abs=tolerance)


def test_the_ellipsoid_is_of_the_covariances_shape() -> None:
    ellipsoid = around(COV).ellipsoid(0.9)
    values, axes = np.linalg.eigh(COV)
    for found, value, axis in zip(ellipsoid.semi_axes, values[::-1], axes.T[::-1], strict=True):
        assert np.linalg.norm(found) == pytest.approx(math.sqrt(value * chi2.ppf(0.9, 3)), rel=0.05)
        assert abs(found @ axis) == pytest.approx(np.linalg.norm(found), rel=0.02)
        assert ellipsoid.holds(ellipsoid.centre + 0.999 * found)
        assert not ellipsoid.holds(ellipsoid.centre + 1.001 * found)


@pytest.mark.parametrize(
    "stdevs", [(1.0, 1.0, 1.0), (3.0, 1.0, 1.0), (3.0, 3.0, 1.0), (30.0, 1e-3, 1.0), (1.0, 0.0, 0.0)]
)
@pytest.mark.parametrize("seed", range(20))
def test_semi_axes_are_those_of_the_eigenvectors(stdevs: tuple[float, float, float], seed: int) -> None:
    """NumPy's eigenvectors are the oracle; where two axes are as long, only what they span is determined."""
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    shape = rotation @ np.diag(np.square(stdevs)) @ rotation.T
    shape = 0.5 * (shape + shape.T)
    found = semi_axes(shape)
    np.testing.assert_allclose(found.T @ found, shape, atol=1e-14 * shape.trace())
    squares = np.sum(found**2, axis=1)
    np.testing.assert_allclose(squares, np.maximum(np.linalg.eigvalsh(shape)[::-1], 0.0), atol=1e-14 * shape.trace())
    across = found @ found.T - np.diag(squares)
    np.testing.assert_allclose(across, 0.0, atol=1e-14 * shape.trace())


def test_semi_axes_along_the_frame_need_no_rotation() -> None:
    np.testing.assert_allclose(
        semi_axes(np.diag([1.0, 9.0, 4.0])), [[0, 3, 0], [0, 0, 2], [1, 0, 0]], rtol=0, atol=1e-12
    )
    np.testing.assert_array_equal(semi_axes(np.zeros((3, 3))), 0.0)


def test_the_upright_ellipsoid_has_a_vertical_axis() -> None:
    shape = around(COV).upright_ellipsoid(0.9).shape
    np.testing.assert_array_equal(shape[2, :2], 0.0)
    np.testing.assert_allclose(shape[:2, :2] / shape[2, 2], COV[:2, :2] / COV[2, 2], rtol=1e-12)


# --- modes, walls, outliers ------------------------------------------------------------------------------


def two_modes() -> tuple[Array, Array, Array]:
    """Two Gaussians 6 m apart, of 0.7 and 0.3; a log evidence of about -5."""
    mean = np.array([[0.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
    return np.log([0.7, 0.3]) - 5.0, mean, np.stack([0.04 * np.eye(3), 0.09 * np.eye(3)])


def test_a_region_reaches_to_a_rival_where_its_probability_needs_that() -> None:
    log_weight, mean, cov = two_modes()
    regions = regions_of(log_weight, mean, cov)
    half, most = regions.ellipsoid(0.5), regions.ellipsoid(0.9)
    assert not half.holds(mean[1])
    assert np.linalg.norm(half.semi_axes, axis=1).max() < 0.5
    assert most.holds(mean[1])
    assert regions.horizontal_radius(0.65) < 0.7
    assert 5.5 < regions.horizontal_radius(0.8) < 6.5
    # As long as it must be and not as wide: across, the modes are much narrower than they are apart.
    lengths = np.linalg.norm(most.semi_axes, axis=1)
    assert lengths[0] > 6.0
    assert lengths[1] < 0.3 * lengths[0]


@pytest.mark.parametrize("probability", [0.5, 0.65, 0.9, 0.97])
def test_regions_hold_their_share_of_the_posterior(probability: float) -> None:
    """By samples of the posterior itself, of two modes and of forty Gaussians among solids."""
    rng = np.random.default_rng(3)
    root = rng.standard_normal((40, 3, 3)) + np.eye(3)
    free = rng.random((20, 20, 10)) < 0.7
    solid = FreeSpace(origin=np.array([-4.0, -4.0, -2.0]), voxel_size=0.4, free=free)
    many = (
        np.log(rng.dirichlet(np.full(40, 0.5))),
        rng.normal(0.0, 1.2, (40, 3)) * [1.0, 1.0, 0.4],
        0.05 * root @ root.transpose(0, 2, 1) + 0.02 * np.eye(3),
    )
    # Of forty cut Gaussians each has so few points that they are as good as drawn.
    for (log_weight, mean, cov), space, tolerance in ((two_modes(), OPEN, 0.02), (many, solid, 0.035)):
        hypotheses = Hypotheses(
            log_weight=log_weight,
            mean=mean,
            cov=cov,
            outlier=np.zeros((len(mean), 1), np.int8),
            log_all_outlier=-np.inf,
        )
        drawn = make_posterior(hypotheses, uniform_prior(space), space).sample(20_000, rng)
        regions = regions_of(log_weight, mean, cov, space)
        assert held(regions.ellipsoid(probability), drawn) == pytest.approx(probability, abs=tolerance)
        assert held(regions.upright_ellipsoid(probability), drawn) == pytest.approx(probability, abs=tolerance)
        apart = drawn - regions.position
        in_circle = np.hypot(*apart[:, :2].T) <= regions.horizontal_radius(probability)
        assert in_circle.mean() == pytest.approx(probability, abs=tolerance)
        in_layer = np.abs(apart[:, 2]) <= regions.vertical_half_height(probability)
        assert in_layer.mean() == pytest.approx(probability, abs=tolerance)


def test_behind_a_wall_there_is_nothing_to_hold() -> None:
    """A Gaussian whose middle is on a wall: of half a normal, |x| has the same quantiles as of the whole."""
    free = np.ones((50, 50, 50), np.bool_)
    free[25:] = False  # x > 0
    wall = FreeSpace(origin=np.full(3, -50.0), voxel_size=2.0, free=free)
    mean, cov = np.array([[-0.0, 0.0, 0.0]]), np.diag([1.0, 1e-4, 1e-4])[None]
    cut = regions_of(np.zeros(1), mean, cov, wall)
    assert 0.49 < len(cut.points.places()) / len(POINTS) < 0.51
    assert (cut.points.places()[:, 0] < 0.0).all()
    assert cut.horizontal_radius(0.68) == pytest.approx(norm.ppf(0.84), rel=0.02)
    # With the middle one deviation in front of the wall, it is a normal cut at its 84 % quantile.
    moved = regions_of(np.zeros(1), mean - [1.0, 0.0, 0.0], cov, wall)
    uncut = regions_of(np.zeros(1), mean - [1.0, 0.0, 0.0], cov)
    assert len(moved.points.places()) / len(POINTS) == pytest.approx(norm.cdf(1.0), abs=0.005)
    radius = moved.horizontal_radius(0.9)
    assert norm.cdf(1.0) - norm.cdf(-radius) == pytest.approx(0.9 * norm.cdf(1.0), abs=0.01)
    assert radius < uncut.horizontal_radius(0.9) - 0.05


def test_nothing_free_leaves_the_first_gaussian() -> None:
    nowhere = FreeSpace(origin=np.full(3, 90.0), voxel_size=2.0, free=np.ones((3, 3, 3), np.bool_))
    mean, cov = np.array([[0.0, 0.0, 1.0], [5.0, 0.0, 0.0]]), np.stack([COV, np.eye(3)])
    points = points_of(np.log([0.6, 0.4]), mean, cov, nowhere).places()
    assert points.shape == POINTS.shape
    np.testing.assert_allclose(points.mean(axis=0), mean[0], rtol=0, atol=0.01)
    np.testing.assert_allclose(np.cov(points.T), COV, rtol=0, atol=0.015)


def test_where_everything_may_be_an_outlier_regions_are_wider() -> None:
    """Of a share of 0.8, the region of 0.6 is that of three quarters, and none is credible beyond 0.8."""
    sure, doubtful = around(COV), around(COV, share=0.8)
    np.testing.assert_allclose(doubtful.ellipsoid(0.6).shape, sure.ellipsoid(0.75).shape, rtol=1e-9)
    assert doubtful.horizontal_radius(0.6) == pytest.approx(sure.horizontal_radius(0.75), rel=1e-9)
    widest = doubtful.ellipsoid(0.9)
    assert widest.probability == pytest.approx(0.8, abs=1e-12)
    assert held(widest, doubtful.points.places()) >= 1.0 - 1.0 / len(POINTS)
    np.testing.assert_allclose(widest.shape, doubtful.ellipsoid(0.99).shape, rtol=1e-12)


# --- what holds of any Gaussians -------------------------------------------------------------------------


def random_mixture(seed: int, count: int = 5) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((count, 3, 3)) + np.eye(3)
    cov = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    return np.log(rng.dirichlet(np.ones(count))), rng.normal(0.0, 2.0, (count, 3)), cov


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    probabilities=st.tuples(st.floats(0.01, 0.99), st.floats(0.01, 0.99)),
    share=st.floats(0.5, 1.0),
)
def test_more_probable_regions_are_larger(seed: int, probabilities: tuple[float, float], share: float) -> None:
    low, high = sorted(probabilities)
    regions = regions_of(*random_mixture(seed), share=share)
    assert regions.horizontal_radius(low) <= regions.horizontal_radius(high)
    assert regions.vertical_half_height(low) <= regions.vertical_half_height(high)
    for region in (regions.ellipsoid, regions.upright_ellipsoid):
        small, large = region(low), region(high)
        assert np.linalg.det(small.shape) <= np.linalg.det(large.shape) * (1.0 + 1e-12)
        # And holds its share of the points, one more or less.
        points = regions.points.places()
        assert held(large, points) == pytest.approx(min(1.0, high / share), abs=2.0 / len(points))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), probability=st.floats(0.1, 0.95))
def test_regions_turn_with_the_scene(seed: int, probability: float) -> None:
    """The same points, turned: about any axis for the ellipsoid, about the vertical for the others."""
    rng = np.random.default_rng(seed)
    log_weight, mean, cov = random_mixture(seed)
    regions = regions_of(log_weight, mean, cov)

    def turned(matrix: Array) -> CredibleRegions:
        return CredibleRegions(
            position=matrix @ regions.position,
            covariance=matrix @ regions.covariance @ matrix.T,
            points=replace(regions.points, mean=regions.points.mean @ matrix.T, root=matrix @ regions.points.root),
            share=1.0,
        )

    any_turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    expected = any_turn @ regions.ellipsoid(probability).shape @ any_turn.T
    np.testing.assert_allclose(turned(any_turn).ellipsoid(probability).shape, expected, rtol=0, atol=1e-6)  # m2
    about_z = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
    upright = turned(about_z)
    expected = about_z @ regions.upright_ellipsoid(probability).shape @ about_z.T
    np.testing.assert_allclose(upright.upright_ellipsoid(probability).shape, expected, rtol=0, atol=1e-6)  # m2
    assert upright.horizontal_radius(probability) == pytest.approx(regions.horizontal_radius(probability), rel=1e-9)
    assert upright.vertical_half_height(probability) == pytest.approx(regions.vertical_half_height(probability))


# --- the points ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_points_are_those_of_the_twin(seed: int) -> None:
    """Also with a Gaussian that rounding has made singular, which gets none, and others too light for one."""
    rng = np.random.default_rng(seed)
    log_weight, mean, cov = random_mixture(seed, 12)
    log_weight[5:8] = -20.0
    cov[3, 0, 0] = -1e-9
    space = FreeSpace(origin=np.array([-4.0, -3.0, -3.0]), voxel_size=0.5, free=rng.random((16, 12, 12)) < 0.6)
    expected = kernel_twins.draw_points(log_weight, mean, cov, space, POINTS)
    found = points_of(log_weight, mean, cov, space).places()
    assert 0.2 < len(found) / len(POINTS) < 0.6
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)  # m
    assert space.contains(found).all()


def test_each_gaussian_gets_its_share_of_points() -> None:
    weight = np.array([0.05, 0.6, 0.0, 0.35])
    mean = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 20.0]])
    with np.errstate(divide="ignore"):
        drawn = points_of(np.log(weight), mean, np.repeat(0.1 * np.eye(3)[None], 4, axis=0), OPEN)
    assert len(drawn.mean) == 3
    points = drawn.places()
    owner = np.argmin(np.linalg.norm(points[:, None] - mean, axis=2), axis=1)
    np.testing.assert_allclose(np.bincount(owner, minlength=4), weight * len(POINTS), rtol=0, atol=1.0)


def test_normal_points_and_their_runs_are_normal() -> None:
    for run in (POINTS, POINTS[:256], POINTS[300:556], POINTS[768:]):
        # Chance would give a deviation of 1 / sqrt(n).
        np.testing.assert_allclose(run.mean(axis=0), 0.0, rtol=0, atol=0.4 / math.sqrt(len(run)))
        np.testing.assert_allclose(np.cov(run.T), np.eye(3), rtol=0, atol=0.13)
        radii = np.sort(np.linalg.norm(run, axis=1)) ** 2
        # Kolmogorov's distance: chance would give about 0.9 / sqrt(n).
        ranks = (np.arange(len(run)) + 0.5) / len(run)
        assert np.abs(chi2.cdf(radii, 3) - ranks).max() < 0.8 / math.sqrt(len(run))
    with pytest.raises(ValueError, match="read-only"):
        POINTS[0, 0] = 1.0
