"""Parts of a mesh, insides, and the free space, against analytic boxes and spheres."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rayfix_offline.scene.scene import Scene
from rayfix_offline.twin.enclosures import find_enclosures
from rayfix_offline.twin.mesh import Mesh
from rayfix_offline.twin.settings import TwinSettings
from rayfix_offline.twin.solids import Part, is_inside, map_free_space, split_parts, touched
from rayfix_tables.freespace import FreeSpace
from tests.support.scenes.rooms import scene_of
from tests.support.scenes.shapes import box, random_rotation

seeds = st.integers(0, 2**32 - 1)


def parts_of(scene: Scene) -> tuple[Part, ...]:
    """Split a scene."""
    return split_parts(Mesh(scene=scene))


def moved(triangles: NDArray[np.float64], rotation: Rotation, shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn triangles about the origin, then shift them."""
    return np.asarray(rotation.apply(triangles.reshape(-1, 3)).reshape(-1, 3, 3) + shift)


# Parts


def test_parts_of_a_room(clutter: NDArray[np.float64]) -> None:
    scene = scene_of(room=clutter[:12, ::-1], cabinet=clutter[12:24], table=clutter[24:])
    room, cabinet, table = parts_of(scene)
    assert [part.name for part in (room, cabinet, table)] == ["room", "cabinet", "table"]
    np.testing.assert_array_equal(cabinet.faces, np.arange(12, 24))
    assert all(part.closed and part.consistent for part in (room, cabinet, table))
    np.testing.assert_allclose(
        [room.volume, cabinet.volume, table.volume], [-60.0, 0.8 * 1.2 * 1.8, 1.0 * 1.3 * 0.2], rtol=1e-12
    )


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_volume_does_not_depend_on_the_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.1, 3.0, 3)
    triangles = moved(box(-size / 2, size / 2), random_rotation(rng), rng.uniform(-1e3, 1e3, 3))
    (part,) = parts_of(scene_of(thing=triangles))
    assert part.closed
    assert part.volume == pytest.approx(np.prod(size), rel=1e-9)


def test_a_missing_triangle_opens_a_part() -> None:
    (part,) = parts_of(scene_of(crate=box((0, 0, 0), (1, 1, 1))[1:]))
    assert not part.closed
    assert not part.consistent


def test_one_turned_triangle() -> None:
    triangles = box((0, 0, 0), (1, 1, 1))
    triangles[4] = triangles[4, ::-1]
    (part,) = parts_of(scene_of(crate=triangles))
    assert (part.closed, part.consistent) == (True, False)


def test_boxes_that_touch_along_an_edge_are_one_closed_part() -> None:
    """Four triangles meet at the common edge."""
    one, other = box((0, 0, 0), (1, 1, 1)), box((1, 1, 0), (3, 2, 1))
    assert [part.closed for part in parts_of(scene_of(a=one, b=other))] == [True, True]
    (part,) = parts_of(scene_of(ab=np.concatenate([one, other])))
    assert (part.closed, part.consistent, part.manifold) == (True, True, False)
    assert part.volume == pytest.approx(3.0, rel=1e-12)


def test_a_partition_of_one_sheet_opens_a_part() -> None:
    """Three triangles meet at its rim: what lies behind it is neither inside nor outside."""
    walls = np.concatenate([box((0, 0, 0), (1, 1, 1)), box((0, 0, 1), (1, 1, 2))])
    sheet = np.all(walls[:, :, 2] == 1.0, axis=1)
    twice, once = walls, np.delete(walls, np.flatnonzero(sheet)[:2], axis=0)
    assert np.count_nonzero(sheet) == 4
    assert parts_of(scene_of(crate=twice))[0].closed
    assert not parts_of(scene_of(crate=once))[0].closed


def test_a_seam_below_a_micrometre_is_none() -> None:
    triangles = box((0, 0, 0), (1, 1, 1))
    (part,) = parts_of(scene_of(crate=triangles + np.random.default_rng(0).uniform(-1e-9, 1e-9, triangles.shape)))
    assert part.closed


