"""The filter's steps against closed forms, and walls.

Tolerances are five standard errors of the means over the particles.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from rayfix_service.fusion.measurements.report import Height
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.fusion.product.prior import Prior, height_prior, uniform_prior
from rayfix_service.tracking.likelihood import Likelihood, likelihood_of
from rayfix_service.tracking.motion import MotionModel
from rayfix_service.tracking.particles import Particles, Updated, birth, mixed, predict, update
from rayfix_service.tracking.walls import walls_of
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.scene import Scene

COUNT = 20_000
MODEL = MotionModel(acceleration_density=0.5, vertical_acceleration_density=0.5)


def cloud(rng: np.random.Generator, middle: list[float], velocity: list[float], stdev: float = 0.2) -> Particles:
    return Particles(
        position=middle + stdev * rng.standard_normal((COUNT, 3)),
        velocity=np.tile(np.array(velocity, np.float64), (COUNT, 1)),
        velocity_variance=np.array([0.3, 0.2, 0.1]),
    )


def test_an_update_is_a_kalman_filters(
    open_scene: Scene, free_space: FreeSpace, even_likelihood: Callable[..., Likelihood]
):
    rng = np.random.default_rng(1)
    particles = cloud(rng, [1.0, 2.0, 3.0], [0.5, -0.5, 0.1])
    seen, noise, t = np.array([1.4, 1.9, 3.2]), 0.15, 0.8
    found = update(particles, even_likelihood([seen.tolist()], noise), MODEL, t, walls_of(open_scene), rng)
    assert found is not None
    log_evidence = uniform_prior(free_space).log_volume
    for axis, v in enumerate(particles.velocity_variance):
        transition = np.array([[1.0, t], [0.0, 1.0]])
        q = MODEL.density[axis] * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
        mean = transition @ [[1.0, 2.0, 3.0][axis], [0.5, -0.5, 0.1][axis]]
        cov = transition @ np.diag([0.2**2, v]) @ transition.T + q
        spread = cov[0, 0] + noise**2
        log_evidence -= 0.5 * (np.log(2 * np.pi * spread) + (seen[axis] - mean[0]) ** 2 / spread)
        gain = cov[:, 0] / spread
        mean, cov = mean + gain * (seen[axis] - mean[0]), cov - np.outer(gain, cov[0])
        x, velocity = found.particles.position[:, axis], found.particles.velocity[:, axis]
        assert x.mean() == pytest.approx(mean[0], abs=5 * (cov[0, 0] / COUNT) ** 0.5)
        assert x.var() == pytest.approx(cov[0, 0], rel=0.06)
        assert velocity.mean() == pytest.approx(mean[1], abs=5 * (cov[1, 1] / COUNT) ** 0.5)
        assert velocity.var() + found.particles.velocity_variance[axis] == pytest.approx(cov[1, 1], rel=0.06)
        assert np.cov(x, velocity)[0, 1] == pytest.approx(cov[0, 1], rel=0.1)
    assert found.log_evidence == pytest.approx(log_evidence, abs=0.03)


def test_hypotheses_share_particles_by_their_evidence(
    open_scene: Scene, free_space: FreeSpace, even_likelihood: Callable[..., Likelihood]
):
    rng = np.random.default_rng(2)
    particles = cloud(rng, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    means, probabilities, stdev, t = [[-0.5, 0.0, 0.0], [0.8, 0.0, 0.0]], [0.3, 0.7], 0.1, 0.5
    found = update(particles, even_likelihood(means, stdev, probabilities), MODEL, t, walls_of(open_scene), rng)
    assert found is not None
    spread = 0.2**2 + t**2 * particles.velocity_variance + MODEL.density * t**3 / 3
    weight = np.array(
        [
            p * multivariate_normal(m, np.diag(spread + stdev**2)).pdf(np.zeros(3))
            for p, m in zip(probabilities, means, strict=True)
        ]
    )
    assert (found.particles.position[:, 0] < 0.15).mean() == pytest.approx(weight[0] / weight.sum(), abs=0.03)
    expected = np.log(weight.sum()) + uniform_prior(free_space).log_volume
    assert found.log_evidence == pytest.approx(expected, abs=0.03)


def test_a_report_of_outliers_alone_leaves_the_prediction(
    open_scene: Scene, free_space: FreeSpace, make_hypotheses: Callable[..., Hypotheses]
):
    rng = np.random.default_rng(3)
    particles = cloud(rng, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    far = make_hypotheses([[25.0, 25.0, 25.0]], 0.1, log_all_outlier=-4.0)
    found = update(
        particles,
        likelihood_of(far, uniform_prior(free_space).log_volume),
        MODEL,
        0.5,
        walls_of(open_scene),
        rng,
    )
    assert found is not None
    assert found.log_evidence == pytest.approx(-4.0, abs=1e-9)
    np.testing.assert_allclose(found.particles.position.mean(axis=0), [0.5, 0.0, 0.0], atol=0.02)


def test_the_known_height_counts_as_its_share(
    open_scene: Scene, free_space: FreeSpace, make_hypotheses: Callable[..., Hypotheses]
):
    """A report that says nothing but the height, with all of it left in: a product of two Gaussians."""
    rng = np.random.default_rng(4)
    particles = cloud(rng, [0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    prior: Prior = height_prior(Height(z=1.2, stdev=0.3), free_space)
    hypotheses = make_hypotheses([[0.0, 0.0, 1.2]], 0.3, log_all_outlier=-60.0)
    hypotheses.cov[:] = np.diag([1e6, 1e6, 1e6])  # as wide as nothing
    t = 0.5
    for share in (0.0, 1.0):
        likelihood = likelihood_of(hypotheses, 0.0, height=prior, height_share=share)
        found = update(particles, likelihood, MODEL, t, walls_of(open_scene), rng)
        assert found is not None
        variance = 0.2**2 + t**2 * 0.1 + 0.5 * t**3 / 3
        expected = 1.0 + share * 0.2 * variance / (variance + 0.3**2)
        assert found.particles.position[:, 2].mean() == pytest.approx(expected, abs=5 * (variance / COUNT) ** 0.5)


def test_no_particle_passes_a_sheet(open_scene: Scene, sheet_scene: Scene, even_likelihood: Callable[..., Likelihood]):
    """The report is sure that the target is behind the sheet, 0.3 m away; a rival before it has one in a thousand."""
    rng = np.random.default_rng(5)
    particles = cloud(rng, [-0.8, 0.0, 0.0], [0.5, 0.0, 0.0], stdev=0.1)
    seen = even_likelihood([[0.15, 0.0, 0.0], [-0.4, 0.0, 0.0]], 0.1, [0.999, 0.001])
    through = update(particles, seen, MODEL, 1.0, walls_of(open_scene), rng)
    assert through is not None
    assert (through.particles.position[:, 0] > 0.0).mean() > 0.9
    stopped = update(particles, seen, MODEL, 1.0, walls_of(sheet_scene), rng)
    assert stopped is not None
    assert (stopped.particles.position[:, 0] < 0.0).all()
    assert len(stopped.particles) == COUNT
    assert stopped.log_evidence < through.log_evidence - 2.0
    moved = predict(particles, MODEL, 2.0, walls_of(sheet_scene), rng)
    assert moved is not None
    near = np.abs(moved.position[:, 1:]).max(axis=1) < 4.0
    assert (moved.position[near, 0] < 0.0).all()


def test_where_all_ways_are_blocked_there_is_no_track(sheet_scene: Scene, even_likelihood: Callable[..., Likelihood]):
    rng = np.random.default_rng(6)
    particles = Particles(
        position=np.full((64, 3), [-0.01, 0.0, 0.0]), velocity=np.zeros((64, 3)), velocity_variance=np.full(3, 1e-6)
    )
    seen = even_likelihood([[0.05, 0.0, 0.0]], 0.001)
    assert update(particles, seen, MotionModel(acceleration_density=1e-3), 1.0, walls_of(sheet_scene), rng) is None


def test_birth_draws_from_what_is_free_of_a_report(free_space: FreeSpace, make_hypotheses: Callable[..., Hypotheses]):
    rng = np.random.default_rng(7)
    free = free_space.free.copy()
    free[30:] = False  # x > 0
    space = FreeSpace(origin=free_space.origin, voxel_size=free_space.voxel_size, free=free)
    hypotheses = make_hypotheses([[0.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [9.0, 0.0, 0.0]], 0.5, [0.4, 0.2, 0.4])
    born = birth(hypotheses, space, MODEL, COUNT, rng)
    assert born is not None
    assert (born.position[:, 0] <= 0.0).all()
    # Half of the first and all of the second are free.
    assert (born.position[:, 0] < -2.5).mean() == pytest.approx(0.5, abs=0.02)
    assert birth(make_hypotheses([[9.0, 0.0, 0.0]]), space, MODEL, 100, rng) is None


def test_newborn_particles_keep_their_velocities_variance(
    open_scene: Scene, free_space: FreeSpace, make_hypotheses: Callable[..., Hypotheses]
):
    rng = np.random.default_rng(8)
    track = cloud(rng, [0.0, 0.0, 0.0], [2.0, 0.0, 0.0])
    model = MotionModel(vertical_speed_stdev=0.4)
    newborn = birth(make_hypotheses([[5.0, 0.0, 0.0]]), free_space, model, COUNT, rng)
    assert newborn is not None
    both = mixed(track, newborn, 0.25, rng)
    new = both.position[:, 0] > 2.5
    assert len(both) == COUNT
    assert new.mean() == pytest.approx(0.25, abs=1e-3)
    spread = both.velocity[new].var(axis=0) + both.velocity_variance
    assert spread == pytest.approx(model.first_velocity_variance, rel=0.1)
    assert mixed(track, newborn, 1e-9, rng) is track
    assert mixed(track, newborn, 1.0 - 1e-9, rng) is newborn


BROKEN = {"indefinite": np.diag([0.04, -0.04, 0.04]), "singular": np.zeros((3, 3)), "nan": np.full((3, 3), np.nan)}


def with_a_broken_one(hypotheses: Hypotheses, kind: str) -> Hypotheses:
    """Take the covariance of the second hypothesis away."""
    cov = hypotheses.cov.copy()
    cov[1] = BROKEN[kind]
    return replace(hypotheses, cov=cov)


@pytest.mark.parametrize("kind", sorted(BROKEN))
def test_no_particle_is_born_of_a_hypothesis_without_a_covariance(
    free_space: FreeSpace, make_hypotheses: Callable[..., Hypotheses], kind: str
):
    found = birth(
        with_a_broken_one(make_hypotheses([[1.0, 0.0, 0.0], [9.0, 0.0, 0.0]], probabilities=[0.1, 0.9]), kind),
        free_space,
        MODEL,
        200,
        np.random.default_rng(5),
    )
    assert found is not None
    assert np.all(found.position[:, 0] < 5.0)


@pytest.mark.parametrize("kind", sorted(BROKEN))
def test_nothing_is_born_where_no_hypothesis_has_a_covariance(
    free_space: FreeSpace, make_hypotheses: Callable[..., Hypotheses], kind: str
):
    hypotheses = make_hypotheses([[1.0, 0.0, 0.0]])
    hypotheses = replace(hypotheses, cov=BROKEN[kind][None])
    assert birth(hypotheses, free_space, MODEL, 200, np.random.default_rng(5)) is None


@pytest.mark.parametrize("kind", sorted(BROKEN))
def test_an_update_leaves_out_hypotheses_without_a_covariance(
    open_scene: Scene, free_space: FreeSpace, make_hypotheses: Callable[..., Hypotheses], kind: str
):
    rng = np.random.default_rng(6)
    hypotheses = make_hypotheses([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    whole = replace(hypotheses, log_weight=hypotheses.log_weight[:1], mean=hypotheses.mean[:1], cov=hypotheses.cov[:1])
    prior, particles = uniform_prior(free_space), cloud(rng, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])

    def updated(report: Hypotheses) -> Updated:
        likelihood = likelihood_of(report, prior.log_volume)
        found = update(particles, likelihood, MODEL, 0.5, walls_of(open_scene), np.random.default_rng(7))
        assert found is not None
        return found

    found, expected = updated(with_a_broken_one(hypotheses, kind)), updated(whole)
    assert (found.dropped, expected.dropped) == (1, 0)
    assert found.log_evidence == expected.log_evidence
    np.testing.assert_array_equal(found.particles.position, expected.particles.position)


def test_an_update_leaves_out_products_that_are_singular(open_scene: Scene, even_likelihood: Callable[..., Likelihood]):
    """Where a known height is divided out, rounding may leave a negative information that outweighs the prediction."""
    likelihood = even_likelihood([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]], 0.1)
    information = likelihood.information.copy()
    information[1, 2, 2] = -1e6  # 1 / m2
    rng = np.random.default_rng(6)
    particles = cloud(rng, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    broken = replace(likelihood, information=information)
    found = update(particles, broken, MODEL, 0.5, walls_of(open_scene), np.random.default_rng(7))
    whole = likelihood.those(np.array([True, False, True]))
    expected = update(particles, whole, MODEL, 0.5, walls_of(open_scene), np.random.default_rng(7))
    assert found is not None
    assert expected is not None
    assert found.dropped == 1
    np.testing.assert_array_equal(found.particles.position, expected.particles.position)
