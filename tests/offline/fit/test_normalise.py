"""Balance of a level: shares of places against their definition, and what balancing does to them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from rayfix_offline.fit.cells import assemble_level, fit_cells
from rayfix_offline.fit.normalise import balanced, balancing_steps
from rayfix_offline.fit.settings import TubeFit
from rayfix_offline.site import parse_site
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import WINDOW_RATIO, Level
from rayfix_tables.mixture import TubeMixture, pack
from tests.support.scenes.rooms import CABINET, ROOM, TABLE, finest_level, scene_of_boxes
from tests.support.tables.path_shares import path_shares

Array = NDArray[np.float64]
WINDOW = np.deg2rad(5.0)


def level_of(mean: Array, stdev: Array, log_mass: float) -> Level:
    """Level of which one cell holds components of the same weight at places, without slopes, m; others hold nothing."""
    grid = AngularGrid.from_spacing(WINDOW / 0.8)
    cell, count = 40, len(mean)
    offsets = np.zeros(grid.num_cells + 1, np.int64)
    offsets[cell + 1 :] = count
    log_masses = np.full(grid.num_cells, -np.inf)
    log_masses[cell] = log_mass
    mixture = TubeMixture(
        log_weight=np.full(count, -np.log(count)),
        u_mean=np.tile([5.0, 0.0, 0.0], (count, 1)),
        u_cov=np.tile(pack(np.diag([0.01, WINDOW**2, WINDOW**2])), (count, 1)),
        x_mean=mean,
        jacobian=np.zeros((count, 3, 3)),
        x_cov=pack(stdev[:, None, None] ** 2 * np.eye(3)),
        num_reflections=np.zeros(count),
        num_walls=np.zeros(count),
    )
    return Level(window=WINDOW, grid=grid, cell_offsets=offsets, cell_log_mass=log_masses, mixture=mixture.as_stored())


def open_space(size: tuple[int, int, int] = (40, 40, 40), voxel_size: float = 0.2) -> FreeSpace:
    return FreeSpace(origin=np.zeros(3), voxel_size=voxel_size, free=np.ones(size, bool))


def test_shares_are_those_of_a_gaussian_in_closed_form() -> None:
    """Half of a component at a wall lies beyond it."""
    level = level_of(np.array([[0.0, 4.0, 4.0]]), np.array([1.0]), log_mass=3.0)
    share, volume = path_shares(level, open_space())
    # Times the window, a measurement in the middle of the cell with the noise that the window is for.
    noise = WINDOW**2 / WINDOW_RATIO**2
    area = np.repeat(level.grid.solid_angles, level.grid.ring_cells)[40]
    window = 1.0 / (2.0 * np.pi * (WINDOW**2 + WINDOW**2 * noise / (WINDOW**2 - noise)))
    factor = 2.0 * np.pi * WINDOW**4 / (WINDOW**2 - noise)
    total = np.exp(3.0) * area * window * factor
    np.testing.assert_allclose((share * volume).sum(), 0.5 * total, rtol=3 / 64)  # of 64 points
    edges = 0.2 * np.arange(41)
    expected = total * np.diff(norm.cdf(edges))
    found = (share * volume).sum(axis=(1, 2))
    np.testing.assert_allclose(
        np.add.reduceat(found, [0, 5, 10]), np.add.reduceat(expected, [0, 5, 10]), atol=0.03 * total
    )


def test_places_with_too_little_are_raised_and_those_with_too_much_lowered() -> None:
    mean = np.array([[2.0, 4.0, 4.0], [6.0, 4.0, 4.0]])
    level = level_of(mean, np.array([0.5, 0.5]), log_mass=0.0)
    share, _ = path_shares(level, open_space())
    # Shares of the first are far below 1 everywhere, those of the second far above.
    log_weight = np.array([np.log(1e-5), np.log1p(-1e-5)], np.float32)
    level = replace(level, mixture=replace(level.mixture, log_weight=log_weight))
    level = replace(level, cell_log_mass=level.cell_log_mass + np.log(1e3 / share.max()))
    log_balance = balanced(level, open_space()).log_balance
    # No more than twice, or half, in each of three rounds; half at once where it is thin, which pulls that mean up.
    assert log_balance[0] == pytest.approx(3.0 * np.log(2.0), abs=1e-5)
    assert -3.0 * np.log(2.0) - 1e-5 < log_balance[1] < -2.0 * np.log(2.0)


def test_what_is_even_stays() -> None:
    """Components on a lattice that fill a space evenly, with the mass that makes all shares 1."""
    lattice = np.stack(np.meshgrid(*[np.arange(-2.0, 10.1, 0.5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    level = level_of(lattice, np.full(len(lattice), 0.5), log_mass=0.0)
    space = open_space()
    share, _ = path_shares(level, space)
    level = replace(level, cell_log_mass=level.cell_log_mass - np.log(share.mean()))
    log_balance = balanced(level, space).log_balance
    inside = ((lattice > 0.0) & (lattice < 8.0)).all(axis=1)
    # The points of a component fill a block unevenly, all in the same way.
    assert abs(log_balance[inside].mean()) < 0.03
    assert log_balance[inside].std() < 0.12


def test_without_components_or_free_space_there_is_nothing_to_balance() -> None:
    level = level_of(np.array([[2.0, 4.0, 4.0]]), np.array([0.5]), log_mass=0.0)
    empty = replace(level, mixture=TubeMixture.empty(), cell_offsets=np.zeros_like(level.cell_offsets))
    assert balanced(empty, open_space()).log_balance.shape == (0,)
    solid = replace(open_space(), free=np.zeros((40, 40, 40), bool))
    np.testing.assert_array_equal(balanced(level, solid).log_balance, 0.0)


@pytest.fixture(scope="module")
def room(
    tmp_path_factory: pytest.TempPathFactory, site_document: Callable[..., dict[str, Any]]
) -> tuple[Level, FreeSpace]:
    """Cells of 5 deg in a room with two boxes, for a station in its corner."""
    folder = tmp_path_factory.mktemp("room")
    site = parse_site(site_document(propagation={"max_reflections": 2}, table={"windows_deg": [5.0]}))
    rays = finest_level(folder, scene_of_boxes(room=ROOM, cabinet=CABINET, table=TABLE), site)
    level = assemble_level(rays.window, rays.grid, [fit_cells(np.arange(rays.grid.num_cells), rays, TubeFit())])
    free = np.ones((40, 50, 30), bool)
    for low, high in (CABINET, TABLE):
        (x0, y0, z0), (x1, y1, z1) = (np.round(10.0 * np.array(corner)).astype(int) for corner in (low, high))
        free[x0:x1, y0:y1, z0:z1] = False
    return level, FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=free)


def test_shares_of_a_room_come_closer_to_one(room: tuple[Level, FreeSpace]) -> None:
    level, space = room
    before, volume = path_shares(level, space)
    after, _ = path_shares(balanced(level, space), space)
    heard = (volume > 0.0) & (before > 0.3)
    assert volume[heard].sum() > 0.9 * volume.sum()  # two reflections reach all but a little

    def apart(share: Array) -> float:
        return float(np.average((share[heard] - 1.0) ** 2, weights=volume[heard]))

    assert apart(after) < 0.7 * apart(before)
    walls = np.zeros_like(heard)
    walls[0], walls[-1], walls[:, 0], walls[:, -1] = True, True, True, True
    low, high = (np.average(share[heard & walls], weights=volume[heard & walls]) for share in (before, after))
    assert low < 0.85
    assert low + 0.1 < high < 1.1


def test_a_component_without_a_covariance_keeps_its_weight() -> None:
    """Written by other software into a table, it made the whole normalisation fail with a LinAlgError."""
    level = level_of(np.array([[4.0, 4.0, 4.0], [0.5, 4.0, 4.0]]), np.array([0.3, 0.3]), log_mass=3.0)
    alone = level_of(np.array([[4.0, 4.0, 4.0]]), np.array([0.3]), log_mass=3.0 - np.log(2.0))
    x_cov = level.mixture.x_cov.copy()
    x_cov[1] = pack(-np.eye(3))
    broken = replace(level, mixture=replace(level.mixture, x_cov=x_cov))
    found = balanced(broken, open_space()).log_balance
    assert found[1] == 0.0
    assert found[0] == pytest.approx(balanced(alone, open_space()).log_balance[0], abs=1e-6)


def test_balancing_reports_all_of_its_steps_as_they_are_taken() -> None:
    level = level_of(np.full((3, 3), 4.0), np.ones(3), log_mass=3.0)
    steps: list[int] = []
    balanced(level, open_space(), advance=steps.append)
    assert sum(steps) == balancing_steps(level)
    assert max(steps) <= 3
