"""Facets of curved surfaces: which make up one surface, and that flat mirrors stay as they are."""

import itertools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from rayfix_offline.twin.mesh import Mesh
from rayfix_offline.twin.planes import Planes, merge_coplanar
from rayfix_offline.twin.settings import TwinSettings
from rayfix_offline.twin.surfaces import join_facets
from rayfix_offline.twin.topology import number_rows
from tests.support.scenes.rooms import scene_of
from tests.support.scenes.shapes import box, random_rotation

Triangles = NDArray[np.float64]


def joined(triangles: Triangles) -> tuple[Planes, Planes]:
    """Planes before and after facets are joined."""
    planes = merge_coplanar(triangles)
    return planes, join_facets(Mesh(scene=scene_of(mesh=triangles)), planes)


def surfaces_of(triangles: Triangles) -> NDArray[np.int32]:
    """Surface of each triangle."""
    planes = joined(triangles)[1]
    return planes.surfaces[planes.face_planes]


def pillar(sections: int, *, radius: float = 0.4, at: ArrayLike = (0, 0, 1.5)) -> Triangles:
    """Triangles of a round pillar of 3 m."""
    mesh = trimesh.creation.cylinder(radius=radius, height=3.0, sections=sections)
    return np.array(mesh.triangles) + np.asarray(at, np.float64)


def side_of(triangles: Triangles) -> NDArray[np.bool_]:
    """Triangles that are not horizontal."""
    return np.asarray(np.ptp(triangles[:, :, 2], axis=1) > 1.0)


