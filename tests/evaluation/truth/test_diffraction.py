"""Paths round an edge: where they bend, which edges there are, and their power beside ITU-R P.526's knife edge."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import fresnel

from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_evaluation.truth.walls import Walls
from tests.support.scenes.shapes import box, quad

Array = NDArray[np.float64]

CARRIER = 3.5
WAVELENGTH = 299792458.0 / 3.5e9
METAL = 1.0 - 1e7j
SCREEN = quad((0, -60, -60), (0, 60, -60), (0, 60, 0), (0, -60, 0))
"""Its upper edge is y, z = 0."""


def solver_of(triangles: Array, permittivity: complex = METAL, *, thickness: float = np.nan) -> ForwardSolver:
    """Solver with edges; nothing passes without a thickness."""
    count = len(triangles)
    walls = Walls.sheets(np.full(count, permittivity), np.full(count, thickness), carrier_ghz=CARRIER)
    return ForwardSolver.from_mesh(
        triangles.reshape(-1, 3),
        np.arange(3 * count).reshape(-1, 3),
        max_reflections=0,
        walls=walls,
        diffraction=True,
    )


def knife_edge_db(depth: float, before: float, after: float) -> float:
    """Loss of a knife edge that stands ``depth`` metres into the line between two ends (ITU-R P.526-15, eq. 26-30)."""
    v = depth * np.sqrt(2.0 / WAVELENGTH * (1.0 / before + 1.0 / after))
    s, c = fresnel(v)
    return float(-20.0 * np.log10(0.5 * np.sqrt((1.0 - c - s) ** 2 + (c - s) ** 2)))


@pytest.mark.parametrize("depth", [0.02, 0.1, 0.3])
def test_the_shadow_of_a_metal_screen_is_that_of_a_knife_edge(depth: float) -> None:
    """Ends 10 m before and behind it, low behind it: angles are small, where the knife edge holds."""
    paths = solver_of(SCREEN).station((-10, 0, -depth)).diffracted((10, 0, -depth))
    top = int(np.argmin(np.linalg.norm(paths.points, axis=1)))
    np.testing.assert_allclose(paths.points[top], 0.0, atol=1e-9)
    loss = -20.0 * np.log10(20.0) - paths.gain_db[top]
    assert loss == pytest.approx(knife_edge_db(depth, 10.0, 10.0), abs=0.2)


def test_the_angles_to_the_edge_are_equal_and_the_way_is_the_shortest() -> None:
    station, point = np.array([-3.0, -2.0, -1.0]), np.array([4.0, 3.5, -0.5])
    paths = solver_of(SCREEN).station(station).diffracted(point)
    i = int(np.argmin(np.abs(paths.points[:, 2])))
    along = paths.points[i] + np.linspace(-0.5, 0.5, 11)[:, None] * [0, 1, 0]
    ways = np.linalg.norm(along - station, axis=1) + np.linalg.norm(along - point, axis=1)
    assert ways.argmin() == 5
    assert paths.path_length[i] == pytest.approx(ways[5], abs=1e-12)
    before, after = paths.points[i] - station, point - paths.points[i]
    assert before[1] / np.linalg.norm(before) == pytest.approx(after[1] / np.linalg.norm(after), abs=1e-12)
    assert paths.azimuth[i] == pytest.approx(np.arctan2(before[1], before[0]))
    assert paths.zenith[i] == pytest.approx(np.arccos(before[2] / np.linalg.norm(before)))


def test_paths_are_the_same_both_ways() -> None:
    """Over a roof of wood, with both faces in play, and through a sheet beside it."""
    scene = np.concatenate(
        [box((0, -4, -3), (1.5, 4, 0)), quad((2.5, -9, -9), (2.5, 9, -9), (2.5, 9, 9), (2.5, -9, 9))]
    )
    count = len(scene)
    thickness = np.where(np.arange(count) < 12, np.nan, 0.05)
    walls = Walls.sheets(np.full(count, 2.0 - 0.1j), thickness, carrier_ghz=CARRIER)
    solver = ForwardSolver.from_mesh(
        scene.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), walls=walls, diffraction=True
    )
    a, b = np.array([-2.0, 0.3, 0.4]), np.array([4.0, -1.0, 1.1])
    there, back = solver.station(a).diffracted(b), solver.station(b).diffracted(a)
    assert len(there) == len(back) > 0
    assert there.num_walls.sum() > 0
    np.testing.assert_array_equal(np.sort(there.edges), np.sort(back.edges))
    order, other = np.argsort(there.edges), np.argsort(back.edges)
    np.testing.assert_allclose(there.path_length[order], back.path_length[other], atol=1e-9)
    np.testing.assert_array_equal(there.num_walls[order], back.num_walls[other][:, ::-1])


def test_which_edges_there_are() -> None:
    """A box has twelve; a sheet four, but for the side where it stands on another; no seam of a flat wall is one."""
    corners = np.array([(-1.0, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    floor = quad(*(9.0 * corners))
    for triangles, edges in (
        (box((0, 0, 0), (1, 2, 3)), 12),
        (quad(*corners), 4),
        (np.concatenate([quad(*corners), quad(*(corners + np.array([2.0, 0, 0])))]), 6),
        (np.concatenate([floor, quad((0, -1, 0), (0, 1, 0), (0, 1, 2), (0, -1, 2))]), 4 + 3),
        (np.concatenate([floor, box((0, 0, 0), (1, 2, 3))]), 4 + 8),
    ):
        found = solver_of(triangles).edges
        assert found is not None
        assert len(found.length) == edges


def test_inside_corners_and_blocked_edges_bend_nothing() -> None:
    room = solver_of(box((0, 0, 0), (4, 5, 3)))
    assert len(room.station((1, 1, 1)).diffracted((3, 4, 2))) == 0
    behind = np.concatenate([SCREEN, quad((1, -60, -60), (1, 60, -60), (1, 60, 60), (1, -60, 60))])
    around = solver_of(behind).station((-10, 0, -0.3)).diffracted((10, 0, -0.3))
    assert np.all(np.abs(around.points).max(axis=1) == 60.0)  # only round the outer edges of the wall behind


def test_a_wall_behind_the_edge_weakens_the_path() -> None:
    """By what the same wall takes from a straight path at that angle, a right one, of either polarisation."""
    wall = quad((5, -60, -60), (5, 60, -60), (5, 60, 60), (5, -60, 60))
    scene = np.concatenate([SCREEN, wall])
    walls = Walls.sheets(
        np.array([METAL, METAL, 4.0 - 0.2j, 4.0 - 0.2j]), np.array([np.nan, np.nan, 0.1, 0.1]), carrier_ghz=CARRIER
    )
    solver = ForwardSolver.from_mesh(scene.reshape(-1, 3), np.arange(12).reshape(-1, 3), walls=walls, diffraction=True)
    station, point = (-8.0, 0.0, -0.5), (10.0, 0.0, 0.0)
    through = solver.station(station).diffracted(point)
    free = solver_of(SCREEN).station(station).diffracted(point)
    i, j = (int(np.argmin(np.linalg.norm(paths.points, axis=1))) for paths in (through, free))
    straight = replace(solver, edges=None).paths((0.5, 0.0, 0.0), point)
    loss = -20.0 * np.log10(9.5) - straight.gain_db[0]
    assert free.gain_db[j] - through.gain_db[i] == pytest.approx(loss, abs=1e-6)
    assert through.num_walls[i].tolist() == [0, 1]
    assert through.path_length[i] - free.path_length[j] == pytest.approx(straight.path_length[0] - 9.5, abs=1e-9)


def test_edges_are_asked_for() -> None:
    with pytest.raises(ValueError, match="give walls"):
        ForwardSolver.from_mesh(SCREEN.reshape(-1, 3), np.arange(6).reshape(-1, 3), diffraction=True)
    plain = ForwardSolver.from_mesh(SCREEN.reshape(-1, 3), np.arange(6).reshape(-1, 3))
    with pytest.raises(ValueError, match="diffraction=True"):
        plain.station((0, 0, 1)).diffracted((1, 0, 1))
