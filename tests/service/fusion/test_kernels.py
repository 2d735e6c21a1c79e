"""The fusion's compiled kernels against their NumPy twins, and the closed forms against sampling."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import norm

from rayfix_service.fusion.measurements.directions import Direction
from rayfix_service.fusion.measurements.likelihood import Term, gaussian_terms, log_normal_terms, spreads
from rayfix_service.fusion.measurements.observations import Observation
from rayfix_service.fusion.measurements.report import GAUSSIAN, ErrorModel
from rayfix_service.fusion.posterior import modes
from rayfix_service.fusion.posterior.cut_by_walls import cut_to_free_space
from rayfix_service.fusion.product import beam_kernels, factor_kernels, information_form
from rayfix_service.fusion.product.factor_kernels import ALL_GOOD
from rayfix_service.fusion.product.factors import make_factor
from rayfix_service.fusion.product.prior import Prior
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.fusion.stopping import NEVER
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.conditioning import Conditioned, MeasuredCells, condition_on_angle
from rayfix_tables.gaussians.normal_points import unit_points
from rayfix_tables.gaussians.triangles import triangle
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import WINDOW_RATIO, Level
from rayfix_tables.mixture import TubeMixture, pack, unpack
from rayfix_tables.part import StationPart
from rayfix_tables.site import Station
from tests.support.oracles import kernel_twins

Array = NDArray[np.float64]
Times = tuple[NDArray[np.int64], Array, Array]
Functions = tuple[Array, Array, Array]

LOG_VOLUME, LOG_RANGE = float(np.log(320.0)), float(np.log(60.0))

NO_TIME: Times = (np.empty(0, np.int64), np.empty(0), np.empty(0))
ONE_TIME: Times = (np.array([0]), np.array([3.0]), np.array([0.25]))
THREE_TIMES: Times = (np.array([0, 1, 0]), np.array([3.0, -7.5, 3.4]), np.array([0.25, 0.04, 2.0]))
STATES = [(NO_TIME, 3), (NO_TIME, 4), (ONE_TIME, 4), (ONE_TIME, 5), (THREE_TIMES, 5)]
"""Times of arrival of a path, and the size of the state: position and 0, 1 or 2 clocks, of which it reads some."""


def random_cov(rng: np.random.Generator, count: int, scale: list[float]) -> Array:
    """Well-conditioned random covariances whose standard deviations are about ``scale``."""
    size = len(scale)
    root = rng.standard_normal((count, size, size)) + 1.5 * np.eye(size)
    return np.asarray(root @ root.transpose(0, 2, 1) * np.multiply.outer(scale, scale))


def random_mixture(rng: np.random.Generator, count: int, window: float = 0.05) -> TubeMixture:
    """Tubes some metres long, as a cell of this window [rad] holds them."""
    return TubeMixture(
        log_weight=np.log(rng.dirichlet(np.ones(count))) if count else np.zeros(0),
        u_mean=rng.normal([8.0, 0.0, 0.0], [3.0, 0.3 * window, 0.3 * window], (count, 3)),
        u_cov=pack(random_cov(rng, count, [0.8, 0.3 * window, 0.3 * window])),
        x_mean=rng.uniform([0.0, 0.0, 0.0], [8.0, 18.0, 2.5], (count, 3)),
        jacobian=rng.standard_normal((count, 3, 3)) * [1.0, 8.0, 8.0],
        x_cov=pack(random_cov(rng, count, [0.05, 0.05, 0.05])),
        num_reflections=np.zeros(count, np.int8),
        num_walls=np.zeros(count, np.int8),
    )


def random_gaussians(rng: np.random.Generator, count: int) -> Functions:
    """Log evidences, means and covariances over (x, path length)."""
    return rng.normal(size=count), rng.normal(0.0, 1.5, (count, 4)), random_cov(rng, count, [0.5, 0.7, 0.2, 0.6])


def random_factor(rng: np.random.Generator, count: int, times: Times, dimension: int) -> Functions:
    """Alternatives as a report makes them, the last of them an outlier."""
    information, eta, log_scale = kernel_twins.to_information(*random_gaussians(rng, count), *times, dimension)
    information[-1], eta[-1], log_scale[-1] = 0.0, 0.0, -5.0
    return information, eta, log_scale


def log_integrals(functions: Functions) -> Array:
    columns = information_form.pack(*functions)
    out = np.empty(columns.shape[1])
    information_form.log_integrals(columns, LOG_VOLUME, LOG_RANGE, np.empty(len(out)), out)
    return out


def columns_of(gaussians: Functions, times: Times, dimension: int) -> Functions:
    """Functions that Gaussians over (x, path length) and times of arrival become, by the kernel."""
    readings = np.array(list(zip(*times, strict=True)), factor_kernels.READING)
    columns = np.empty((triangle(dimension) + dimension + 1, len(gaussians[0])))
    factor_kernels.to_columns(*gaussians, readings, dimension, columns)
    return information_form.unpack(columns)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_condition_on_angle_equals_the_joint_gaussian(dtype: type[np.floating[Any]]) -> None:
    rng = np.random.default_rng(1)
    names = ("log_weight", "u_mean", "u_cov", "x_mean", "jacobian", "x_cov")
    mixture = random_mixture(rng, 10)
    stored = {name: getattr(mixture, name).astype(dtype) for name in names}
    mixture = TubeMixture(**stored, num_reflections=mixture.num_reflections, num_walls=mixture.num_walls)
    rest_mean = rng.normal(0.0, 0.03, (3, 2))
    rest_cov = random_cov(rng, 3, [0.02, 0.03])[:, [0, 0, 1], [0, 1, 1]]
    log_factor = rng.normal(size=3)
    # Three cells that are not neighbours; the second is empty.
    begins, ends = np.array([5, 3, 0]), np.array([10, 3, 3])
    log_evidence, mean, cov = np.empty(8), np.empty((8, 4)), np.empty((8, 4, 4))
    cells = MeasuredCells(begins, ends, rest_mean, rest_cov, log_factor)
    condition_on_angle(mixture.tubes, cells, Conditioned(log_evidence, mean, cov))
    for cell, out in ((0, slice(0, 5)), (2, slice(5, 8))):
        expected = kernel_twins.condition_on_angle(
            mixture[begins[cell] : ends[cell]], rest_mean[cell], rest_cov[cell], log_factor[cell]
        )
        np.testing.assert_allclose(log_evidence[out], expected[0], rtol=0, atol=1e-10)  # nats
        np.testing.assert_allclose(mean[out], expected[1], rtol=0, atol=1e-10)  # m
        np.testing.assert_allclose(cov[out], expected[2], rtol=0, atol=1e-10)  # m2, the least about 1e-2


@pytest.mark.parametrize("variance", [1e-6, 0.25, 1e4])
def test_condition_on_length_equals_the_joint_gaussian(variance: float) -> None:
    log_evidence, mean, cov = random_gaussians(np.random.default_rng(2), 20)
    expected = kernel_twins.condition_on_length(log_evidence, mean, cov, 4.0, variance)
    part = np.array([(0, 5, 20, 0.0, 4.0, variance, -1.0, 0, 0)], factor_kernels.PART)[0]
    log, score = np.empty(15), np.empty(15)
    top = factor_kernels.weigh((log_evidence, mean, cov), part, (0.0, 0.0, 0.0), log, score)
    factor_kernels.condition_on_length(mean, cov, 4.0, variance)
    # Evidences of 1e6 nats where a precise length is far off.
    np.testing.assert_allclose(log, expected[0][5:], rtol=1e-11)
    np.testing.assert_allclose(score, log - 1.0, rtol=1e-14)
    assert top == score.max()
    np.testing.assert_allclose(mean, expected[1], rtol=0, atol=1e-10)  # m
    np.testing.assert_allclose(cov, expected[2], rtol=0, atol=1e-10)  # m2


@pytest.mark.parametrize("variance", [0.25, np.inf])
def test_the_score_has_the_evidence_of_a_known_height(variance: float) -> None:
    """As the product with a Gaussian in z, which is normalised to 1."""
    gaussians = random_gaussians(np.random.default_rng(2), 20)
    part = np.array([(0, 0, 20, 0.3, 4.0, variance, 0.0, 0, 0)], factor_kernels.PART)[0]
    log, score = np.empty(20), np.empty(20)
    z, precision = 1.2, 0.3**-2
    factor_kernels.weigh(gaussians, part, (0.0, precision, z * precision), log, score)
    if variance < np.inf:
        gaussians = kernel_twins.condition_on_length(*gaussians, 4.0, variance)
    log_norm = 0.5 * (z**2 * precision - np.log(precision / (2.0 * np.pi)))
    expected = log + norm.logpdf(z, gaussians[1][:, 2], np.sqrt(gaussians[2][:, 2, 2] + 0.3**2)) + log_norm
    np.testing.assert_allclose(score, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(log, gaussians[0] + 0.3, rtol=0, atol=1e-9)


@pytest.mark.parametrize("dimension", [3, 4, 6])
def test_packing_goes_there_and_back(dimension: int) -> None:
    rng = np.random.default_rng(8)
    functions = random_cov(rng, 5, [1.0] * dimension), rng.normal(size=(5, dimension)), rng.normal(size=5)
    for found, expected in zip(information_form.unpack(information_form.pack(*functions)), functions, strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("size", [3, 4, 6])
def test_inverses_of_all_matrices_are_numpys(size: int) -> None:
    rng = np.random.default_rng(9)
    matrices = random_cov(rng, 7, np.geomspace(0.01, 10.0, size).tolist())
    matrices[3] -= 1.1 * np.linalg.eigvalsh(matrices[3])[0] * np.eye(size)
    lower = np.tril_indices(size)
    packed, det = matrices[:, lower[0], lower[1]].T.copy(), np.empty(7)
    information_form.invert_all(packed, size, det)
    assert det[3] == 0.0
    regular = np.arange(7) != 3
    np.testing.assert_allclose(det[regular], np.linalg.det(matrices[regular]), rtol=1e-9)
    expected = np.linalg.inv(matrices[regular])
    scale = np.sqrt(np.einsum("nii,njj->nij", expected, expected))[:, lower[0], lower[1]].T
    np.testing.assert_allclose(
        packed[:, regular] / scale, expected[:, lower[0], lower[1]].T / scale, rtol=0, atol=1e-10
    )


@pytest.mark.parametrize(("times", "dimension"), STATES)
def test_to_columns_equals_its_twin(times: Times, dimension: int) -> None:
    gaussians = random_gaussians(np.random.default_rng(3), 12)
    expected = kernel_twins.to_information(*gaussians, *times, dimension)
    for found, twin in zip(columns_of(gaussians, times, dimension), expected, strict=True):
        np.testing.assert_allclose(found, twin, rtol=1e-9, atol=1e-9)  # 1 / m2, 1 / m, nats


@pytest.mark.parametrize("times", [NO_TIME, ONE_TIME])
def test_to_columns_leaves_a_degenerate_gaussian_without_weight(times: Times) -> None:
    log_evidence, mean, cov = random_gaussians(np.random.default_rng(3), 2)
    cov[0, 0, 0] = -1e-9  # m2
    functions = columns_of((log_evidence, mean, cov), times, 4)
    assert functions[2][0] == -np.inf
    assert log_integrals(functions)[0] == -np.inf
    expected = kernel_twins.to_information(log_evidence[1:], mean[1:], cov[1:], *times, 4)
    np.testing.assert_allclose(functions[2][1:], expected[2], rtol=1e-9)


def test_to_information_keeps_the_evidence_of_times() -> None:
    """Of two times of one clock the difference is known: its density remains when position and clock are gone."""
    rng = np.random.default_rng(4)
    log_evidence, mean, cov = random_gaussians(rng, 5)
    times = (np.array([0, 0]), np.array([2.0, 2.7]), np.array([0.3, 0.5]))
    factor = kernel_twins.to_information(log_evidence, mean, cov, *times, 4)
    log_density = -0.5 * (0.7**2 / 0.8 + np.log(2.0 * np.pi * 0.8))
    np.testing.assert_allclose(log_integrals(factor), log_evidence + log_density, rtol=0, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), state=st.sampled_from(STATES))
def test_log_integral_equals_its_twin(seed: int, state: tuple[Times, int]) -> None:
    factor = random_factor(np.random.default_rng(seed), 6, *state)
    expected = kernel_twins.log_integral(*factor, LOG_VOLUME, LOG_RANGE)
    np.testing.assert_allclose(log_integrals(factor), expected, rtol=0, atol=1e-8)  # nats


def test_log_integral_of_an_outlier_is_the_volume_times_the_clocks_ranges() -> None:
    factor = np.zeros((1, 5, 5)), np.zeros((1, 5)), np.array([-2.0])
    assert log_integrals(factor)[0] == pytest.approx(-2.0 + LOG_VOLUME + 2 * LOG_RANGE, abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    states=st.sampled_from(
        [(NO_TIME, NO_TIME, 3), (NO_TIME, ONE_TIME, 4), (ONE_TIME, NO_TIME, 4), (ONE_TIME, THREE_TIMES, 5)]
    ),
    wide=st.sampled_from([1.0, 1e7]),
)
def test_extend_beam_keeps_the_best_of_all_products(seed: int, states: tuple[Times, Times, int], wide: float) -> None:
    """Also for times of arrival so noisy (some km) that a product may integrate to more than its parts promise."""
    rng = np.random.default_rng(seed)
    first, second, dimension = states
    hypotheses = random_factor(rng, 12, first, dimension)
    factor = random_factor(rng, 15, (second[0], second[1], wide * second[2]), dimension)
    parent, choice, score = extend_beam(hypotheses, factor, 40, np.inf)
    all_parents, all_choices, all_scores = kernel_twins.extend_beam(*hypotheses, *factor, LOG_VOLUME, LOG_RANGE)
    assert len(all_scores) == 12 * 15
    np.testing.assert_allclose(score, all_scores[:40], rtol=0, atol=1e-7)  # nats
    clear = np.flatnonzero(-np.diff(all_scores[:41]) > 1e-6)  # before each of these ends a set without ties
    last = clear[-1] + 1
    kept = set(zip(parent[:last].tolist(), choice[:last].tolist(), strict=True))
    assert kept == set(zip(all_parents[:last].tolist(), all_choices[:last].tolist(), strict=True))
    assert last > 30


def extend_beam(
    hypotheses: Functions, factor: Functions, width: int, hopeless: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Products by the kernel, the best first."""
    columns = information_form.pack(*hypotheses), information_form.pack(*factor)
    parent, choice, score, dropped = beam_kernels.extend_beam(
        *columns, width, hopeless, LOG_VOLUME, LOG_RANGE, NEVER.cell
    )
    assert dropped == 0
    order = np.argsort(-score)
    return parent[order], choice[order], score[order]


