"""Cells fitted by moments: masses and places in closed form, moments kept, and the fit judged on held-out points."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_offline.fit.em import fit_em, sample_points
from rayfix_offline.fit.settings import ExpectationMaximisation, RayFit, TubeFit
from rayfix_offline.fit.tubes import Fitted, Labels, fit_tubes, fitted_cells
from rayfix_offline.rays.trace import LevelRays
from rayfix_offline.site import parse_site
from rayfix_tables.geometry.angles import direction, tangent
from rayfix_tables.mixture import TubeMixture, unpack, widening_cov
from tests.support.scenes.rooms import CABINET, ROOM, TABLE, finest_level, scene_of_boxes

Array = NDArray[np.float64]
STATION = np.array([3.6, 0.4, 2.6])
INSIDE = 1.0 - np.exp(-(RayFit.cutoff**2) / 2.0)  # share of a cell's window within its cut-off


@pytest.fixture(scope="module")
def empty_level(tmp_path_factory: pytest.TempPathFactory, site_document: Callable[..., dict[str, Any]]) -> LevelRays:
    """Trace the empty room at a window of 5 deg, without reflections and with s^2 alone as weight."""
    scene = trimesh.Scene(trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)]))
    document = site_document(propagation={"max_reflections": 0, "path_prior": "uniform"}, table={"windows_deg": [5.0]})
    return finest_level(tmp_path_factory.mktemp("empty"), scene, parse_site(document))


@pytest.fixture(scope="module")
def cluttered_level(
    tmp_path_factory: pytest.TempPathFactory, site_document: Callable[..., dict[str, Any]]
) -> LevelRays:
    """Trace the room with two boxes at a window of 5 deg, two reflections, the default prior."""
    scene = scene_of_boxes(room=ROOM, cabinet=CABINET, table=TABLE)
    document = site_document(propagation={"max_reflections": 2}, table={"windows_deg": [5.0]})
    return finest_level(tmp_path_factory.mktemp("cluttered"), scene, parse_site(document))


def cells_of(mixture: TubeMixture, counts: NDArray[np.int64]) -> list[TubeMixture]:
    """Split a block's mixture into its cells."""
    ends = np.cumsum(counts)
    return [mixture[int(end - count) : int(end)] for count, end in zip(counts, ends, strict=True)]


def joint(mixture: TubeMixture) -> tuple[Array, Array, Array]:
    """Weights, means and covariances over (L, a, x), from the stored form."""
    weight = np.exp(np.asarray(mixture.log_weight, np.float64))
    u_cov, x_cov = unpack(mixture.u_cov).astype(np.float64), unpack(mixture.x_cov).astype(np.float64)
    slope = mixture.jacobian.astype(np.float64)
    cross = slope @ u_cov
    cov = np.zeros((len(mixture), 6, 6))
    cov[:, :3, :3], cov[:, 3:, :3] = u_cov, cross
    cov[:, :3, 3:] = np.swapaxes(cross, 1, 2)
    cov[:, 3:, 3:] = x_cov + cross @ np.swapaxes(slope, 1, 2) + widening_cov(mixture.u_mean, u_cov, slope)
    return weight, np.concatenate([mixture.u_mean, mixture.x_mean], axis=1).astype(np.float64), cov


def overall(weight: Array, mean: Array, cov: Array) -> tuple[Array, Array]:
    """Mean and covariance of a whole mixture."""
    middle = weight @ mean / weight.sum()
    off = mean - middle
    return middle, np.einsum("n,nij->ij", weight / weight.sum(), cov + off[:, :, None] * off[:, None, :])


