"""Coplanar triangles are one mirror; nothing else is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rayfix_offline.twin.planes import Planes, merge_coplanar
from rayfix_offline.twin.settings import TwinSettings
from tests.support.scenes.shapes import box, cut_in_three, quad, random_rotation

EXACT = 1e-12  # m, of coordinates of a few metres


def square(x: float, y: float, z: float = 0.0, *, size: float = 1.0) -> NDArray[np.float64]:
    """Horizontal square with its low corner at a point."""
    return quad((x, y, z), (x + size, y, z), (x + size, y + size, z), (x, y + size, z))


def assert_on_planes(triangles: NDArray[np.float64], planes: Planes, *, atol: float = EXACT) -> None:
    """Check that every corner lies on its triangle's plane and that normals are unit vectors."""
    normals = planes.normals[planes.face_planes]
    off = np.einsum("fci,fi->fc", triangles, normals) - planes.offsets[planes.face_planes][:, None]
    assert np.abs(off).max() < atol
    np.testing.assert_allclose(np.linalg.norm(planes.normals, axis=1), 1.0, rtol=0, atol=1e-15 * 4)


def same_grouping(first: NDArray[np.int32], second: NDArray[np.int32]) -> bool:
    """Whether two labellings put the same triangles together."""
    pairs = {*zip(first.tolist(), second.tolist(), strict=True)}
    return len(pairs) == len(set(first.tolist())) == len(set(second.tolist()))


def test_a_box_has_six_planes(room: NDArray[np.float64]) -> None:
    planes = merge_coplanar(room)
    assert len(planes) == 6
    np.testing.assert_array_equal(np.bincount(planes.face_planes), 2)
    assert_on_planes(room, planes)
    expected = {(1, 0, 0): (0, 4), (0, 1, 0): (0, 5), (0, 0, 1): (0, 3)}
    for axis, offsets in expected.items():
        along = np.abs(np.abs(planes.normals @ np.array(axis)) - 1.0) < EXACT
        np.testing.assert_allclose(np.sort(np.abs(planes.offsets[along])), offsets, rtol=0, atol=EXACT)


def test_separate_pieces_of_one_plane_are_one_mirror() -> None:
    triangles = np.concatenate([square(0, 0), square(5, 7), square(-20, 3, size=0.1)])
    assert len(merge_coplanar(triangles)) == 1


def test_opposite_normals_are_one_mirror() -> None:
    triangles = np.concatenate([square(0, 0), square(2, 0)[:, ::-1]])
    planes = merge_coplanar(triangles)
    assert len(planes) == 1
    assert_on_planes(triangles, planes)


@pytest.mark.parametrize("offset", [-1e-15, 0.0, 1e-15])
def test_planes_through_the_middle_of_the_scene(offset: float) -> None:
    """Where the offset is nothing but rounding, its sign says nothing."""
    up, down = square(-0.5, -0.5, offset), square(3, 3, -offset)[:, ::-1]
    frame = np.concatenate([square(-9, -9, -9), square(8, 8, 9)])
    planes = merge_coplanar(np.concatenate([up, down, frame]))
    assert len(planes) == 3
    assert planes.face_planes[0] == planes.face_planes[2]


@pytest.mark.parametrize(("gap", "count"), [(0.0005, 1), (0.005, 2)])
def test_parallel_planes(gap: float, count: int) -> None:
    """Half a millimetre is a drawing's inaccuracy, five are a sheet of wood."""
    planes = merge_coplanar(np.concatenate([square(0, 0, size=20.0), square(0, 0, gap, size=20.0)]))
    assert len(planes) == count


@pytest.mark.parametrize(("tilt_deg", "count"), [(0.001, 1), (0.1, 2)])
def test_tilted_planes(tilt_deg: float, count: int) -> None:
    """Over 20 m a tenth of a degree is 35 mm, a thousandth 0.35 mm."""
    rotation = Rotation.from_euler("x", tilt_deg, degrees=True)
    floor = square(-10, -10, size=20.0)
    tilted = rotation.apply(square(-1, -1).reshape(-1, 3)).reshape(-1, 3, 3)
    assert len(merge_coplanar(np.concatenate([floor, tilted]))) == count


@pytest.mark.parametrize("turned", [False, True])
def test_a_stack_of_sheets_is_no_mirror(turned: bool) -> None:
    """Two hundred sheets half a millimetre apart: each is coplanar with the next, the first is not with the last."""
    sheets = [square(0, 0, 0.0005 * n, size=20.0) for n in range(200)]
    if turned:
        sheets = [sheet[:, ::-1] if n % 3 else sheet for n, sheet in enumerate(sheets)]
    triangles = np.concatenate([*sheets, square(0, 0, 5.0, size=20.0)])
    planes = merge_coplanar(triangles)
    assert_on_planes(triangles, planes, atol=TwinSettings.plane_tolerance)
    assert 100 <= len(planes) <= 201


def test_merged_planes_are_their_mean_by_area() -> None:
    """Three quarters of the area lie at 0 mm, one quarter at 0.8 mm."""
    triangles = np.concatenate([square(0, 0), square(1, 0), square(2, 0), square(3, 0, 0.0008)])
    planes = merge_coplanar(triangles)
    assert len(planes) == 1
    assert abs(planes.offsets[0]) == pytest.approx(0.0002, abs=1e-12)
    assert_on_planes(triangles, planes, atol=TwinSettings.plane_tolerance)


def test_two_boxes_share_only_what_is_coplanar() -> None:
    """Boxes beside each other on one floor, of equal depth: floor, and two walls along x, are common."""
    triangles = np.concatenate([box((0, 0, 0), (1, 2, 1)), box((3, 0, 0), (4, 2, 2))])
    planes = merge_coplanar(triangles)
    assert len(planes) == 12 - 3
    assert_on_planes(triangles, planes)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_splitting_and_reordering_change_nothing(clutter: NDArray[np.float64], seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = merge_coplanar(clutter)
    pieces = merge_coplanar(cut_in_three(clutter))
    assert same_grouping(pieces.face_planes, np.tile(whole.face_planes, 3))
    order = rng.permutation(len(clutter))
    corners = np.array([rng.permutation(3) for _ in order])
    shuffled = clutter[order][np.arange(len(order))[:, None], corners]
    planes = merge_coplanar(shuffled)
    assert same_grouping(planes.face_planes, whole.face_planes[order])
    assert_on_planes(shuffled, planes)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rigid_motion_moves_the_planes(clutter: NDArray[np.float64], seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation, shift = random_rotation(rng), rng.uniform(-100, 100, 3)
    moved = rotation.apply(clutter.reshape(-1, 3)).reshape(-1, 3, 3) + shift
    before, after = merge_coplanar(clutter), merge_coplanar(moved)
    assert same_grouping(after.face_planes, before.face_planes)
    assert_on_planes(moved, after, atol=1e-10)


def test_a_round_column_keeps_its_facets() -> None:
    """Sixty-four facets of 98 mm, 5.6 deg apart."""
    turn = np.linspace(0, 2 * np.pi, 65)
    x, y = np.cos(turn), np.sin(turn)
    triangles = np.concatenate(
        [quad((x[i], y[i], 0), (x[i + 1], y[i + 1], 0), (x[i + 1], y[i + 1], 3), (x[i], y[i], 3)) for i in range(64)]
    )
    planes = merge_coplanar(triangles)
    assert len(planes) == 64
    assert_on_planes(triangles, planes)
