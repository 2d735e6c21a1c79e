"""Cells fitted by expectation-maximisation on sampled points."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_offline.fit.em import fit_em, sample_points
from rayfix_offline.fit.settings import ExpectationMaximisation, RayFit, TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.rays.trace import LevelRays
from rayfix_offline.site import parse_site
from rayfix_tables.geometry.angles import direction
from rayfix_tables.mixture import FIELD_SHAPES, unpack
from tests.support.scenes.rooms import CABINET, ROOM, finest_level, scene_of_boxes

CELLS = np.array([250, 100, 3])
FEW = ExpectationMaximisation(num_points=1000, num_components=(2, 6), seed=3)


@pytest.fixture(scope="module")
def level(tmp_path_factory: pytest.TempPathFactory, site_document: Callable[..., dict[str, Any]]) -> LevelRays:
    """Trace the room with one box at a window of 10 deg, one reflection."""
    scene = scene_of_boxes(room=ROOM, cabinet=CABINET)
    return finest_level(tmp_path_factory.mktemp("room"), scene, parse_site(site_document()))


def moments_of_pieces(level: LevelRays, cell: int) -> tuple[NDArray[np.float64], float, float]:
    """Mean over (L, x), variance of L and mass of a cell's weighted pieces."""
    rays, pieces, sequences = level.rays, level.pieces, level.sequences
    ray = np.repeat(np.arange(len(rays)), np.diff(pieces.offsets))
    centre = level.grid.centres[cell]
    turn = rays.azimuth - centre[0]
    turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
    square = ((np.sin(centre[1]) * turn) ** 2 + (rays.zenith - centre[1]) ** 2) / level.window**2
    window = np.where(square <= RayFit.cutoff**2, np.exp(-square / 2.0), 0.0) / (2.0 * np.pi * level.window**2)
    weight = (window * rays.solid_angle)[ray] * pieces.mass
    heading = np.einsum("nij,nj->ni", sequences.mirrors[pieces.sequence], rays.directions[ray])
    place = sequences.images[pieces.sequence] + pieces.mean[:, None] * heading
    mean = weight @ np.concatenate([pieces.mean[:, None], place], axis=1) / weight.sum()
    variance = weight @ (pieces.variance + (pieces.mean - mean[0]) ** 2) / weight.sum()
    return mean, float(variance), float(weight.sum())


@pytest.mark.parametrize("cell", CELLS)
def test_points_are_drawn_from_the_measure_of_the_cell(level: LevelRays, cell: int) -> None:
    count = 20_000
    points, labels, mass = sample_points(level.grid.centres[cell], level, count, np.random.default_rng(0))
    assert points.shape == (count, 6)
    expected, variance, its_mass = moments_of_pieces(level, int(cell))
    assert mass == pytest.approx(its_mass, rel=1e-12)
    found = points[:, [0, 3, 4, 5]]
    # Four standard errors, and the bend of a ray's patch.
    tolerance = 4.0 * found.std(axis=0) / np.sqrt(count) + 10.0 * level.ray_spacing**2
    assert np.all(np.abs(found.mean(axis=0) - expected) < tolerance)
    assert points[:, 0].var() == pytest.approx(variance, rel=0.05)
    assert set(labels.num_reflections.tolist()) <= {0, 1}


def test_points_are_where_their_ray_coordinates_say(level: LevelRays) -> None:
    """The direct ones lie at station + L direction(a)."""
    centre = level.grid.centres[CELLS[0]]
    points, labels, _ = sample_points(centre, level, 500, np.random.default_rng(1))
    direct = points[labels.num_reflections == 0]
    heading = direction(centre[0] + direct[:, 1] / np.sin(centre[1]), centre[1] + direct[:, 2])
    np.testing.assert_allclose(direct[:, 3:], (3.6, 0.4, 2.6) + direct[:, :1] * heading, rtol=0, atol=1e-9)
    assert 100 < len(direct) < 500


def test_the_fit_is_valid(level: LevelRays) -> None:
    counts, log_mass, mixture, _ = fit_em(level.grid.centres[CELLS], CELLS, level, FEW)
    assert set(counts.tolist()) <= {2, 6}
    assert len(mixture) == counts.sum()
    _, tubes_mass, _, _ = fit_tubes(level.grid.centres[CELLS], level, TubeFit())
    np.testing.assert_allclose(log_mass, tubes_mass, rtol=0, atol=1e-12)
    ends = np.cumsum(counts)
    for cell, end, count in zip(CELLS, ends, counts, strict=True):
        part = mixture[int(end - count) : int(end)]
        weight = np.exp(part.log_weight.astype(float))
        assert weight.sum() == pytest.approx(1.0, abs=1e-5)
        points, _, _ = sample_points(level.grid.centres[cell], level, 20_000, np.random.default_rng(7))
        # EM keeps the mean of its points: 1,000 of them, up to 4 standard errors.
        found = weight @ np.concatenate([part.u_mean, part.x_mean], axis=1)
        error = 4.0 * points.std(axis=0) / np.sqrt(FEW.num_points)
        assert np.all(np.abs(found - points.mean(axis=0)) < error)
    u_cov, x_cov = unpack(mixture.u_cov).astype(float), unpack(mixture.x_cov).astype(float)
    assert np.all(u_cov[:, 0, 0] >= 0.99 * RayFit.length_floor**2)
    assert np.linalg.eigvalsh(u_cov).min() > 0.0
    assert np.linalg.eigvalsh(x_cov).min() > 0.9 * RayFit.position_floor**2
    assert set(mixture.num_reflections.tolist()) <= {0, 1}


def test_more_components_are_taken_where_they_pay(level: LevelRays) -> None:
    """BIC prefers six to one where rays are direct and mirrored, and one where that is all there is to choose."""
    centres = level.grid.centres[CELLS]
    chosen, _, _, _ = fit_em(centres, CELLS, level, ExpectationMaximisation(num_points=1000, num_components=(1, 6)))
    assert chosen.tolist() == [6, 6, 6]
    only, _, _, _ = fit_em(centres, CELLS, level, ExpectationMaximisation(num_points=1000, num_components=(1,)))
    assert only.tolist() == [1, 1, 1]


def test_seed_and_cell_decide_and_not_the_block(level: LevelRays) -> None:
    def fit(cells: NDArray[np.int64], seed: int) -> NDArray[np.float32]:
        settings = ExpectationMaximisation(num_points=300, num_components=(2,), seed=seed)
        mixture = fit_em(level.grid.centres[cells], cells, level, settings)[2]
        return np.concatenate([getattr(mixture, name).reshape(len(mixture), -1) for name in FIELD_SHAPES], axis=1)

    together, alone, other = fit(CELLS, 3), fit(CELLS[1:2], 3), fit(CELLS, 4)
    np.testing.assert_array_equal(together[2:4], alone)
    # Two cells draw different points, even around one centre.
    settings = ExpectationMaximisation(num_points=300, num_components=(2,), seed=3)
    twins = fit_em(level.grid.centres[[250, 250]], np.array([1, 2]), level, settings)[2]
    assert np.abs(twins.x_mean[:2] - twins.x_mean[2:]).max() > 1e-3
    np.testing.assert_array_equal(together, fit(CELLS, 3))
    assert np.abs(together[:, 1] - other[:, 1]).max() > 1e-3