def strip(turns_deg: list[float], widths: list[float]) -> Triangles:
    """Upright strips of 3 m, one beside the other, each turned against the one before."""
    heading = np.deg2rad(np.cumsum(turns_deg))
    steps = np.array(widths)[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    ends = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    triangles = []
    for (ax, ay), (bx, by) in itertools.pairwise(ends):
        a, b, c, d = (ax, ay, 0.0), (bx, by, 0.0), (bx, by, 3.0), (ax, ay, 3.0)
        triangles += [(a, b, c), (a, c, d)]
    return np.array(triangles)


@pytest.mark.parametrize("sections", [64, 256, 1024])
def test_a_pillar_has_few_surfaces_however_many_facets(sections: int) -> None:
    triangles = pillar(sections)
    before, planes = joined(triangles)
    assert len(before) == sections + 2
    side = planes.surfaces[planes.face_planes[side_of(triangles)]]
    full_turn = 360.0 / np.rad2deg(TwinSettings.surface_angle)
    assert full_turn / 2 <= len(np.unique(side)) <= full_turn
    # The mirrors are those of the facets: nothing is rounded.
    np.testing.assert_array_equal(planes.normals[planes.face_planes], before.normals[before.face_planes])
    np.testing.assert_array_equal(planes.offsets[planes.face_planes], before.offsets[before.face_planes])


@pytest.mark.parametrize("sections", [256, 1024])
def test_a_surface_turns_by_twice_its_angle_at_most(sections: int) -> None:
    triangles = pillar(sections)
    surface = surfaces_of(triangles)
    middle = triangles.mean(axis=1)
    for n in np.unique(surface[side_of(triangles)]):
        azimuth = np.arctan2(middle[surface == n, 1], middle[surface == n, 0])
        turn = np.angle(np.exp(1j * (azimuth[:, None] - azimuth))).max()
        assert turn <= 2.0 * TwinSettings.surface_angle + 2.0 * np.pi / sections


def test_the_ends_of_a_pillar_are_surfaces_by_themselves() -> None:
    triangles = pillar(256)
    surface = surfaces_of(triangles)
    side = side_of(triangles)
    assert len(np.unique(surface[~side])) == 2
    assert not set(surface[~side]) & set(surface[side])


def test_a_coarse_pillar_stays_as_it_is() -> None:
    """Its 16 facets are 22.5 deg apart."""
    before, after = joined(pillar(16))
    assert after is before


def test_flat_parts_stay_as_they_are(clutter: Triangles) -> None:
    before, after = joined(clutter)
    assert after is before
    np.testing.assert_array_equal(after.surfaces, np.arange(len(after)))


def test_a_ball() -> None:
    """1,280 facets; caps of 20 deg across at most, no fewer than caps of that size could cover."""
    triangles = np.array(trimesh.creation.icosphere(subdivisions=3, radius=1.0).triangles)
    surface = surfaces_of(triangles)
    caps = 2.0 / (1.0 - np.cos(TwinSettings.surface_angle))
    assert caps <= len(np.unique(surface)) <= 4.0 * caps
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    for n in np.unique(surface):
        mine = normals[surface == n]
        assert (mine @ mine.T).min() >= np.cos(2.0 * TwinSettings.surface_angle) - 1e-12


def test_a_wall_beside_a_rounded_corner_stays_sharp() -> None:
    """Two walls of 4 m and between them twelve strips of 50 mm, 7.5 deg apart."""
    triangles = strip([0.0] + [90.0 / 13.0] * 13, [4.0] + [0.05] * 12 + [4.0])
    surface = surfaces_of(triangles)
    walls, corner = surface[[0, 1, -2, -1]], surface[2:-2]
    assert walls[0] == walls[1] != walls[2] == walls[3]
    assert not set(walls) & set(corner)
    assert 3 <= len(set(corner)) < 12


@pytest.mark.parametrize(("share", "together"), [(0.45, True), (0.55, False)])
def test_the_size_of_a_facet(share: float, together: bool) -> None:
    """A long strip counts by twice its width, here of nearly 3 m by share x facet_size."""
    width = share * TwinSettings.facet_size
    surface = surfaces_of(strip([0.0, 5.0], [width, width]))
    assert (len(np.unique(surface)) == 1) is together


@pytest.mark.parametrize(("fold_deg", "together"), [(9.9, True), (10.1, False), (90.0, False), (179.0, False)])
def test_the_fold_between_facets(fold_deg: float, together: bool) -> None:
    """The last one is the edge of a blade: its sides are parallel, but they look away from each other."""
    surface = surfaces_of(strip([0.0, fold_deg], [0.1, 0.1]))
    assert (len(np.unique(surface)) == 1) is together


def test_coplanar_facets_of_two_pillars_are_two_mirrors() -> None:
    """Two equal pillars side by side: the first facets of both are coplanar, and those opposite."""
    normal = np.pi / 64
    one, other = pillar(64), pillar(64, at=(-5.0 * np.sin(normal), 5.0 * np.cos(normal), 1.5))
    before, planes = joined(np.concatenate([one, other]))
    surface = planes.surfaces[planes.face_planes]
    first, second = surface[: len(one)], surface[len(one) :]
    side = side_of(one)
    assert len(planes) == len(before) + 2
    assert not set(first[side]) & set(second[side])
    # Floor and ceiling are flat and stay one mirror each.
    assert set(first[~side]) == set(second[~side])


def test_a_subdivided_wall_is_flat() -> None:
    mesh = trimesh.Trimesh(*trimesh.triangles.to_kwargs(box((0, 0, 0), (4, 5, 3))).values())
    for _ in range(4):
        mesh = mesh.subdivide()
    before, after = joined(np.array(mesh.triangles))
    assert after is before
    assert len(after) == 6


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_motion_and_facing_change_nothing(seed: int) -> None:
    """Of the grouping, for the same order of triangles."""
    rng = np.random.default_rng(seed)
    triangles = pillar(128)
    rotation, shift = random_rotation(rng), rng.uniform(-10, 10, 3)
    moved = rotation.apply(triangles.reshape(-1, 3)).reshape(-1, 3, 3) + shift
    turned = rng.random(len(moved)) < 0.5
    moved[turned] = moved[turned, ::-1]
    before, after = surfaces_of(triangles), surfaces_of(moved)
    pairs = set(zip(before.tolist(), after.tolist(), strict=True))
    assert len(pairs) == len(set(before.tolist())) == len(set(after.tolist()))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rows_are_numbered_as_numpy_does(seed: int) -> None:
    """Few values, so that rows repeat; zeros of both signs are one."""
    rows = np.random.default_rng(seed).integers(-2, 3, (300, 4)) * -0.5
    np.testing.assert_array_equal(number_rows(rows), np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1))
