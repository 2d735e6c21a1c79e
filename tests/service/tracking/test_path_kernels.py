"""The kernels of reports with drifting errors beside plain twins in SciPy and NumPy, and quadrature's density."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.stats import multivariate_normal

from rayfix_service.fusion.product.unmodelled import NO_PATH
from rayfix_service.fusion.quadrature.factor import PathFactor, evaluate, expected_directions
from rayfix_service.tracking.path_kernels import propose, refine, settle
from rayfix_tables.geometry.angles import angles_of

Array = NDArray[np.float64]
SIDE, VOXEL, NUM_PATHS = 4, 1.0, 3
TURN = 0.4  # rad, of the measured azimuth


class Map:
    """A map of 4 x 4 x 4 voxels of 1 m, each reached by three of five sequences of any mirrors."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        count = SIDE**3
        sequence = np.concatenate([rng.permutation(5)[:NUM_PATHS] for _ in range(count)]).astype(np.int32)
        weight = np.sort(rng.random((count, NUM_PATHS)).astype(np.float32), axis=1)[:, ::-1].ravel().copy()
        self.mirrors = np.array([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(5)])
        self.images = rng.uniform(-3.0, -1.0, (5, 3))
        self.place = np.zeros(3), VOXEL, np.array([SIDE] * 3)
        self.paths = (
            np.arange(count + 1) * NUM_PATHS,
            sequence,
            weight,
            rng.random(len(sequence)).astype(np.float32),
            rng.integers(0, 2, len(sequence)).astype(np.int8),
        )
        self.geometry = self.images, self.mirrors, np.array([0, 1, 2, 1, 0], np.int8)
        self.of_map = self.place, self.paths, self.geometry

    def expected(self, point: Array, sequence: int, excess: float, factor: PathFactor) -> Array:
        """Azimuth and zenith in the frame of the measured angles, and length."""
        apart = point - self.images[sequence]
        azimuth, zenith = angles_of(factor.turn @ (self.mirrors[sequence].T @ apart))
        return np.array([float(azimuth), float(zenith), float(np.linalg.norm(apart)) + excess])

    def weight_at(self, point: Array, sequence: int, factor: PathFactor) -> float:
        """Interpolated weight; beyond the outer centres that of the nearest place between them."""
        direct = (self.geometry[2][self.paths[1]] == 0) & (self.paths[4] == 0)
        weight = self.paths[2] * np.where(direct, factor.direct, factor.reflected) * (self.paths[1] == sequence)
        grid = weight.reshape(SIDE, SIDE, SIDE, NUM_PATHS).sum(axis=-1)
        centres = np.arange(SIDE) + 0.5
        return float(RegularGridInterpolator((centres,) * 3, grid)(np.clip(point, 0.5, SIDE - 0.5))[0])


def factor_of(rng: np.random.Generator, *, zenith: bool = True, length: bool = True) -> PathFactor:
    """Draw measurements with two Gaussians of each error."""
    cosine, sine = np.cos(TURN), np.sin(TURN)
    cov = [0.3, 0.05, 0.2] if zenith else [0.3, 0.0, np.inf]
    kinds = [[0.0, 0.7, 5.0, 0.8], [0.0, 0.2, 5.0, 7.0], [2.0, 0.1, 0.0, np.inf]]
    return PathFactor(
        turn=np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]),
        zenith=float(rng.uniform(0.8, 2.0)) if zenith else float("nan"),
        cov=np.array(cov),
        spreads=np.array([[0.8, 1.0], [0.19, 2.5]]),
        kinds=np.array(kinds) if length else np.array([[0.0, 1.0, 0.0, np.inf]]),
        direct=0.9,
        reflected=0.4,
        outlier=1e-4,
        unmodelled=NO_PATH,
    )


def components(count: int) -> tuple[NDArray[Any], ...]:
    return np.full(count, -1), np.zeros(count), np.zeros(count), np.zeros(count, int), np.zeros(count, int)


def no_drift(count: int) -> tuple[Array, Array, Array]:
    return np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)


