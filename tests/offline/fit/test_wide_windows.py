"""Cells of wide windows as sums of finer ones: the measure they stand for, and what measurements see of it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.special import logsumexp

from rayfix_offline.fit.cells import assemble_level, fit_cells
from rayfix_offline.fit.em import sample_points
from rayfix_offline.fit.settings import CoarseFit, TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.fit.wide_windows import sum_cells
from rayfix_offline.rays.trace import LevelRays, trace_station
from rayfix_offline.site import parse_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_tables.level import WINDOW_RATIO, Level
from rayfix_tables.mixture import TubeMixture, joint_cov
from tests.support.scenes.rooms import CABINET, ROOM, TABLE, finest_level, scene_of_boxes

Array = NDArray[np.float64]
WIDE = np.deg2rad(12.0)
CENTRES = np.array([[2.2, 1.7], [1.9, 2.1], [-2.8, 1.6], [2.9, 1.2]])


@pytest.fixture(scope="module")
def fine(
    tmp_path_factory: pytest.TempPathFactory, site_document: Callable[..., dict[str, Any]]
) -> tuple[LevelRays, Level]:
    """Rays and cells of 3 deg in the room with two boxes, two reflections, for a station in its corner."""
    scene = scene_of_boxes(room=ROOM, cabinet=CABINET, table=TABLE)
    site = parse_site(site_document(propagation={"max_reflections": 2}, table={"windows_deg": [3.0]}))
    rays = finest_level(tmp_path_factory.mktemp("room"), scene, site)
    cells = np.arange(rays.grid.num_cells)
    return rays, assemble_level(rays.window, rays.grid, [fit_cells(cells, rays, TubeFit())])


def wide_cells(level: Level, fit: CoarseFit) -> list[tuple[float, TubeMixture]]:
    """Log masses and mixtures of the wide cells."""
    summed = sum_cells(CENTRES, WIDE, level, np.zeros(level.num_cells, np.float32), fit)
    ends = np.cumsum(summed.counts)
    parts = [summed.mixture[int(end - n) : int(end)] for n, end in zip(summed.counts, ends, strict=True)]
    return list(zip(summed.log_mass.tolist(), parts, strict=True))


def joint(mixture: TubeMixture) -> tuple[Array, Array, Array]:
    """Log weights, means and covariances over (L, a, x), from the stored form."""
    mean = np.concatenate([mixture.u_mean, mixture.x_mean], axis=1)
    return mixture.log_weight.astype(np.float64), mean, joint_cov(mixture)


def as_measured(points: Array, mixture: TubeMixture, variances: Array, rng: np.random.Generator) -> float:
    """Mean log density of points whose length and angles are measured with noise of these variances."""
    log_weight, mean, cov = joint(mixture)
    cov[:, range(6), range(6)] += variances
    apart = points + rng.normal(size=points.shape) * np.sqrt(variances) - mean[:, None]
    square = np.einsum("kni,kij,knj->kn", apart, np.linalg.inv(cov), apart)
    log_norm = log_weight - 0.5 * (np.linalg.slogdet(cov)[1] + 6.0 * np.log(2.0 * np.pi))
    return float(logsumexp(log_norm[:, None] - 0.5 * square, axis=0).mean())


def test_the_measure_is_that_of_the_rays_in_the_wide_window(fine: tuple[LevelRays, Level]) -> None:
    """Mass, mean and spread of points drawn from the rays themselves, within the wide window."""
    rays, level = fine
    wide = replace(rays, window=WIDE)
    for centre, (log_mass, mixture) in zip(CENTRES, wide_cells(level, CoarseFit()), strict=True):
        points, _, mass = sample_points(centre, wide, 20_000, np.random.default_rng(0))
        # Either is cut at three deviations, the sum also where its summands are: 1.1 % each.
        assert np.exp(log_mass) == pytest.approx(mass, rel=0.02)
        log_weight, mean, cov = joint(mixture)
        weight = np.exp(log_weight)
        middle = weight @ mean
        spread = points.std(axis=0)
        assert np.all(np.abs(middle - points.mean(axis=0)) < 0.03 * spread)
        apart = mean - middle
        whole = np.einsum("k,kij->ij", weight, cov + apart[:, :, None] * apart[:, None, :])
        np.testing.assert_allclose(np.sqrt(np.diag(whole)), spread, rtol=0.03)


def test_merging_costs_little_of_what_measurements_see(fine: tuple[LevelRays, Level]) -> None:
    """Points drawn from the rays, measured with the least noise that the wide window serves."""
    rays, level = fine
    wide = replace(rays, window=WIDE)
    angle = rays.window / WINDOW_RATIO
    variances = np.array([0.1**2, angle**2, angle**2, 0.0, 0.0, 0.0])
    counts, _, wide_fit, _ = fit_tubes(CENTRES, wide, TubeFit())
    direct = np.split(np.arange(len(wide_fit)), np.cumsum(counts)[:-1])
    kept = wide_cells(level, CoarseFit(max_divergence=0.0))
    losses, gains = [], []
    for n, (_, merged) in enumerate(wide_cells(level, CoarseFit())):
        points, _, _ = sample_points(CENTRES[n], wide, 2_000, np.random.default_rng(n))
        all_of_them, some, gathered = (
            as_measured(points, mixture, variances, np.random.default_rng(7))
            for mixture in (kept[n][1], merged, wide_fit[slice(direct[n][0], direct[n][-1] + 1)])
        )
        assert len(merged) < 0.25 * len(kept[n][1])
        losses.append(all_of_them - some)
        gains.append(some - gathered)
    assert np.mean(losses) < 0.35
    # What the sums are for: Gaussians gathered over the whole window blur the edges that cut its rays off.
    assert min(gains) > 0.0
    assert np.mean(gains) > 0.1


def test_changes_are_shared_like_mass(fine: tuple[LevelRays, Level]) -> None:
    _, level = fine
    change = np.full(level.num_cells, 0.01, np.float32)
    everywhere = sum_cells(CENTRES, WIDE, level, change, CoarseFit()).change
    np.testing.assert_allclose(everywhere, 0.01 / 0.99 / (1.0 - 0.01 / 0.99), rtol=1e-5)
    change[level.grid.centres[:, 1] > np.pi / 2] = 0.0
    upper = sum_cells(CENTRES, WIDE, level, change, CoarseFit()).change
    assert np.all((upper > 0.0) & (upper < 0.01))
    assert upper[3] > upper[1]


def test_where_no_ray_comes_the_cell_is_empty(fine: tuple[LevelRays, Level]) -> None:
    _, level = fine
    nothing = Level(
        window=level.window,
        grid=level.grid,
        cell_offsets=np.zeros(level.num_cells + 1, np.int64),
        cell_log_mass=np.full(level.num_cells, -np.inf),
        mixture=TubeMixture.empty(),
    )
    summed = sum_cells(CENTRES[:2], WIDE, nothing, np.zeros(level.num_cells, np.float32), CoarseFit())
    assert summed.counts.tolist() == [0, 0]
    assert np.all(np.isneginf(summed.log_mass))
    assert len(summed.mixture) == 0


def test_a_site_of_two_windows(tmp_path: Path, site_document: Callable[..., dict[str, Any]]) -> None:
    """Near the poles of the grid too, every cell that rays come to has finite numbers and weights of 1."""
    scene = trimesh.Scene(trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)]))
    (tmp_path / "room.glb").write_bytes(scene.export(file_type="glb"))
    site = parse_site(site_document(table={"windows_deg": [8.0]}))
    rays = trace_station(site.stations[0], site, prepare_twin(site, tmp_path)).finest
    level = assemble_level(rays.window, rays.grid, [fit_cells(np.arange(rays.grid.num_cells), rays, TubeFit())])
    grid = type(rays.grid).from_spacing(np.deg2rad(20.0))
    summed = sum_cells(grid.centres, np.deg2rad(16.0), level, np.zeros(level.num_cells, np.float32), CoarseFit())
    assert np.all(np.isfinite(summed.log_mass))
    assert np.all(summed.counts > 0)
    totals = np.add.reduceat(np.exp(summed.mixture.log_weight), np.cumsum(summed.counts) - summed.counts)
    np.testing.assert_allclose(totals, 1.0, rtol=1e-5)