def test_extend_beam_takes_all_products_when_they_are_few() -> None:
    rng = np.random.default_rng(5)
    hypotheses, factor = random_factor(rng, 3, NO_TIME, 3), random_factor(rng, 4, NO_TIME, 3)
    *_, expected = kernel_twins.extend_beam(*hypotheses, *factor, LOG_VOLUME, LOG_RANGE)
    parent, choice, score = extend_beam(hypotheses, factor, 256, np.inf)
    assert sorted(zip(parent.tolist(), choice.tolist(), strict=True)) == [(h, k) for h in range(3) for k in range(4)]
    np.testing.assert_allclose(score, expected, rtol=0, atol=1e-7)  # nats


def test_extend_beam_gives_up_hopeless_products() -> None:
    rng = np.random.default_rng(5)
    hypotheses, factor = random_factor(rng, 3, NO_TIME, 3), random_factor(rng, 4, NO_TIME, 3)
    *_, expected = kernel_twins.extend_beam(*hypotheses, *factor, LOG_VOLUME, LOG_RANGE)
    hopeful = expected > expected[0] - 30.0
    assert 1 < np.count_nonzero(hopeful) < 12
    *_, score = extend_beam(hypotheses, factor, 256, 30.0)
    np.testing.assert_allclose(score, expected[hopeful], rtol=0, atol=1e-7)  # nats