def joint(cov: Array, scale: float, share: float, length: float, whole: float, variance: Array) -> Array:
    """Covariance of a component's azimuth, zenith and length for a drift of these variances."""
    found = np.zeros((3, 3))
    found[:2, :2] = (scale**2 - share) * np.array([[cov[0], cov[1]], [cov[1], cov[2]]])
    found[2, 2] = length - share * whole
    return found + np.diag(variance)


@pytest.mark.parametrize(("zenith", "length"), [(True, True), (True, False), (False, True), (False, False)])
def test_without_drift_the_density_is_that_of_the_quadrature(zenith: bool, length: bool):
    rng = np.random.default_rng(1)
    paths, factor = Map(1), factor_of(rng, zenith=zenith, length=length)
    points = rng.integers(0, SIDE, (200, 3)) + 0.5  # centres, where nothing is interpolated
    one, found = np.empty(200), np.empty(200)
    settle(
        points,
        paths.of_map,
        (tuple(factor[:-1]), 0.8),
        no_drift(200),
        rng.random((200, 2)),
        False,
        components(200),
        (one, found),
    )
    blocks = np.ravel_multi_index(tuple(np.floor(points).astype(int).T), (SIDE,) * 3)
    measured = factor.turn.T @ np.array([np.sin(factor.zenith), 0.0, np.cos(factor.zenith)])
    out = np.empty(200), np.empty(200), np.empty(200), np.empty(200)
    geometry = (*paths.geometry, expected_directions(paths.mirrors, measured))
    evaluate(points, blocks, 0.0, np.inf, paths.paths, geometry, tuple(factor), out)
    # The quadrature leaves out paths of 3e-3 of the density, and directions farther than six deviations.
    np.testing.assert_allclose(np.exp(found), out[0], rtol=2e-2)


def test_densities_and_drifts_are_those_of_a_dense_filter():
    """A given component: SciPy's density, and a Kalman filter over the three drifts without what correlates them."""
    rng = np.random.default_rng(2)
    count, share, whole = 100, 0.6, 0.8
    paths, factor = Map(2), factor_of(rng)
    points = rng.uniform(0.01, SIDE - 0.01, (count, 3))
    mean, variance = 0.3 * rng.normal(size=(count, 3)), rng.uniform(0.01, 0.2, (count, 3))
    chosen = components(count)
    for n, point in enumerate(points):
        voxel = int(np.ravel_multi_index(tuple(np.floor(point).astype(int)), (SIDE,) * 3))
        path = voxel * NUM_PATHS + rng.integers(NUM_PATHS)
        chosen[0][n], chosen[1][n] = paths.paths[1][path], paths.paths[3][path]
        chosen[3][n], chosen[4][n] = rng.integers(2), rng.integers(2)
    drift, out = (mean.copy(), variance.copy(), np.full(count, share)), np.empty(count)
    measured, uniform = (tuple(factor[:-1]), whole), rng.random((count, 2))
    settle(points, paths.of_map, measured, drift, uniform, True, chosen, (out, np.empty(count)))
    for n, point in enumerate(points):
        scale, kind = factor.spreads[chosen[3][n], 1], factor.kinds[chosen[4][n]]
        off = np.array([0.0, factor.zenith, kind[2]]) - paths.expected(
            point, int(chosen[0][n]), float(chosen[1][n]), factor
        )
        off -= mean[n]
        off[0] = np.angle(np.exp(1j * off[0]))
        cov = joint(factor.cov, scale, share, kind[3], whole, variance[n])
        weight = paths.weight_at(point, int(chosen[0][n]), factor)
        weight *= factor.spreads[chosen[3][n], 0] * kind[1] / np.sin(factor.zenith)
        assert out[n] == pytest.approx(np.log(weight) + multivariate_normal(np.zeros(3), cov).logpdf(off), abs=1e-9)
        gain = np.diag(variance[n]) @ np.linalg.inv(cov)
        np.testing.assert_allclose(drift[0][n], mean[n] + gain @ off, atol=1e-9)
        left = np.diag(variance[n]) - gain @ np.diag(variance[n])
        np.testing.assert_allclose(drift[1][n], np.diag(left), atol=1e-9)