def test_a_sheet_is_open() -> None:
    (part,) = parts_of(scene_of(sheet=np.array([[(0, 0, 0), (1, 0, 0), (0, 1, 0)]], dtype=float)))
    assert (part.closed, part.consistent, part.name) == (False, False, "sheet")


# Inside


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_inside_a_box(seed: int) -> None:
    """Whatever its place, its turn and the way its triangles face."""
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.2, 4.0, 3)
    rotation, shift = random_rotation(rng), rng.uniform(-50, 50, 3)
    triangles = moved(box(-size / 2, size / 2), rotation, shift)
    for i in np.flatnonzero(rng.random(12) < 0.5):
        triangles[i] = triangles[i, ::-1]
    local = rng.uniform(-0.75, 0.75, (20, 3)) * size
    expected = np.all(np.abs(local) < size / 2, axis=1)
    found = [is_inside(triangles, point) for point in rotation.apply(local) + shift]
    assert found == expected.tolist()


def test_inside_an_axis_aligned_box_on_round_coordinates(room: NDArray[np.float64]) -> None:
    """Points on a grid that meets edges and diagonals of the walls in every direction."""
    grid = np.stack(np.meshgrid(*(np.arange(-1.0, 6.25, 0.5) + 0.25 * k for k in (0, 1, 0)), indexing="ij"), axis=-1)
    points = grid.reshape(-1, 3)
    on_wall = np.any((points == 0) | (points == (4, 5, 3)), axis=1)
    points = points[~on_wall]
    expected = np.all((points > 0) & (points < (4, 5, 3)), axis=1)
    assert [is_inside(room, point) for point in points] == expected.tolist()


def test_a_ray_through_an_edge_is_outvoted(room: NDArray[np.float64]) -> None:
    """Points from which one of the three rays passes through an edge or a diagonal, where two triangles are hit."""
    headings = np.array([(0.5257, 0.3113, 0.7917), (-0.6121, 0.7034, 0.3613), (0.2731, -0.8467, -0.4566)])
    edges = np.concatenate([room[:, [0, 1]], room[:, [1, 2]], room[:, [2, 0]]])
    on_edges = np.concatenate([edges[:, 0] * (1 - t) + edges[:, 1] * t for t in (0.25, 0.5, 0.625)])
    points = (on_edges[:, None] - 0.5 * headings).reshape(-1, 3)
    expected = np.all((points > 0) & (points < (4, 5, 3)), axis=1)
    assert 50 < np.count_nonzero(expected) < len(points) - 50
    assert [is_inside(room, point) for point in points] == expected.tolist()


def test_inside_a_sphere() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    triangles = np.array(sphere.triangles)
    inner = np.abs(np.einsum("ij,ij->i", triangles[:, 0], sphere.face_normals)).min()
    points = np.random.default_rng(1).uniform(-2.5, 2.5, (400, 3))
    radius = np.linalg.norm(points, axis=1)
    clear = (radius < inner) | (radius > 2.0)
    assert np.count_nonzero(clear) > 380
    found = np.array([is_inside(triangles, point) for point in points])
    np.testing.assert_array_equal(found[clear], radius[clear] < inner)


