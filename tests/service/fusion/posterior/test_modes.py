"""From hypotheses to candidates: cutting to the free space, climbing, gathering."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from rayfix_service.fusion.posterior import modes
from rayfix_service.fusion.posterior.cut_by_walls import cut_to_free_space
from rayfix_service.fusion.stopping import NEVER
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.normal_points import unit_points
from tests.support.oracles import kernel_twins

Array = NDArray[np.float64]

ANYWHERE = FreeSpace(origin=np.full(3, -50.0), voxel_size=10.0, free=np.ones((10, 10, 10), np.bool_))


def log_density(x: Array, weight: Array, mean: Array, cov: Array) -> Array:
    """Log density of a Gaussian mixture at points of shape (n, 3)."""
    apart = x[:, None, :] - mean
    logs = np.log(weight) - 0.5 * np.einsum("nhi,hij,nhj->nh", apart, np.linalg.inv(cov), apart)
    logs -= 0.5 * np.linalg.slogdet(2.0 * np.pi * cov)[1]
    return np.asarray(np.logaddexp.reduce(logs, axis=1))


def climb_from(start: Array, weight: Array, mean: Array, cov: Array) -> Array:
    precision = np.linalg.inv(cov)
    log_peak = np.log(weight) + 0.5 * np.linalg.slogdet(precision)[1]
    mode, _, _ = modes.climb(log_peak, mean, precision, start, np.empty((0, 3)), np.empty((0, 3, 3)))
    return np.asarray(mode)


class Hills(NamedTuple):
    """What :func:`modes.find_modes` gives."""

    probability: Array
    position: Array
    cov: Array
    member: NDArray[np.int64]


def modes_of(weight: Array, mean: Array, cov: Array, free_space: FreeSpace) -> Hills:
    space = free_space.origin, free_space.voxel_size, free_space.free
    return Hills(*modes.find_modes(np.log(weight), mean, cov, *space, NEVER.cell))


def cut(mean: Array, cov: Array, free_space: FreeSpace) -> tuple[Array, Array, Array]:
    """Cut Gaussians of weight 1."""
    space = free_space.origin, free_space.voxel_size, free_space.free
    log_weight, cut_mean, cut_cov = cut_to_free_space(np.zeros(len(mean)), mean, cov, unit_points(), *space)
    return log_weight, cut_mean, cut_cov


def random_mixture(seed: int, count: int) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    mean = rng.normal(0.0, 1.0, (count, 3))
    root = rng.standard_normal((count, 3, 3)) + 1.5 * np.eye(3)
    return rng.dirichlet(np.ones(count)), mean, root @ root.transpose(0, 2, 1) * rng.uniform(0.01, 0.2, (count, 1, 1))


def test_unit_points_have_the_moments_of_a_standard_normal() -> None:
    points = unit_points()
    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=1e-14)
    np.testing.assert_allclose(points.T @ points / len(points), np.eye(3), rtol=0, atol=1e-13)
    # Of a normal 68 % lie within one deviation on each axis; 128 points can say so to a few per cent.
    np.testing.assert_allclose((np.abs(points) < 1.0).mean(axis=0), 0.683, atol=0.06)


@pytest.mark.parametrize("wall", [-1.0, 0.0, 0.7, 2.0])
def test_a_gaussian_at_a_wall_is_a_truncated_normal(wall: float) -> None:
    """Free below the plane x = wall x deviation; the truncated normal's moments are known."""
    stdev = 0.3
    free_space = FreeSpace(
        origin=np.array([wall * stdev - 50.0, -25.0, -25.0]), voxel_size=50.0, free=np.ones((1, 1, 1), np.bool_)
    )
    cov = np.diag([stdev**2, 0.04, 0.09])
    log_weight, mean, cut_cov = cut(np.zeros((1, 3)), cov[None], free_space)
    share = norm.cdf(wall)
    pull = norm.pdf(wall) / share
    assert np.exp(log_weight[0]) == pytest.approx(share, abs=0.04)
    # The deviation of a mean of the points that are left, and a little for their evenness.
    error = stdev * 0.5 / np.sqrt(128 * share) + 0.01 * stdev
    np.testing.assert_allclose(mean[0], [-stdev * pull, 0.0, 0.0], rtol=0, atol=2.5 * error)
    expected = 0.9 * stdev**2 * (1.0 - wall * pull - pull**2) + 0.1 * stdev**2
    # A variance of n points strays by sqrt(2 / n).
    allowed = 2.0 * np.sqrt(2.0 / (128 * share))
    assert cut_cov[0, 0, 0] == pytest.approx(expected, rel=allowed)
    np.testing.assert_allclose(np.diag(cut_cov[0])[1:], [0.04, 0.09], rtol=allowed)
    if wall <= 0.7:
        assert stdev * pull > 5.0 * error