def test_a_proposal_is_a_kalman_update_about_the_prediction():
    """Gradients by differences; a component's probability is its share of all, the outlier included."""
    rng = np.random.default_rng(3)
    count, share, whole = 60, 0.6, 0.8
    paths, factor = Map(3), factor_of(rng)
    before = rng.uniform(0.2, SIDE - 0.2, (count, 3))
    prior = np.diag([0.05, 0.08, 0.02])
    bias, variance = 0.2 * rng.normal(size=(count, 3)), rng.uniform(0.01, 0.2, (count, 3))
    drift = bias, variance, np.full(count, share)
    mean, cov = before.copy(), np.tile(prior, (count, 1, 1))
    chosen, log_chosen = components(count), np.empty(count)
    measured = tuple(factor[:-1]), whole
    propose(mean, cov, before, paths.of_map, measured, drift, rng.random(count), chosen, log_chosen)
    again, again_cov, log_again = before.copy(), np.tile(prior, (count, 1, 1)), np.empty(count)
    refine(again, again_cov, before, paths.geometry, measured, drift, chosen, log_again)
    taken = chosen[0] >= 0
    assert taken.mean() > 0.3
    np.testing.assert_allclose(again, mean, atol=1e-9)
    np.testing.assert_allclose(again_cov, cov, atol=1e-9)
    for n in range(count):
        total, own = factor.outlier, factor.outlier
        voxel = int(np.ravel_multi_index(tuple(np.floor(before[n]).astype(int)), (SIDE,) * 3))
        for path in range(voxel * NUM_PATHS, (voxel + 1) * NUM_PATHS):
            sequence, excess = int(paths.paths[1][path]), float(paths.paths[3][path])
            at = paths.expected(before[n], sequence, excess, factor)
            slope = np.empty((3, 3))
            for axis in range(3):
                step = 1e-6 * np.eye(3)[axis]
                ends = [paths.expected(before[n] + s * step, sequence, excess, factor) for s in (1, -1)]
                change = ends[0] - ends[1]
                change[0] = np.angle(np.exp(1j * change[0]))
                slope[:, axis] = change / 2e-6
            direct = paths.geometry[2][sequence] == 0 and paths.paths[4][path] == 0
            weight = (
                float(paths.paths[2][path]) * (factor.direct if direct else factor.reflected) / np.sin(factor.zenith)
            )
            for c, (part, scale) in enumerate(factor.spreads):
                for k, kind in enumerate(factor.kinds):
                    measured = 3 if np.isfinite(kind[3]) else 2
                    off = np.array([0.0, factor.zenith, kind[2]]) - at - bias[n]
                    off[0] = np.angle(np.exp(1j * off[0]))
                    noise = joint(factor.cov, scale, share, kind[3] if measured == 3 else 1.0, whole, variance[n])
                    rows, off, noise = slope[:measured], off[:measured], noise[:measured, :measured]
                    spread = rows @ prior @ rows.T + noise
                    density = weight * part * kind[1] * multivariate_normal(np.zeros(measured), spread).pdf(off)
                    total += density
                    if (sequence, c, k) == (chosen[0][n], chosen[3][n], chosen[4][n]):
                        own = density
                        gain = prior @ rows.T @ np.linalg.inv(spread)
                        np.testing.assert_allclose(mean[n], before[n] + gain @ off, atol=1e-6)
                        np.testing.assert_allclose(cov[n], prior - gain @ rows @ prior, atol=1e-6)
        assert log_chosen[n] == pytest.approx(np.log(own / total), abs=1e-3)
        assert log_again[n] == pytest.approx(np.log(own), abs=1e-6)


