"""Points along rays, and their selection by times."""

import numpy as np
import pytest
import trimesh

from rayfix_evaluation.paper.points import Launcher, RayPoints, draw_directions, points_on_rays
from rayfix_evaluation.paper.selection import RelativeLength, select_by_length, select_tuples
from rayfix_offline.scene.engine import EmbreeEngine
from rayfix_offline.scene.walls import opaque_walls
from rayfix_offline.twin.planes import merge_coplanar
from rayfix_service.fusion.measurements.directions import NO_DIRECTION, Direction
from rayfix_tables.geometry.angles import angles_of

STATION = np.array([1.0, 2.0, 1.5])
ROOM = np.array([[0.0, 0.0, 0.0], [4.0, 5.0, 3.0]])


@pytest.fixture
def launcher() -> Launcher:
    triangles = np.array(trimesh.creation.box(bounds=ROOM).triangles)
    return Launcher(
        engine=EmbreeEngine(triangles),
        planes=merge_coplanar(triangles),
        walls=opaque_walls(len(triangles), loss_db=0.0),
        bounds=ROOM,
        max_reflections=1,
        max_path_length=100.0,
    )


def points_of(lengths: np.ndarray[tuple[int], np.dtype[np.float64]]) -> RayPoints:
    """Points whose x is their path length."""
    return RayPoints(position=np.stack([lengths, 0.0 * lengths, 0.0 * lengths], axis=-1), path_length=lengths)


def test_directions_scatter_as_the_angle_of_arrival() -> None:
    cov = np.diag([0.02, 0.01]) ** 2
    measured = Direction(azimuth=3.13, zenith=1.2, cov=cov)
    azimuth, zenith = angles_of(draw_directions(measured, 20_000, np.random.default_rng(1)))
    turn = np.angle(np.exp(1j * (azimuth - 3.13)))
    # Four standard errors of a mean of 20,000.
    assert abs(turn.mean()) < 4 * 0.02 / np.sqrt(20_000)
    assert abs(zenith.mean() - 1.2) < 4 * 0.01 / np.sqrt(20_000)
    np.testing.assert_allclose([turn.std(), zenith.std()], [0.02, 0.01], rtol=0.03)


def test_without_an_angle_directions_come_from_all_around() -> None:
    vectors = draw_directions(NO_DIRECTION, 20_000, np.random.default_rng(1))
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(vectors.T @ vectors / 20_000, np.eye(3) / 3.0, rtol=0, atol=0.01)


def test_a_lone_azimuth_is_refused() -> None:
    with pytest.raises(ValueError, match="azimuth and zenith or no angle"):
        draw_directions(Direction(azimuth=0.1, zenith=None, cov=np.diag([1.0, np.inf])), 3, np.random.default_rng(1))


def test_points_follow_the_ray_and_its_mirror_image(launcher: Launcher) -> None:
    """Along +x the wall is 3 m away; the reflected ray comes back 4 m to the opposite wall."""
    rng = np.random.default_rng(1)
    points = points_on_rays(launcher, STATION, np.array([[1.0, 0.0, 0.0]]), step=0.25, rng=rng)
    length = points.path_length
    assert len(points) == 28  # 7 m in steps of 0.25 m
    np.testing.assert_allclose(np.diff(length), 0.25, rtol=0, atol=1e-12)
    assert 0.0 <= length[0] < 0.25
    x = np.where(length < 3.0, 1.0 + length, 4.0 - (length - 3.0))
    np.testing.assert_allclose(points.position, np.stack([x, 0 * x + 2.0, 0 * x + 1.5], axis=-1), rtol=0, atol=1e-9)


def test_points_of_many_rays_are_in_the_room_at_their_length(launcher: Launcher) -> None:
    rng = np.random.default_rng(2)
    directions = draw_directions(NO_DIRECTION, 400, rng)
    points = points_on_rays(launcher, STATION, directions, step=0.1, rng=rng)
    assert np.all(points.position >= ROOM[0] - 1e-9)
    assert np.all(points.position <= ROOM[1] + 1e-9)
    apart = np.linalg.norm(points.position - STATION, axis=1)
    assert np.all(apart <= points.path_length + 1e-9)
    direct = np.isclose(apart, points.path_length, rtol=0, atol=1e-9)
    # The mean free path to the walls is that of the first segments.
    assert 0.2 < direct.mean() < 0.6


def test_selected_lengths_scatter_as_the_propagation_time() -> None:
    selected = select_by_length(points_of(np.arange(0.0, 20.0, 1e-4)), 7.0, 0.5, np.random.default_rng(1)).path_length
    expected = np.sqrt(2.0 * np.pi) * 0.5 / 1e-4
    assert abs(len(selected) - expected) < 4.0 * np.sqrt(expected)
    assert abs(selected.mean() - 7.0) < 4.0 * 0.5 / np.sqrt(len(selected))
    assert selected.std() == pytest.approx(0.5, rel=0.03)


def test_tuples_weigh_as_all_pairs_do() -> None:
    """Bins against the sum over all pairs, for two stations and for three."""
    rng = np.random.default_rng(3)
    lengths = [rng.uniform(1.0, 9.0, 400), rng.uniform(2.0, 12.0, 300), rng.exponential(4.0, 200)]
    differences = [RelativeLength(length_difference=2.0, stdev=0.6), RelativeLength(length_difference=-1.0, stdev=0.4)]
    drawn = select_tuples(
        points_of(lengths[0]),
        [points_of(other) for other in lengths[1:]],
        differences,
        count=40_000,
        bins_per_stdev=20,
        rng=rng,
    )
    tables = [
        np.exp(-0.5 * ((other - lengths[0][:, None] - d.length_difference) / d.stdev) ** 2)
        for other, d in zip(lengths[1:], differences, strict=True)
    ]
    weight = tables[0].sum(axis=1) * tables[1].sum(axis=1)
    means = [weight @ lengths[0] / weight.sum()]
    for table, other, rest in zip(tables, lengths[1:], (weight / t.sum(axis=1) for t in tables), strict=True):
        means.append(rest @ table @ other / weight.sum())
    for points, mean in zip(drawn, means, strict=True):
        error = 4.0 * points.path_length.std() / np.sqrt(40_000)
        assert abs(points.path_length.mean() - mean) < error + 0.01  # m, of the bins
    for points, difference in zip(drawn[1:], differences, strict=True):
        assert np.abs(points.path_length - drawn[0].path_length - difference.length_difference).max() < 6 * 0.6


def test_times_that_no_points_agree_with_select_nothing() -> None:
    rng = np.random.default_rng(4)
    points = points_of(rng.uniform(1.0, 9.0, 100))
    far = RelativeLength(length_difference=500.0, stdev=0.5)
    drawn = select_tuples(points, [points], [far], count=10, bins_per_stdev=4, rng=rng)
    assert [len(p) for p in drawn] == [0, 0]
    assert len(select_by_length(points, 500.0, 0.5, rng)) == 0