def test_inside_a_hollow_shell() -> None:
    shell = np.concatenate([box((0, 0, 0), (4, 4, 4)), box((1, 1, 1), (3, 3, 3))])
    assert is_inside(shell, np.array([0.5, 2.1, 2.2]))
    assert not is_inside(shell, np.array([2.1, 2.2, 2.3]))
    assert not is_inside(shell, np.array([4.5, 2.1, 2.2]))


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_touching_a_box(seed: int) -> None:
    """Points on the surface, moved along the outward normal by up to 3 mm; 1 mm counts as on it."""
    rng = np.random.default_rng(seed)
    size, rotation, shift = rng.uniform(0.2, 4.0, 3), random_rotation(rng), rng.uniform(-50, 50, 3)
    triangles = moved(box(-size / 2, size / 2), rotation, shift)
    local = rng.uniform(-0.5, 0.5, (20, 3)) * size
    axis, sign = rng.integers(0, 3, 20), rng.choice([-1.0, 1.0], 20)
    off = rng.choice([-0.003, -0.0011, -0.0009, 0.0, 0.0009, 0.0011, 0.003], 20)
    local[np.arange(20), axis] = sign * (size[axis] / 2 + off)
    expected = np.abs(off) < TwinSettings.touch
    expected[off < 0] |= (size / 2 - np.abs(local)).min(axis=1)[off < 0] < TwinSettings.touch
    found = [touched(triangles, point) >= 0 for point in rotation.apply(local) + shift]
    assert found == expected.tolist()


# Enclosures


def enclosures(scene: Scene, *stations: tuple[float, float, float]) -> tuple[dict[str, bool], dict[str, list[bool]]]:
    """Give which named parts enclose, and which stations are in which parts."""
    parts = parts_of(scene)
    found = find_enclosures(scene, parts, np.array(stations))
    names = [part.name for part in parts]
    return dict(zip(names, found.enclosing.tolist(), strict=True)), dict(zip(names, found.inside.tolist(), strict=True))


STATIONS = ((3.6, 0.4, 2.6), (0.2, 4.8, 2.6), (2.0, 2.5, 2.6))


def test_the_room_encloses_and_the_solids_do_not(clutter: NDArray[np.float64]) -> None:
    scene = scene_of(room=clutter[:12], cabinet=clutter[12:24], table=clutter[24:])
    found, inside = enclosures(scene, *STATIONS)
    assert found == {"room": True, "cabinet": False, "table": False}
    assert inside == {"room": [True] * 3, "cabinet": [False] * 3, "table": [False] * 3}


def test_walls_with_two_faces(room: NDArray[np.float64]) -> None:
    """The inner and the outer face of the walls both enclose; a station between them is in the outer one only."""
    scene = scene_of(inner=room, outer=box((-0.3, -0.3, -0.3), (4.3, 5.3, 3.3)))
    found, inside = enclosures(scene, *STATIONS, (4.1, 2.0, 1.0))
    assert found == {"inner": True, "outer": True}
    assert inside == {"inner": [True, True, True, False], "outer": [True] * 4}


def test_a_station_in_a_small_solid_does_not_make_it_a_building(clutter: NDArray[np.float64]) -> None:
    scene = scene_of(room=clutter[:12], cabinet=clutter[12:24], table=clutter[24:])
    found, inside = enclosures(scene, (0.9, 1.5, 0.7))
    assert found == {"room": True, "cabinet": False, "table": False}
    assert inside == {"room": [True], "cabinet": [True], "table": [False]}


def test_one_station_in_a_large_machine_does_not_make_it_a_building(room: NDArray[np.float64]) -> None:
    """The machine takes up 8 of 60 m3; most stations are outside of it."""
    scene = scene_of(room=room, machine=box((1, 1, 0.5), (3, 3, 2.5)))
    found, inside = enclosures(scene, (2.0, 2.1, 1.0), *STATIONS)
    assert found == {"room": True, "machine": False}
    assert inside == {"room": [True] * 4, "machine": [True, False, False, False]}


def test_an_open_room_encloses_nothing(clutter: NDArray[np.float64]) -> None:
    found, inside = enclosures(scene_of(room=clutter[1:12], cabinet=clutter[12:24]), *STATIONS)
    assert found == {"room": False, "cabinet": False}
    assert not any(inside["room"] + inside["cabinet"])


# Free space


def mapped(
    scene: Scene, enclosing: list[bool], voxel_size: float, max_voxels: int = TwinSettings.max_voxels
) -> FreeSpace:
    """Map the free space of a scene, its parts as rooms or solids."""
    parts = [(part, encloses) for part, encloses in zip(parts_of(scene), enclosing, strict=True) if part.closed]
    return map_free_space(
        scene,
        solids=[part for part, encloses in parts if not encloses],
        rooms=[part for part, encloses in parts if encloses],
        voxel_size=voxel_size,
        max_voxels=max_voxels,
    )


