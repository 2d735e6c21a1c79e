"""Rays that pass walls: closed forms of one sheet and one solid, and a naive trace of all branches."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from rayfix_offline.rays.launch import launch
from rayfix_offline.rays.pathmap import fill_path_map
from rayfix_offline.rays.pathprior import fill_path_prior
from rayfix_offline.rays.rays import sample_rays
from rayfix_offline.rays.segments import Segments
from rayfix_offline.rays.settings import RaySettings
from rayfix_offline.scene.engine import EmbreeEngine
from rayfix_offline.scene.slabs import excess_length, slab_power
from rayfix_offline.scene.walls import Walls, opaque_walls
from rayfix_offline.twin.planes import merge_coplanar
from rayfix_tables.freespace import FreeSpace
from tests.support.scenes.shapes import box, quad

GLASS = 6.0 - 0.1j
CARRIER = 3.5
AHEAD = np.array([[1.0, 0.0, 0.0]])
SLANTED = np.array([[0.6, 0.8, 0.0]])
ROOM = box((0, -40, -5), (9, 40, 5))
"""Opaque, with a loss of 6 dB."""


def scene(
    *sheets: NDArray[np.float64],
    solids: tuple[NDArray[np.float64], ...] = (),
    opaque: tuple[NDArray[np.float64], ...] = (),
    thickness: float = 0.02,
) -> tuple[NDArray[np.float64], Walls]:
    """Triangles of the room with glass sheets, glass solids, and opaque solids; and their walls."""
    parts = [ROOM, *sheets, *solids, *opaque]
    triangles = np.concatenate(parts)
    part = np.repeat(np.arange(len(parts)), [len(each) for each in parts])
    sheet = (part >= 1) & (part <= len(sheets))
    solid = part > len(sheets)
    glass = sheet | (solid & (part <= len(sheets) + len(solids)))
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middles = np.array([triangles[part == n].mean(axis=(0, 1)) for n in range(len(parts))])
    inwards = np.einsum("ij,ij->i", triangles.mean(axis=1) - middles[part], normals) < 0
    normals[inwards & solid] *= -1.0
    walls = replace(
        opaque_walls(len(triangles), loss_db=6.0),
        permittivity=np.where(glass, GLASS, np.nan),
        thickness=np.where(glass, thickness, np.nan),
        reflection_loss_db=np.where(glass, np.nan, 6.0),
        transmission_loss_db=np.where(glass, np.nan, np.inf),
        solid=np.where(solid, part, -1).astype(np.int32),
        outward=normals,
        carrier_ghz=CARRIER,
    )
    return triangles, walls


def run(
    built: tuple[NDArray[np.float64], Walls],
    directions: NDArray[np.float64],
    station: ArrayLike = (1.0, 0.1, 0.2),
    *,
    max_reflections: int = 0,
    **settings: Any,
) -> Segments:
    """Launch rays among triangles."""
    triangles, walls = built
    corners = triangles.reshape(-1, 3)
    return launch(
        np.asarray(station, np.float64),
        directions,
        engine=EmbreeEngine(triangles),
        planes=merge_coplanar(triangles),
        walls=walls,
        bounds=np.stack([corners.min(axis=0), corners.max(axis=0)]),
        max_reflections=max_reflections,
        max_path_length=1000.0,
        settings=replace(RaySettings(), **settings),
    )


def sheet_at(x: float) -> NDArray[np.float64]:
    """Sheet across the room."""
    return quad((x, -30, -4), (x, 30, -4), (x, 30, 4), (x, -30, 4))


def slab(thickness: float, cosine: float = 1.0) -> tuple[float, float, float]:
    """Logarithms of the reflected and the transmitted power, and the excess length, m."""
    reflected, transmitted = slab_power(cosine, GLASS, thickness, carrier_ghz=CARRIER)
    return float(np.log10(reflected)), float(np.log10(transmitted)), float(excess_length(cosine, GLASS, thickness))


@pytest.mark.parametrize(("direction", "cosine"), [(AHEAD, 1.0), (SLANTED, 0.6)])
def test_a_sheet_mirrors_and_lets_through(direction: NDArray[np.float64], cosine: float) -> None:
    segments = run(scene(sheet_at(3.0)), direction, max_reflections=1)
    reflected, transmitted, excess = slab(0.02, cosine)
    # To the sheet, back to x = 0, on to x = 9, and back from there to the sheet, which it passes once more.
    assert segments.sequences.num_reflections[segments.sequence].tolist() == [0, 1, 0, 1, 1]
    np.testing.assert_allclose(segments.start * cosine, [0, 2, 2, 8, 14], rtol=0, atol=1e-9)
    np.testing.assert_allclose(segments.end * cosine, [2, 5, 8, 14, 17], rtol=0, atol=1e-9)
    gains = [0.0, reflected, transmitted, transmitted - 0.6, 2 * transmitted - 0.6]
    np.testing.assert_allclose(segments.log_gain, gains, rtol=1e-12)
    np.testing.assert_allclose(segments.excess, [0.0, 0.0, excess, excess, 2 * excess], rtol=1e-12)
    assert segments.num_walls.tolist() == [0, 0, 1, 1, 2]
    assert segments.lost_ray_share == segments.cut_power_share == 0.0


@pytest.mark.parametrize(("direction", "cosine"), [(AHEAD, 1.0), (SLANTED, 0.6)])
@pytest.mark.parametrize("turned", [False, True])
def test_a_solid_is_one_slab(direction: NDArray[np.float64], cosine: float, turned: bool) -> None:
    """Of the thickness that the geometry says; whichever way its triangles face."""
    wall = box((3.0, -30, -4), (3.2, 30, 4))
    segments = run(scene(solids=(wall[:, ::-1] if turned else wall,)), direction, max_reflections=1)
    reflected, transmitted, excess = slab(0.2, cosine)
    np.testing.assert_allclose(segments.start[:3] * cosine, [0, 2, 2.2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(segments.end[:3] * cosine, [2, 5, 8], rtol=0, atol=1e-9)
    np.testing.assert_allclose(segments.log_gain[:3], [0.0, reflected, transmitted], rtol=1e-9)
    np.testing.assert_allclose(segments.excess[:3], [0.0, 0.0, excess], rtol=1e-9)
    assert segments.num_walls.tolist()[:3] == [0, 0, 1]


def test_a_range_through_concrete_has_the_bias_of_its_index() -> None:
    """0.2 m of concrete at normal incidence: 0.2 (sqrt(5.24) - 1) m."""
    built = scene(sheet_at(3.0), thickness=0.2)
    built = built[0], replace(built[1], permittivity=np.where(np.isnan(built[1].permittivity), np.nan, 5.24 - 0.6j))
    assert run(built, AHEAD).excess.tolist() == pytest.approx([0.0, 0.2 * (np.sqrt(5.24) - 1.0)])
    switched_off = built[0], replace(built[1], excess_length=False)
    assert run(switched_off, AHEAD).excess.tolist() == [0.0, 0.0]


def test_overlapping_solids_are_passed_one_after_the_other() -> None:
    walls = (box((3.0, -30, -4), (3.2, 30, 4)), box((3.1, -20, -3), (3.5, 20, 3)))
    segments = run(scene(solids=walls), AHEAD)
    assert segments.num_walls.tolist() == [0, 1, 1]
    np.testing.assert_allclose(segments.start, [0, 2.2, 2.5], rtol=0, atol=1e-5)
    np.testing.assert_allclose(segments.log_gain, np.cumsum([0.0, slab(0.2)[1], slab(0.3)[1]]), rtol=1e-4)


def test_what_is_within_a_wall_matters_only_if_it_is_opaque() -> None:
    wall = box((3.0, -30, -4), (3.4, 30, 4))
    pane, plate = sheet_at(3.2), box((3.15, -20, -3), (3.25, 20, 3))
    assert run(scene(pane, solids=(wall,)), AHEAD).num_walls.tolist() == [0, 1]
    blocked = run(scene(solids=(wall,), opaque=(plate,)), AHEAD, max_reflections=1)
    assert blocked.num_walls.tolist() == [0, 0]
    # Reflected as by a half space.
    whole = np.sqrt(GLASS)
    assert blocked.log_gain[1] == pytest.approx(2 * np.log10(abs((1 - whole) / (1 + whole))))


def test_branches_end_by_gain_and_by_number_and_their_power_is_told() -> None:
    built = scene(*(sheet_at(x) for x in (2.0, 3.0, 4.0, 5.0)), thickness=0.05)
    _, lost, _ = slab(0.05)
    assert run(built, AHEAD).num_walls.tolist() == [0, 1, 2, 3, 4]
    for ended in ({"max_walls": 2}, {"straight_floor_db": -25.0 * lost}):
        segments = run(built, AHEAD, **ended)
        assert segments.num_walls.tolist() == [0, 1, 2]
        assert segments.cut_power_share == pytest.approx(10.0 ** (3 * lost))
    # The weaker branches of the reflected ray end earlier.
    free = run(built, AHEAD, max_reflections=1, mirrored_floor_db=200.0)
    cut = run(built, AHEAD, max_reflections=1, mirrored_floor_db=10.0)
    weak = free.log_gain[free.sequences.num_reflections[free.sequence] == 1]
    assert np.count_nonzero(weak >= -1.0) == np.count_nonzero(cut.sequence > 0) < len(weak)
    assert cut.cut_power_share > 0.0


def test_a_ray_that_leaves_the_building_is_not_lost() -> None:
    triangles, walls = scene()
    glass = replace(
        walls,
        permittivity=np.full(12, GLASS),
        thickness=np.full(12, 0.01),
        reflection_loss_db=np.full(12, np.nan),
        transmission_loss_db=np.full(12, np.nan),
    )
    segments = run((triangles, glass), AHEAD, max_reflections=1)
    assert segments.lost_ray_share == 0.0
    assert segments.num_walls.tolist() == [0, 0]
    np.testing.assert_allclose(segments.end, [8, 17], rtol=0, atol=1e-9)


Branch = tuple[int, int, float, float, float]


def naive(
    triangles: NDArray[np.float64], walls: Walls, origin: NDArray[np.float64], heading: NDArray[np.float64], depth: int
) -> list[Branch]:
    """Follow all branches of a ray, one by one: reflections, walls, start, end and log gain of each segment."""
    a = triangles[:, 0]
    ab, ac = triangles[:, 1] - a, triangles[:, 2] - a
    normals = np.cross(ab, ac)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def follow(
        origin: NDArray[np.float64], heading: NDArray[np.float64], state: tuple[int, int, float, float]
    ) -> Iterator[Branch]:
        reflections, passed, length, gain = state
        across = np.cross(heading, ac)
        det = np.einsum("ij,ij->i", ab, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("ij,ij->i", origin - a, across) / det
            q = np.cross(origin - a, ab)
            v, reach = q @ heading / det, np.einsum("ij,ij->i", ac, q) / det
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (reach > 1e-9)
        face = int(np.argmin(np.where(hit, reach, np.inf)))
        there = length + reach[face]
        yield (reflections, passed, length, there, gain)
        place, normal = origin + reach[face] * heading, normals[face]
        cosine = abs(float(heading @ normal))
        lost = -0.6
        if walls.passable[face]:
            back, through = slab_power(cosine, GLASS, walls.thickness[face], carrier_ghz=CARRIER)
            lost = float(np.log10(back))
            yield from follow(place, heading, (reflections, passed + 1, there, gain + float(np.log10(through))))
        if reflections < depth:
            mirrored = heading - 2.0 * (heading @ normal) * normal
            yield from follow(place, mirrored, (reflections + 1, passed, there, gain + lost))

    return list(follow(origin, heading, (0, 0, 0.0, 0.0)))


def test_all_branches_of_a_naive_trace(unit_vectors: Callable[[int, int], NDArray[np.float64]]) -> None:
    """Among three sheets, one askew, with up to two reflections and eight walls."""
    askew = quad((4.0, -9, -4), (6.0, 9, -4), (6.0, 9, 4), (4.0, -9, 4))
    built = scene(sheet_at(2.0), askew, quad((0.5, -8, 1), (8.5, -8, 1), (8.5, 8, 1), (0.5, 8, 1)))
    directions = unit_vectors(40, 5)
    station = np.array([1.3, 0.2, -0.4])
    open_ended = {"max_walls": 99, "straight_floor_db": 1e9, "mirrored_floor_db": 1e9}
    segments = run(built, directions, station, max_reflections=2, **open_ended)
    assert segments.num_walls.max() >= 4
    assert segments.cut_power_share == 0.0
    for ray, heading in enumerate(directions):
        mine = slice(segments.offsets[ray], segments.offsets[ray + 1])
        found = zip(
            segments.sequences.num_reflections[segments.sequence[mine]].tolist(),
            segments.num_walls[mine].tolist(),
            segments.start[mine].tolist(),
            segments.end[mine].tolist(),
            segments.log_gain[mine].tolist(),
            strict=True,
        )
        expected = naive(*built, station, heading, 2)
        np.testing.assert_allclose(sorted(found), sorted(expected), rtol=0, atol=1e-7)


def test_the_path_map_behind_a_sheet() -> None:
    """One direct path, which passes one wall; its excess length is that of the angle of incidence at the middle."""
    rays = sample_rays(0.01, np.random.default_rng(4))
    segments = run(scene(sheet_at(3.0), thickness=0.1), rays.directions)
    space = FreeSpace(origin=np.array([0.0, -2.0, -1.0]), voxel_size=0.1, free=np.ones((90, 40, 20), bool))
    prior = fill_path_prior(rays, segments, space, exponent=2.0, refinement=2)
    paths = fill_path_map(rays, segments, prior, exponent=2.0, kind="power", least_share=1e-3)
    compared = 0
    for voxel in np.ndindex(paths.shape):
        own = slice(*paths.offsets[(n := int(np.ravel_multi_index(voxel, paths.shape))) : n + 2])
        apart = paths.origin + paths.voxel_size * (np.array(voxel) + 0.5) - (1.0, 0.1, 0.2)
        if abs(apart[0] - 2.0) < 0.2 or np.linalg.norm(apart) < 0.3:  # the sheet is in the voxel, or the station
            continue
        behind = apart[0] > 2.0
        assert paths.sequence[own].tolist() == [0]
        assert paths.weight[own] == pytest.approx([1.0])
        assert paths.num_walls[own].tolist() == [int(behind)]
        expected = slab(0.1, float(apart[0] / np.linalg.norm(apart)))[2] if behind else 0.0
        assert paths.excess[own] == pytest.approx([expected], abs=2e-3)
        compared += 1
    assert compared > 3000