def test_numbers_of_outlier_patterns_tell_histories_apart_however_many_factors() -> None:
    """Numbers of 256 factors to the base 3 would need 406 bits; half of the histories differ in the first only."""
    rng = np.random.default_rng(4)
    num_hypotheses = 60
    histories: list[tuple[int, ...]] = [()] * num_hypotheses
    pattern = np.zeros(num_hypotheses, np.int64)
    for place in range(256):
        outlier = rng.integers(0, 3, num_hypotheses).astype(np.int8)
        half = num_hypotheses // 2
        outlier[half:] = (outlier[:half] + 1) % 3 if place == 0 else outlier[:half]
        histories = [(*history, int(state)) for history, state in zip(histories, outlier, strict=True)]
        pattern = beam_kernels.extend_patterns(pattern, outlier, place)
        assert pattern.min() >= 0
        same = np.array([[a == b for b in histories] for a in histories])
        np.testing.assert_array_equal(pattern[:, None] == pattern[None, :], same)
        # The best hypotheses of the next step may come from any of these.
        parent = rng.integers(0, num_hypotheses, num_hypotheses)
        parent[half:] = (parent[:half] + half) % num_hypotheses
        pattern, histories = pattern[parent], [histories[n] for n in parent]


def test_cutting_to_the_free_space_equals_its_twin() -> None:
    rng = np.random.default_rng(6)
    free_space = FreeSpace(origin=np.array([-1.0, 2.0, 0.5]), voxel_size=0.25, free=rng.random((10, 8, 6)) < 0.6)
    mean, cov = rng.uniform([-1.0, 2.0, 0.5], [1.5, 4.0, 2.0], (30, 3)), random_cov(rng, 30, [0.2, 0.1, 0.1])
    # One Gaussian within a free voxel, one far outside, one of which only a few points are free.
    corner = free_space.origin + 0.25 * np.argwhere(free_space.free)[0]
    mean[0], cov[0] = corner + 0.125, 1e-6 * np.eye(3)
    mean[1] = [50.0, 0.0, 0.0]
    mean[2], cov[2] = [3.0, 3.0, 1.2], np.eye(3)
    points = unit_points()
    expected = [kernel_twins.cut_gaussian(m, c, points, free_space) for m, c in zip(mean, cov, strict=True)]
    space = free_space.origin, 0.25, free_space.free
    log_weight, cut_mean, cut_cov = cut_to_free_space(np.full(30, -2.0), mean, cov, points, *space)
    share = np.array([e[2] for e in expected])
    assert share[0] == 1.0
    assert share[1] == 0.0
    assert 0 < share[2] * 128 <= 8
    # What lies in a solid keeps a thousandth of its weight.
    np.testing.assert_allclose(log_weight, -2.0 + np.log(np.maximum(share, 1e-3)), rtol=1e-14)
    np.testing.assert_allclose(cut_mean, [e[0] for e in expected], rtol=0, atol=1e-12)  # m
    np.testing.assert_allclose(cut_cov, [e[1] for e in expected], rtol=0, atol=1e-12)  # m2