def log_density(mixture: TubeMixture, points: Array) -> Array:
    """Logarithm of a cell's density over (L, a, x) at points of shape (n, 6)."""
    terms = []
    for k in range(len(mixture)):
        total = np.full(len(points), float(mixture.log_weight[k]) - 3.0 * np.log(2.0 * np.pi))
        off = points[:, :3] - mixture.u_mean[k]
        products = off[:, :1] * off[:, 1:] - mixture.u_cov[k, 1:3]
        widening = products @ mixture.jacobian[k, :, 1:].T / mixture.u_mean[k, 0]
        rest = points[:, 3:] - mixture.x_mean[k] - off @ mixture.jacobian[k].T - widening
        for part, packed in ((off, mixture.u_cov[k]), (rest, mixture.x_cov[k])):
            lower = np.linalg.cholesky(unpack(packed).astype(np.float64))
            solved = np.linalg.solve(lower, part.T)
            total -= 0.5 * (solved**2).sum(axis=0) + np.log(np.diag(lower)).sum()
        terms.append(total)
    return np.asarray(np.logaddexp.reduce(np.array(terms), axis=0))


# The empty room


def wall_distance(azimuth: Array, zenith: Array) -> Array:
    """Distance of the empty room's walls from the station, m."""
    heading = direction(azimuth, zenith)
    heading = np.where(heading == 0.0, 1e-12, heading)
    return np.asarray(((np.where(heading > 0, (4.0, 5.0, 3.0), 0.0) - STATION) / heading).min(axis=-1))


def test_the_mass_of_each_cell_is_its_integral(empty_level: LevelRays) -> None:
    """Window x s^2 over directions and lengths: N(a; 0, W) d^3 / 3 dOmega with the walls at the distance d.

    The rays of a cell are some 250 random draws, which leave 1 % of noise.
    """
    level = empty_level
    cells = np.arange(1, level.grid.num_cells, 11)
    _, log_mass, _, _ = fit_tubes(level.grid.centres[cells], level, TubeFit())
    nodes = np.linspace(-RayFit.cutoff, RayFit.cutoff, 121)
    h, v = np.meshgrid(nodes, nodes, indexing="ij")
    disc = h**2 + v**2 <= RayFit.cutoff**2
    window = np.exp(-(h**2 + v**2) / 2.0)[disc] / (2.0 * np.pi) * (nodes[1] - nodes[0]) ** 2
    ratio = []
    for cell, found in zip(cells, log_mass, strict=True):
        azimuth, zenith = level.grid.centres[cell]
        at_azimuth = azimuth + level.window * h[disc] / np.sin(zenith)
        at_zenith = zenith + level.window * v[disc]
        wrapped = np.abs(level.window * h[disc]) < np.sin(zenith) * np.pi
        whole = (at_zenith > 0.0) & (at_zenith < np.pi) & wrapped
        density = window * np.sin(at_zenith) / np.sin(zenith)
        expected = np.sum((density * wall_distance(at_azimuth, at_zenith) ** 3 / 3.0)[whole])
        ratio.append(np.exp(found) / expected)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.01)
    assert np.abs(np.array(ratio) - 1.0).max() < 0.06


def test_all_masses_add_up_to_the_volume(empty_level: LevelRays) -> None:
    """Windows around all cells cover each direction alike, so s^2 ds dOmega adds up to the room, 60 m3."""
    level = empty_level
    _, log_mass, _, _ = fit_tubes(level.grid.centres, level, TubeFit())
    solid_angle = np.repeat(level.grid.solid_angles, level.grid.ring_cells)
    # The window's integral over the sphere is exp(-window^2 / 2) of one, as in the chart.
    assert np.sum(np.exp(log_mass) * solid_angle) == pytest.approx(60.0 * INSIDE, rel=0.01)