def test_weights_are_interpolated_by_drawing_a_voxel():
    """The mean over all random numbers is the interpolation: the eight voxels' densities by their shares."""
    rng = np.random.default_rng(4)
    paths, factor = Map(4), factor_of(rng)
    count, centres = 20_000, np.arange(SIDE) + 0.5
    level = np.column_stack([(np.arange(count) + 0.5) / count, rng.random(count)])
    for point in rng.uniform(0.5, SIDE - 0.5, (5, 3)):
        one, found = np.empty(count), np.empty(count)
        chosen = components(count)
        points, measured = np.tile(point, (count, 1)), (tuple(factor[:-1]), 0.8)
        settle(points, paths.of_map, measured, no_drift(count), level, False, chosen, (one, found))
        grid = np.empty(SIDE**3)
        for voxel in range(SIDE**3):
            of_voxel = paths.paths[1:4]
            grid[voxel] = factor.outlier
            for path in range(voxel * NUM_PATHS, (voxel + 1) * NUM_PATHS):
                sequence, weight, excess = (column[path] for column in of_voxel)
                direct = paths.geometry[2][sequence] == 0 and paths.paths[4][path] == 0
                own = float(weight) * (factor.direct if direct else factor.reflected) / np.sin(factor.zenith)
                at = paths.expected(point, int(sequence), float(excess), factor)
                for part, scale in factor.spreads:
                    for kind in factor.kinds:
                        number = 3 if np.isfinite(kind[3]) else 2
                        off = np.array([0.0, factor.zenith, kind[2]]) - at
                        off[0] = np.angle(np.exp(1j * off[0]))
                        noise = joint(factor.cov, scale, 0.0, kind[3] if number == 3 else 1.0, 0.8, np.zeros(3))
                        density = multivariate_normal(np.zeros(number), noise[:number, :number]).pdf(off[:number])
                        grid[voxel] += own * part * kind[1] * density
        expected = float(RegularGridInterpolator((centres,) * 3, grid.reshape((SIDE,) * 3))(point)[0])
        assert np.exp(found).mean() == pytest.approx(expected, rel=2e-3)


def test_a_component_drawn_at_a_place_has_the_density_of_the_same_one_given():
    rng = np.random.default_rng(5)
    paths, factor, count = Map(5), factor_of(rng), 400
    points, measured = rng.uniform(0.01, SIDE - 0.01, (count, 3)), (tuple(factor[:-1]), 0.8)
    chosen, drawn, given, both = components(count), np.empty(count), np.empty(count), np.empty((2, count))
    uniform = rng.random((count, 2))
    settle(points, paths.of_map, measured, no_drift(count), uniform, False, chosen, (drawn, both[0]))
    assert 0.3 < (chosen[0] >= 0).mean() < 1.0
    settle(points, paths.of_map, measured, no_drift(count), uniform, True, chosen, (given, both[1]))
    np.testing.assert_allclose(given, drawn, rtol=1e-12)
    nowhere = np.full((1, 3), SIDE + 2.0)
    settle(nowhere, paths.of_map, measured, no_drift(1), uniform[:1], True, chosen, (given, both[0]))
    assert given[0] == (-np.inf if chosen[0][0] >= 0 else np.log(factor.outlier))
    assert both[0, 0] == np.log(factor.outlier)


def test_given_components_are_taken_in_where_they_could_have_been_drawn():
    rng = np.random.default_rng(6)
    paths, factor, count = Map(6), factor_of(rng), 200
    before, prior = rng.uniform(0.2, SIDE - 0.2, (count, 3)), np.tile(0.05 * np.eye(3), (count, 1, 1))
    measured, chosen, out = (tuple(factor[:-1]), 0.8), components(count), np.empty(count)
    mean, cov = before.copy(), prior.copy()
    propose(mean, cov, before, paths.of_map, measured, no_drift(count), rng.random(count), chosen, out)
    again, again_cov = before.copy(), prior.copy()
    propose(again, again_cov, before, paths.of_map, measured, no_drift(count), np.empty(0), chosen, out)
    np.testing.assert_array_equal(out, 0.0)
    np.testing.assert_allclose(again, mean, atol=1e-12)
    np.testing.assert_allclose(again_cov, cov, atol=1e-12)
    voxel = np.ravel_multi_index(tuple(np.floor(before).astype(int).T), (SIDE,) * 3)
    there = paths.paths[1].reshape(-1, NUM_PATHS)[voxel]
    chosen[0][:] = rng.integers(-1, 5, count)
    again, again_cov = before.copy(), prior.copy()
    propose(again, again_cov, before, paths.of_map, measured, no_drift(count), np.empty(0), chosen, out)
    possible = (chosen[0] < 0) | (there == chosen[0][:, None]).any(axis=1)
    np.testing.assert_array_equal(out, np.where(possible, 0.0, -np.inf))