@pytest.mark.parametrize("seed", range(5))
def test_climb_equals_its_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean = rng.normal(0.0, 1.0, (20, 3))
    precision = np.asarray(np.linalg.inv(random_cov(rng, 20, [0.4, 0.6, 0.2])), np.float64)
    log_density = np.log(rng.dirichlet(np.ones(20))) + 0.5 * np.linalg.slogdet(precision)[1]
    for start in mean[:5]:
        mode, curvature, _ = modes.climb(log_density, mean, precision, start, np.empty((0, 3)), np.empty((0, 3, 3)))
        expected_mode, expected_curvature = kernel_twins.climb(log_density, mean, precision, start)
        np.testing.assert_allclose(mode, expected_mode, rtol=0, atol=1e-7)  # m
        np.testing.assert_allclose(curvature, expected_curvature, rtol=1e-5)


def one_cell_station(mixture: TubeMixture, log_mass: float, cell: int, window: float) -> StationPart:
    """Station of which only one cell of one level holds anything."""
    grid = AngularGrid.from_spacing(window / 0.8)
    offsets, masses = np.zeros(grid.num_cells + 1, np.int64), np.full(grid.num_cells, -np.inf)
    offsets[cell + 1 :], masses[cell] = len(mixture), log_mass
    level = Level(window=window, grid=grid, cell_offsets=offsets, cell_log_mass=masses, mixture=mixture)
    station = Station(id="a", position=(0.0, 0.0, 0.0))
    return StationPart(station=station, levels=(level,), lost_ray_share=0.0, coverage=(1.0,))