def test_places_lie_in_the_direction_of_their_angles(empty_level: LevelRays) -> None:
    """One straight tube a cell: x = station + L direction(a), at the mean and a standard deviation around it.

    A tube is straight and the sphere is not: over an angle t, it is off by L t^2 / 2.
    """
    level = empty_level
    cells = np.arange(3, level.grid.num_cells, 41)
    counts, _, mixture, _ = fit_tubes(level.grid.centres[cells], level, TubeFit())
    for centre, cell in zip(level.grid.centres[cells], cells_of(mixture, counts), strict=True):
        for k in range(len(cell)):
            mean = cell.u_mean[k].astype(float)
            deviation = np.sqrt(np.diag(unpack(cell.u_cov[k]).astype(float)))
            for step in np.vstack([np.zeros(3), np.diag(deviation)]):
                u = mean + step
                azimuth, zenith = centre[0] + u[1] / np.sin(centre[1]), centre[1] + u[2]
                exact = STATION + u[0] * direction(azimuth, zenith)
                found = cell.x_mean[k] + cell.jacobian[k] @ step
                bent = u[0] * (2.0 * level.window) ** 2 / np.sin(centre[1])
                assert np.linalg.norm(found - exact) < bent + 0.01
    assert np.all(mixture.num_reflections == 0)
    assert np.all(mixture.u_mean[:, 0] > 0.0)


def test_no_place_is_outside_the_room(empty_level: LevelRays) -> None:
    _, _, mixture, _ = fit_tubes(empty_level.grid.centres, empty_level, TubeFit())
    assert np.all(mixture.x_mean > -0.01)
    assert np.all(mixture.x_mean < np.array([4.01, 5.01, 3.01]))


# The cluttered room


@pytest.fixture(scope="module")
def fitted(cluttered_level: LevelRays) -> Fitted:
    """All cells of the cluttered room."""
    return fit_tubes(cluttered_level.grid.centres, cluttered_level, TubeFit())


def test_mixtures_are_valid(cluttered_level: LevelRays, fitted: Fitted) -> None:
    counts, log_mass, mixture, _ = fitted
    assert np.all((counts >= 1) & (counts <= TubeFit().max_components))
    assert np.all(np.isfinite(log_mass))
    for cell in cells_of(mixture, counts):
        assert np.exp(cell.log_weight.astype(float)).sum() == pytest.approx(1.0, abs=1e-5)
    u_cov, x_cov = unpack(mixture.u_cov).astype(float), unpack(mixture.x_cov).astype(float)
    scale = np.sqrt(np.einsum("nii->ni", u_cov))
    assert np.linalg.eigvalsh(u_cov / (scale[:, :, None] * scale[:, None, :])).min() > 1e-6
    # Given the ray coordinates, at least the floor is left; single precision takes a part in 1e6 of the largest.
    assert np.linalg.eigvalsh(x_cov).min() > 0.9 * RayFit.position_floor**2
    assert set(mixture.num_reflections.tolist()) == {0, 1, 2}
    assert all(np.isfinite(getattr(mixture, name)).all() for name in ("x_mean", "jacobian", "u_mean"))


def test_the_fit_keeps_the_moments_of_the_rays(cluttered_level: LevelRays, fitted: Fitted) -> None:
    """Merging keeps mean and covariance, so they are those of the pieces but for blur and the dropped mass of 1e-4."""
    level, (counts, log_mass, mixture, _) = cluttered_level, fitted
    rays, pieces, sequences = level.rays, level.pieces, level.sequences
    ray = np.repeat(np.arange(len(rays)), np.diff(pieces.offsets))
    heading = np.einsum("nij,nj->ni", sequences.mirrors[pieces.sequence], rays.directions[ray])
    place = sequences.images[pieces.sequence] + pieces.mean[:, None] * heading
    along = np.concatenate([np.ones((len(ray), 1)), np.zeros((len(ray), 2)), heading], axis=1)
    cells = cells_of(mixture, counts)
    for cell in range(10, len(cells), 100):
        at = tangent(rays.azimuth, rays.zenith, *level.grid.centres[cell])
        square = (at**2).sum(axis=1) / level.window**2
        window = np.where(square <= RayFit.cutoff**2, np.exp(-square / 2.0), 0.0) / (2.0 * np.pi * level.window**2)
        weight = (window * rays.solid_angle)[ray] * pieces.mass
        points = np.concatenate([pieces.mean[:, None], at[ray], place], axis=1)
        mean = weight @ points / weight.sum()
        off = points - mean
        cov = np.einsum("n,ni,nj->ij", weight / weight.sum(), off, off)
        cov += np.einsum("n,ni,nj->ij", weight / weight.sum() * pieces.variance, along, along)
        assert np.exp(log_mass[cell]) == pytest.approx(weight.sum(), rel=1e-10)
        found_mean, found_cov = overall(*joint(cells[cell]))
        np.testing.assert_allclose(found_mean, mean, rtol=0, atol=3e-3)
        # The blur: 5 cm along the tube, and a ray's patch, 0.029 rad / sqrt(12) x 8 m, across it.
        widths = np.sqrt(np.diag(cov))
        gap = np.abs(found_cov - cov) - 0.01 * np.outer(widths, widths)
        assert gap[0, 0] < 0.05**2
        assert gap[1:3, 1:3].max() < level.ray_spacing**2 / 12.0
        assert gap[3:, 3:].max() < 0.05**2 + (8.0 * level.ray_spacing) ** 2 / 12.0