def free_space(
    scene: Scene, *, enclosing: list[bool], voxel_size: float
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Give the map and its voxels' centres."""
    space = mapped(scene, enclosing, voxel_size)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in space.free.shape), indexing="ij"), axis=-1)
    return space.free, space.origin + (index + 0.5) * space.voxel_size


def test_free_space_of_a_room(clutter: NDArray[np.float64]) -> None:
    scene = scene_of(room=clutter[:12], cabinet=clutter[12:24], table=clutter[24:])
    free, centres = free_space(scene, enclosing=[True, False, False], voxel_size=0.1)
    assert free.shape == (40, 50, 30)
    cabinet = np.all((centres > (0.5, 1.0, 0.0)) & (centres < (1.3, 2.2, 1.8)), axis=-1)
    table = np.all((centres > (2.4, 2.8, 0.9)) & (centres < (3.4, 4.1, 1.1)), axis=-1)
    np.testing.assert_array_equal(free, ~(cabinet | table))
    assert np.count_nonzero(~free) == 8 * 12 * 18 + 10 * 13 * 2


def test_a_room_that_does_not_enclose_is_solid(room: NDArray[np.float64]) -> None:
    assert not free_space(scene_of(room=room), enclosing=[False], voxel_size=0.5)[0].any()


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_free_space_around_turned_boxes(seed: int) -> None:
    """Two boxes, turned any way, which may overlap, in an axis-aligned room."""
    rng = np.random.default_rng(seed)
    objects, solid = {"room": box((-3, -3, -3), (3, 3, 3))}, []
    for name in ("a", "b"):
        size, rotation, shift = rng.uniform(0.5, 2.0, 3), random_rotation(rng), rng.uniform(-1.0, 1.0, 3)
        objects[name] = moved(box(-size / 2, size / 2), rotation, shift)
        solid.append((size, rotation, shift))
    free, centres = free_space(scene_of(**objects), enclosing=[True, False, False], voxel_size=0.25)
    expected, clear = np.ones(free.shape, bool), np.ones(free.shape, bool)
    for size, rotation, shift in solid:
        local = rotation.inv().apply(centres.reshape(-1, 3) - shift).reshape(centres.shape)
        depth = (size / 2 - np.abs(local)).min(axis=-1)
        expected &= depth < 0.0
        clear &= np.abs(depth) > 1e-4  # the columns are off the centres by up to 3e-5 of a voxel
    np.testing.assert_array_equal(free[clear], expected[clear])
    assert np.mean(clear) > 0.99


def test_free_space_inside_a_sphere() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    free, centres = free_space(scene_of(dome=np.array(sphere.triangles)), enclosing=[True], voxel_size=0.05)
    radius = np.linalg.norm(centres, axis=-1)
    assert free[radius < 0.995].all()
    assert not free[radius > 1.0].any()
    assert np.count_nonzero(free) * 0.05**3 == pytest.approx(sphere.volume, rel=0.01)


def test_facing_does_not_matter(clutter: NDArray[np.float64]) -> None:
    rng = np.random.default_rng(2)
    turned = clutter.copy()
    for i in np.flatnonzero(rng.random(len(turned)) < 0.5):
        turned[i] = turned[i, ::-1]
    maps = [
        free_space(
            scene_of(room=t[:12], cabinet=t[12:24], table=t[24:]), enclosing=[True, False, False], voxel_size=0.1
        )[0]
        for t in (clutter, turned)
    ]
    np.testing.assert_array_equal(*maps)


def test_an_open_part_is_not_solid(clutter: NDArray[np.float64]) -> None:
    scene = scene_of(room=clutter[:12], cabinet=clutter[13:24])
    free, _ = free_space(scene, enclosing=[True, False], voxel_size=0.1)
    assert free.all()