def test_cutting_agrees_with_sampling_among_random_solids() -> None:
    """Voxels of half a deviation, three in five of them free: moments of 100 000 points against those of 128."""
    rng = np.random.default_rng(1)
    free_space = FreeSpace(origin=np.full(3, -2.0), voxel_size=0.1, free=rng.random((40, 40, 40)) < 0.6)
    free_space.free[22:] = False
    _, mean, cov = random_mixture(2, 20)
    mean, cov = 0.2 * mean, 0.04 * cov / np.trace(cov, axis1=1, axis2=2)[:, None, None]
    log_weight, cut_mean, _ = cut(mean, cov, free_space)
    for h in range(20):
        sample = rng.multivariate_normal(mean[h], cov[h], 100_000)
        free = free_space.contains(sample)
        assert np.exp(log_weight[h]) == pytest.approx(free.mean(), abs=4.0 * np.sqrt(0.25 / 128))
        # Four deviations of a mean of as few points as are left.
        allowed = 4.0 * sample[free].std(axis=0) / np.sqrt(128 * free.mean())
        assert (np.abs(cut_mean[h] - sample[free].mean(axis=0)) < allowed).all()


def test_far_hypotheses_are_candidates_of_their_own() -> None:
    weight, mean = np.array([0.3, 0.7]), np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 1.0]])
    cov = np.array([np.diag([0.1, 0.2, 0.3]), np.diag([0.3, 0.1, 0.1])])
    modes = modes_of(weight, mean, cov, ANYWHERE)
    np.testing.assert_allclose(modes.probability, [0.7, 0.3], rtol=1e-12)
    np.testing.assert_allclose(modes.position, mean[::-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(modes.cov, cov[::-1], rtol=0, atol=1e-12)
    assert modes.member.tolist() == [1, 0]


def test_near_hypotheses_are_one_candidate_at_their_mean() -> None:
    weight, mean = np.array([0.4, 0.6]), np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    cov = np.array([0.04 * np.eye(3), 0.09 * np.eye(3)])
    modes = modes_of(weight, mean, cov, ANYWHERE)
    np.testing.assert_allclose(modes.probability, [1.0], rtol=1e-12)
    np.testing.assert_allclose(modes.position, [[0.3, 0.0, 0.0]], rtol=0, atol=1e-12)
    # 0.4 (0.04 + 0.3^2) + 0.6 (0.09 + 0.2^2) along x
    np.testing.assert_allclose(modes.cov[0], np.diag([0.13, 0.07, 0.07]), rtol=0, atol=1e-12)


def test_the_mode_of_unequal_gaussians_is_where_a_grid_finds_it() -> None:
    """Two crossed ellipsoids: the mode is near where they cross, away from both their middles."""
    weight, mean = np.array([0.55, 0.45]), np.array([[0.3, 0.0, 0.0], [0.0, 0.3, 0.1]])
    cov = np.array([np.diag([0.25, 0.01, 0.02]), np.diag([0.01, 0.3, 0.03])])
    mode = climb_from(weight @ mean, weight, mean, cov)
    middle, reach = np.zeros(3), 1.0
    while reach > 1e-4:
        axis = np.linspace(-reach, reach, 41)
        grid = middle + np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        middle = grid[np.argmax(log_density(grid, weight, mean, cov))]
        reach *= 0.2
    np.testing.assert_allclose(mode, middle, rtol=0, atol=1e-3)  # m
    assert np.linalg.norm(mode - mean, axis=1).min() > 0.2


@pytest.mark.parametrize("seed", range(10))
def test_a_climb_ends_at_a_maximum_above_its_start(seed: int) -> None:
    weight, mean, cov = random_mixture(seed, 12)
    for start in mean:
        mode = climb_from(start, weight, mean, cov)
        around = mode + 1e-3 * np.concatenate([np.eye(3), -np.eye(3)])
        height = log_density(mode[None], weight, mean, cov)[0]
        assert height >= log_density(start[None], weight, mean, cov)[0] - 1e-12
        assert (log_density(around, weight, mean, cov) < height).all()


@pytest.mark.parametrize("seed", range(10))
def test_gathering_equals_climbing_all_the_way_from_each(seed: int) -> None:
    weight, mean, cov = random_mixture(seed, 40)
    precision = np.asarray(np.linalg.inv(cov), np.float64)
    log_peak = np.log(weight) + 0.5 * np.linalg.slogdet(precision)[1]
    _, member = modes.gather(log_peak, mean, precision, 9.0, -np.inf, 0.0, NEVER.cell)
    tops: list[tuple[Array, Array]] = []
    expected = np.full(40, -1)
    for h in np.argsort(-log_peak):
        top, here = kernel_twins.climb(log_peak, mean, precision, mean[h])
        for n, (other, there) in enumerate(tops):
            apart = top - other
            if min(apart @ here @ apart, apart @ there @ apart) < 9.0:
                expected[h] = n
                break
        else:
            expected[h] = len(tops)
            tops.append((top, here))
    np.testing.assert_array_equal(member, expected)
    assert len(tops) > 1


@pytest.mark.parametrize("seed", range(20))
def test_candidates_are_in_the_free_space_and_in_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    free_space = FreeSpace(origin=np.full(3, -3.0), voxel_size=0.25, free=rng.random((24, 24, 24)) < 0.1)
    weight, mean, cov = random_mixture(seed, 30)
    modes = modes_of(weight, mean, cov, free_space)
    assert free_space.contains(modes.position).all()
    assert modes.probability.sum() == pytest.approx(1.0, abs=1e-12)
    assert (np.diff(modes.probability) <= 0.0).all()
    np.testing.assert_allclose(np.bincount(modes.member, weight), modes.probability, rtol=1e-9)
    np.testing.assert_array_equal(modes.cov, modes.cov.transpose(0, 2, 1))
    assert (np.linalg.eigvalsh(modes.cov) > 0.0).all()
    for n, (position, moment) in enumerate(zip(modes.position, modes.cov, strict=True)):
        mine = modes.member == n
        apart = mean[mine] - position
        about = cov[mine] + apart[:, :, None] * apart[:, None, :]
        np.testing.assert_allclose(moment, np.average(about, axis=0, weights=weight[mine]), rtol=1e-9, atol=1e-12)


def test_a_candidate_far_from_any_free_space_goes_there_all_the_same() -> None:
    free_space = FreeSpace(origin=np.full(3, -3.0), voxel_size=0.25, free=np.zeros((24, 24, 24), np.bool_))
    free_space.free[0, 0, 0] = True
    modes = modes_of(np.ones(1), np.array([[1.0, 0.5, 0.2]]), 0.01 * np.eye(3)[None], free_space)
    np.testing.assert_allclose(modes.position, [[-2.75, -2.75, -2.75]], rtol=0, atol=1e-6)
    assert free_space.contains(modes.position).all()


def test_on_both_sides_of_a_wall_the_likelier_side_is_told() -> None:
    """Two humps of one mode, their mean within the wall, which is 0.2 m thick."""
    free = np.ones((40, 40, 40), np.bool_)
    free[19:21] = False
    free_space = FreeSpace(origin=np.full(3, -2.0), voxel_size=0.1, free=free)
    weight, mean = np.array([0.45, 0.55]), np.array([[-0.2, 0.0, 0.0], [0.2, 0.0, 0.0]])
    modes = modes_of(weight, mean, 0.02 * np.eye(3)[None].repeat(2, axis=0), free_space)
    assert len(modes.position) == 1
    assert free_space.contains(modes.position).all()
    assert 0.1 <= modes.position[0, 0] < 0.2