def test_cells_do_not_know_of_each_other(cluttered_level: LevelRays, fitted: Fitted) -> None:
    counts, log_mass, mixture, _ = fitted
    cells = np.array([700, 3, 411])
    some, its_mass, parts, _ = fit_tubes(cluttered_level.grid.centres[cells], cluttered_level, TubeFit())
    np.testing.assert_array_equal(some, counts[cells])
    np.testing.assert_array_equal(its_mass, log_mass[cells])
    whole = cells_of(mixture, counts)
    for cell, part in zip(cells, cells_of(parts, some), strict=True):
        for name in ("log_weight", "u_mean", "x_cov"):
            np.testing.assert_array_equal(getattr(part, name), getattr(whole[cell], name))


@pytest.mark.parametrize("most", [1, 5])
def test_few_components(cluttered_level: LevelRays, most: int) -> None:
    """Down to one Gaussian of the cell's moments."""
    centres = cluttered_level.grid.centres[[500, 777]]
    many, _, parts, _ = fit_tubes(centres, cluttered_level, TubeFit())
    few, _, merged, _ = fit_tubes(centres, cluttered_level, TubeFit(max_components=most))
    assert few.tolist() == [most, most] < many.tolist()
    for before, after in zip(cells_of(parts, many), cells_of(merged, few), strict=True):
        for mine, theirs in zip(overall(*joint(after)), overall(*joint(before)), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=0, atol=2e-5 * 60.0)


def test_rays_that_weigh_nothing_leave_empty_cells(cluttered_level: LevelRays) -> None:
    pieces = replace(cluttered_level.pieces, mass=np.zeros_like(cluttered_level.pieces.mass))
    level = replace(cluttered_level, pieces=pieces)
    centres, cells = level.grid.centres[:3], np.arange(3)
    for counts, log_mass, mixture, _ in (
        fit_tubes(centres, level, TubeFit()),
        fit_em(centres, cells, level, ExpectationMaximisation()),
    ):
        assert counts.tolist() == [0, 0, 0]
        np.testing.assert_array_equal(log_mass, -np.inf)
        assert len(mixture) == 0


def held_out_gain(level: LevelRays, cells: NDArray[np.int64]) -> Array:
    """By how much tubes explain points that neither fit has seen better than EM, nats a point, for each cell."""
    centres = level.grid.centres[cells]
    counts, _, tubes, _ = fit_tubes(centres, level, TubeFit())
    em_counts, _, em, _ = fit_em(centres, cells, level, ExpectationMaximisation(seed=1))
    gain = []
    for n, (mine, theirs) in enumerate(zip(cells_of(tubes, counts), cells_of(em, em_counts), strict=True)):
        points, _, _ = sample_points(centres[n], level, 4000, np.random.default_rng([99, cells[n]]))
        gain.append(log_density(mine, points).mean() - log_density(theirs, points).mean())
    return np.array(gain)