def test_a_large_scene_gets_larger_voxels() -> None:
    scene = scene_of(hall=box((0, 0, 0), (80, 180, 25)))
    space = mapped(scene, [True], 0.1, max_voxels=10_000)
    assert space.free.size <= 10_000 * 1.5  # every axis is rounded up
    assert space.voxel_size == pytest.approx((80 * 180 * 25 / 10_000) ** (1 / 3), rel=1e-12)
    # Voxels that reach beyond the hall count where their centre lies within.
    assert space.volume == pytest.approx(80 * 180 * 25, rel=0.2)


def test_a_flat_scene_has_a_layer_of_voxels() -> None:
    scene = scene_of(floor=np.array([[(0, 0, 0), (1, 0, 0), (1, 1, 0)]], dtype=float))
    assert mapped(scene, [False], 0.1).free.shape == (10, 10, 1)


def test_vertices_that_are_shared_or_not_make_no_difference(room: NDArray[np.float64]) -> None:
    soup = scene_of(room=room)
    vertices, index = np.unique(soup.vertices, axis=0, return_inverse=True)
    shared = replace(soup, vertices=vertices, faces=index.reshape(-1, 3).astype(np.int32))
    (one,), (other,) = parts_of(soup), parts_of(shared)
    assert (one.closed, one.consistent) == (other.closed, other.consistent) == (True, True)
    assert one.volume == pytest.approx(other.volume, rel=1e-14)


@pytest.mark.parametrize("seed", range(6))
def test_half_of_the_triangles_turned_is_no_loss_of_volume(seed: int, room: NDArray[np.float64]) -> None:
    """A room and a sphere, in which any triangles face either way: volumes as large as when none is turned."""
    rng = np.random.default_rng(seed)
    ball = np.asarray(trimesh.creation.icosphere(subdivisions=2, radius=0.4).triangles) + np.array([2.0, 2.5, 1.0])
    for name, triangles in (("room", room), ("ball", ball)):
        (plain,) = parts_of(scene_of(**{name: triangles}))
        mixed = triangles.copy()
        which = rng.permutation(len(mixed))[: len(mixed) // 2]
        mixed[which] = mixed[which, ::-1]
        (part,) = parts_of(scene_of(**{name: mixed}))
        assert (part.closed, part.consistent) == (True, False)
        assert abs(part.volume) == pytest.approx(abs(plain.volume), rel=1e-12)


def test_most_triangles_tell_how_a_part_faces(room: NDArray[np.float64]) -> None:
    for turned, sign in (([0, 1, 2], 1.0), (list(range(9)), -1.0)):
        mixed = room.copy()
        mixed[turned] = mixed[turned, ::-1]
        (part,) = parts_of(scene_of(room=mixed))
        (plain,) = parts_of(scene_of(room=room))
        assert part.volume == pytest.approx(sign * plain.volume, rel=1e-12)


def test_a_room_of_mixed_triangles_still_encloses(clutter: NDArray[np.float64]) -> None:
    mixed = clutter[:12].copy()
    mixed[::2] = mixed[::2, ::-1]
    found, _ = enclosures(scene_of(room=mixed, cabinet=clutter[12:24], table=clutter[24:]), *STATIONS)
    assert found == {"room": True, "cabinet": False, "table": False}


def test_a_strip_that_cannot_be_turned_to_agree_stays() -> None:
    """A Moebius strip of 8 quadrilaterals: it is open, and nothing is said of its volume."""
    angle = np.arange(9) * 2.0 * np.pi / 8.0
    half = 0.4 * np.stack(
        [np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1
    )
    middle = np.stack([np.cos(angle), np.sin(angle), np.zeros(9)], axis=1)
    one, other = middle + half, middle - half
    strip = np.array(
        [t for k in range(8) for t in ((one[k], other[k], one[k + 1]), (other[k], other[k + 1], one[k + 1]))]
    )
    (part,) = parts_of(scene_of(strip=strip))
    assert (part.closed, part.consistent) == (False, False)