def test_a_balance_is_added_to_its_own_components() -> None:
    rng = np.random.default_rng(8)
    part = one_cell_station(random_mixture(rng, 4).as_stored(), 0.5, 12, 0.1)
    (level,) = part.levels
    balance = rng.normal(size=4).astype(np.float32)
    raised = replace(part, levels=(replace(level, log_balance=balance),))
    azimuth, zenith = level.grid.centres[12]
    measured = Direction(azimuth=float(azimuth), zenith=float(zenith), cov=0.05**2 * np.eye(2))
    before, after = StationMixtures(part).towards(measured), StationMixtures(raised).towards(measured)
    np.testing.assert_allclose(after.log_evidence - before.log_evidence, balance, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(after.mean, before.mean)
    np.testing.assert_array_equal(after.cov, before.cov)


BIAS_STDEV = 0.3  # m
TAIL_SCALE = 1.5
LEAST_LOG = -600.0


def errors_of(
    error: str, length: float, stdev: float
) -> tuple[ErrorModel, tuple[tuple[Term, ...], ...], Callable[[Array], Array]]:
    """Error model of the angle, likelihoods of the lengths, and their product's logarithm by its definition.

    Of "heavy" errors there are two lengths, whose unknown bias is integrated out on a grid; so is that of "log".
    """
    model = ErrorModel(tail_share=0.2, tail_scale=TAIL_SCALE)
    bias = np.linspace(-5.0, 5.0, 101) * BIAS_STDEV

    def averaged(likelihood: Callable[[Array], Array]) -> Callable[[Array], Array]:
        weight = norm.pdf(bias, scale=BIAS_STDEV) * (bias[1] - bias[0])
        return lambda path: np.log(1e-300 + sum(w * likelihood(path + b) for w, b in zip(weight, bias, strict=True)))

    def contaminated(value: float, spread: float) -> Callable[[Array], Array]:
        return lambda path: 0.8 * norm.pdf(value, path, spread) + 0.2 * norm.pdf(value, path, TAIL_SCALE * spread)

    if error == "gaussian":
        return GAUSSIAN, (gaussian_terms(length, stdev, GAUSSIAN),), lambda path: norm.logpdf(length, path, stdev)
    if error == "heavy":
        first, second = contaminated(length, stdev), contaminated(length + 0.8, 1.5 * stdev)
        lengths = (gaussian_terms(length, stdev, model), gaussian_terms(length + 0.8, 1.5 * stdev, model))
        return model, lengths, averaged(lambda path: first(path) * second(path))
    # Paths shorter than a millimetre would need complex logarithms.
    powers = averaged(lambda path: norm.pdf(np.log(length / np.maximum(path, 1e-3)), scale=0.5) / length)
    return GAUSSIAN, (log_normal_terms(length, 0.5),), powers


@pytest.mark.parametrize("error", ["gaussian", "heavy", "log"])
@pytest.mark.parametrize("seed", [0, 1])
def test_closed_form_conditioning_agrees_with_sampling(seed: int, error: str) -> None:
    """Points drawn from a cell's mixture, weighted by what was measured, against the alternatives of the report.

    A weighted mean strays by its Monte-Carlo deviation, which the samples themselves tell; five of it are allowed.
    """
    rng = np.random.default_rng(seed)
    window, log_mass, count = 0.05, 1.3, 400_000
    mixture = random_mixture(rng, 6, window)
    part = one_cell_station(mixture, log_mass, 300, window)
    azimuth, zenith = part.levels[0].grid.centres[300]
    offset = np.array([0.4, -0.3]) * window
    noise = random_cov(rng, 1, [1.0, 1.0])[0]
    noise *= (0.9 * window / WINDOW_RATIO / TAIL_SCALE) ** 2 / np.linalg.eigvalsh(noise)[-1]
    stretch = np.diag([1.0 / np.sin(zenith), 1.0])
    direction = Direction(
        azimuth=float(azimuth + offset[0] / np.sin(zenith)),
        zenith=float(zenith + offset[1]),
        cov=stretch @ noise @ stretch,
    )
    length, stdev = float(np.exp(mixture.log_weight) @ mixture.u_mean[:, 0]), 0.5
    angle_model, lengths, log_likelihood = errors_of(error, length, stdev)
    observation = Observation(
        station_id="a",
        direction=direction,
        angle_spreads=spreads(angle_model),
        lengths=lengths,
        length_bias_variance=0.0 if error == "gaussian" else BIAS_STDEV**2,
        angle_index=0,
        timing_indices=(1,),
    )
    fusion = FusionSettings(unmodelled_probability=0.0, component_floor=1e-12, max_divergence=0.0)
    prior = Prior(log_volume=LOG_VOLUME)
    factor = make_factor(
        observation, StationMixtures(part), num_clocks=0, max_path_length=60.0, prior=prior, settings=fusion
    )
    assert factor is not None
    information, eta, log_scale = information_form.unpack(factor.columns[:, factor.outlier == ALL_GOOD])
    log_evidence = log_integrals((information, eta, log_scale))
    weight = np.exp(log_evidence - 2.0 * np.log(1.0 - fusion.outlier_probability) - log_mass)
    cov = np.linalg.inv(information)
    mean = np.einsum("kij,kj->ki", cov, eta)
    closed = weight @ mean / weight.sum()
    apart = mean - closed
    closed_cov = np.einsum("k,kij->ij", weight, cov + apart[:, :, None] * apart[:, None, :]) / weight.sum()

    pick = rng.choice(6, count, p=np.exp(mixture.log_weight))
    u_root, x_root = np.linalg.cholesky(unpack(mixture.u_cov)), np.linalg.cholesky(unpack(mixture.x_cov))
    du = np.einsum("nij,nj->ni", u_root[pick], rng.standard_normal((count, 3)))
    u = mixture.u_mean[pick] + du
    x = mixture.x_mean[pick] + np.einsum("nij,nj->ni", mixture.jacobian[pick], du)
    products = du[:, :1] * du[:, 1:] - mixture.u_cov[pick, 1:3]
    x += np.einsum("nij,nj->ni", mixture.jacobian[pick][:, :, 1:], products) / mixture.u_mean[pick, :1]
    x += np.einsum("nij,nj->ni", x_root[pick], rng.standard_normal((count, 3)))
    # The cell's window is in the mixture already.
    off = offset - u[:, 1:]
    square = np.einsum("ni,ij,nj->n", off, np.linalg.inv(noise), off)
    wide, scale = angle_model.tail_share, angle_model.tail_scale
    log_ratio = np.logaddexp(np.log1p(-wide) - 0.5 * square, LEAST_LOG)
    if wide:
        log_ratio = np.logaddexp(log_ratio, np.log(wide / scale**2) - 0.5 * square / scale**2)
    log_ratio -= 0.5 * np.log(np.linalg.det(noise))
    log_ratio += 0.5 * (u[:, 1:] ** 2).sum(axis=1) / window**2 + 2.0 * np.log(window)
    log_ratio += log_likelihood(u[:, 0])
    drawn = np.exp(log_ratio)
    share = drawn / drawn.sum()
    assert 1.0 / (share**2).sum() > 2_000

    # Of a log-normal the closed form is a sum of Gaussians, which may be wrong by some per cent.
    assert (
        abs(drawn.mean() - weight.sum()) < 5.0 * drawn.std() / np.sqrt(count) + 0.02 * (error == "log") * weight.sum()
    )
    sampled = share @ x
    stray = np.sqrt((share**2) @ (x - sampled) ** 2)
    assert (np.abs(sampled - closed) < 5.0 * stray).all()
    products = (x - sampled)[:, :, None] * (x - sampled)[:, None, :]
    sampled_cov = np.einsum("n,nij->ij", share, products)
    cov_error = np.sqrt(np.einsum("n,nij->ij", share**2, (products - sampled_cov) ** 2))
    assert (np.abs(sampled_cov - closed_cov) < 5.0 * cov_error).all()
    # What is compared is much larger than what is allowed: the measurement moves the mean by metres.
    assert np.linalg.norm(sampled - x.mean(axis=0)) > 30.0 * np.linalg.norm(stray)