def test_tubes_explain_held_out_points_hardly_worse_than_em(cluttered_level: LevelRays) -> None:
    """At a window this wide EM is ahead by 0.7 nats in the mean, some centimetres across the tubes; never by far."""
    cells = np.random.default_rng(5).choice(cluttered_level.grid.num_cells, 10, replace=False)
    gain = held_out_gain(cluttered_level, cells)
    assert gain.mean() > -1.0
    assert gain.min() > -3.0


@pytest.mark.slow
def test_tubes_are_within_a_nat_of_em_in_the_mean_of_many_cells(cluttered_level: LevelRays) -> None:
    cells = np.random.default_rng(6).choice(cluttered_level.grid.num_cells, 40, replace=False)
    gain = held_out_gain(cluttered_level, cells)
    assert gain.mean() + 2.0 * gain.std() / np.sqrt(len(gain)) > -1.0
    assert gain.mean() > -1.0


def joint_moments(variance: Array) -> tuple[Array, Array]:
    """Means and covariances of components of these variances of the path length, m2, all else being independent."""
    mean = np.tile([5.0, 0.0, 0.0, 1.0, 2.0, 3.0], (len(variance), 1))
    cov = np.tile(np.diag([1.0, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4]), (len(variance), 1, 1))
    cov[:, 0, 0] = variance
    return mean, cov


def as_cells(counts: list[int], weight: Array, variance: Array) -> Fitted:
    """Turn components of cells of mass 1 into mixtures."""
    mean, cov = joint_moments(variance)
    log_mass, labels = np.zeros(len(counts)), Labels(np.zeros(len(weight), np.int8), np.zeros(len(weight), np.int8))
    return fitted_cells(np.array(counts), log_mass, np.log(weight), mean, cov, labels, position_floor=0.002)


@pytest.mark.parametrize("variance", [0.0, -1.0, np.nan, np.inf])
def test_a_component_without_a_covariance_is_dropped_with_its_weight(variance: float) -> None:
    """It made the whole build fail with a LinAlgError, or went into the table."""
    counts, log_mass, mixture, dropped = as_cells(
        [2, 3], np.array([0.5, 0.5, 0.2, 0.3, 0.5]), np.array([1.0, 1.0, 1.0, variance, 1.0])
    )
    assert counts.tolist() == [2, 2]
    assert dropped.tolist() == [0, 1]
    np.testing.assert_allclose(log_mass, [0.0, np.log(0.7)], rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.exp(mixture.log_weight), [0.5, 0.5, 2 / 7, 5 / 7], rtol=1e-6)


def test_a_cell_without_any_covariance_is_empty() -> None:
    counts, log_mass, mixture, dropped = as_cells([1, 1], np.array([1.0, 1.0]), np.array([1.0, -1.0]))
    assert (counts.tolist(), dropped.tolist()) == ([1, 0], [0, 1])
    assert log_mass.tolist() == [0.0, -np.inf]
    assert len(mixture) == 1


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_covariances_are_definite_as_the_table_holds_them(seed: int) -> None:
    """Thin and long components in all directions; in single precision many of them were singular."""
    rng = np.random.default_rng(seed)
    root = np.linalg.qr(rng.normal(size=(20, 6, 6)))[0] * 10.0 ** rng.uniform(-3.5, 2.0, (20, 1, 6))
    cov = root @ root.transpose(0, 2, 1)
    mean = np.abs(rng.normal(size=(20, 6))) + 1.0
    log_weight = np.full(20, -np.log(20.0))
    labels = Labels(np.zeros(20, np.int8), np.zeros(20, np.int8))
    found = fitted_cells(np.array([20]), np.zeros(1), log_weight, mean, cov, labels, position_floor=0.002)
    assert found.counts[0] + found.dropped[0] == 20
    assert len(found.mixture) > 15
    for packed in (found.mixture.u_cov, found.mixture.x_cov):
        np.linalg.cholesky(unpack(packed.astype(np.float64)))
