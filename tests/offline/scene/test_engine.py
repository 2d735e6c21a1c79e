"""Embree against the plain algorithm of Moller and Trumbore."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_offline.scene.engine import EmbreeEngine

Vectors = Callable[[int, int], NDArray[np.float64]]


def naive_hits(
    triangles: NDArray[np.float64], origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[int, float]:
    """First hit of one ray, and by how much [m] it is sure.

    T. Moller and B. Trumbore, "Fast, minimum storage ray-triangle intersection", J. Graphics Tools 2 (1), 1997. The
    margin is the least distance by which any triangle's edge, or the next triangle behind, is missed.
    """
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(direction, ac)
    det = np.einsum("ij,ij->i", ab, across)
    u = np.einsum("ij,ij->i", origin - a, across) / det
    turned = np.cross(origin - a, ab)
    v = turned @ direction / det
    reach = np.einsum("ij,ij->i", ac, turned) / det
    inside = np.minimum(np.minimum(u, v), 1.0 - u - v)
    size = np.sqrt(np.linalg.norm(np.cross(ab, ac), axis=1))
    ahead = reach > 0.0
    hits = np.flatnonzero(ahead & (inside > 0.0))
    margin = float(np.min(np.abs(inside[ahead]) * size[ahead], initial=np.inf))
    if not len(hits):
        return -1, margin
    order = hits[np.argsort(reach[hits])]
    gaps = np.diff(reach[order[:2]], prepend=0.0)
    return int(order[0]), min(margin, float(gaps.min()))


def test_random_triangles(unit_vectors: Vectors) -> None:
    rng = np.random.default_rng(0)
    triangles = rng.uniform(-5, 5, (60, 1, 3)) + rng.uniform(-3, 3, (60, 3, 3))
    origins, directions = rng.uniform(-6, 6, (3000, 3)), unit_vectors(3000, 1)
    rays = zip(origins, directions, strict=True)
    expected, margin = map(np.array, zip(*(naive_hits(triangles, *ray) for ray in rays), strict=True))
    found = EmbreeEngine(triangles).first_hit(origins, directions)
    assert (found.dtype, found.shape) == (np.int32, (3000,))
    sure = margin > 1e-4  # m; Embree rounds coordinates of 10 m to 1e-6 m
    np.testing.assert_array_equal(found[sure], expected[sure])
    assert sure.mean() > 0.98
    assert 0.2 < (expected >= 0).mean() < 0.9


def test_a_closed_room_is_hit_by_every_ray(room: NDArray[np.float64], unit_vectors: Vectors) -> None:
    """Rays to the edges and diagonals, too: the wall's plane is the right one within rounding."""
    station = np.array([1.1, 2.3, 0.7])
    on_edges = np.concatenate([(room[:, i] + (room[:, j] - room[:, i]) * 0.37) for i, j in ((0, 1), (1, 2), (2, 0))])
    directions = np.concatenate([unit_vectors(20_000, 2), (on_edges - station)])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    found = EmbreeEngine(room).first_hit(np.broadcast_to(station, directions.shape), directions)
    assert np.all(found >= 0)
    with np.errstate(divide="ignore"):
        reach = (np.where(directions > 0, (4.0, 5.0, 3.0), 0.0) - station) / directions
    normals = np.cross(room[:, 1] - room[:, 0], room[:, 2] - room[:, 0])
    axis = np.abs(normals).argmax(axis=1)[found]
    excess = reach[np.arange(len(reach)), axis] - reach.min(axis=1)
    assert excess.max() < 1e-5  # m
    assert np.all(np.sign(directions[np.arange(len(reach)), axis]) == np.sign(normals[found, axis]))


@pytest.mark.parametrize("face", [1, -1])
def test_triangles_are_hit_from_both_sides(face: int) -> None:
    triangle = np.array([[(0, 0, 0), (1, 0, 0), (0, 1, 0)]], dtype=float)[:, ::face]
    engine = EmbreeEngine(triangle)
    origins = np.array([(0.2, 0.2, 1.0), (0.2, 0.2, -1.0), (0.8, 0.8, 1.0)])
    directions = np.array([(0, 0, -1.0), (0, 0, 1.0), (0, 0, -1.0)])
    assert engine.first_hit(origins, directions).tolist() == [0, 0, -1]
    assert engine.first_hit(origins, -directions).tolist() == [-1, -1, -1]


def test_hits_come_in_the_order_of_the_rays(room: NDArray[np.float64], unit_vectors: Vectors) -> None:
    engine, directions = EmbreeEngine(room), unit_vectors(1000, 3)
    origins = np.broadcast_to((2.0, 2.0, 2.0), directions.shape)
    together = engine.first_hit(origins, directions)
    one_by_one = [engine.first_hit(origins[i : i + 1], directions[i : i + 1])[0] for i in range(0, 1000, 50)]
    np.testing.assert_array_equal(together[::50], one_by_one)
    order = np.random.default_rng(4).permutation(1000)
    np.testing.assert_array_equal(engine.first_hit(origins, directions[order]), together[order])


def test_views_and_no_rays(room: NDArray[np.float64]) -> None:
    engine = EmbreeEngine(room)
    assert engine.first_hit(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)
    rays = np.asfortranarray(np.broadcast_to((1.0, 2.0, 1.0, 0.0, 0.0, 1.0), (4, 6)))
    found = engine.first_hit(rays[::2, :3], rays[::2, 3:])
    ceiling = np.flatnonzero(room[:, :, 2].min(axis=1) == 3.0)
    assert len(found) == 2
    assert np.isin(found, ceiling).all()


def test_the_engine_keeps_its_own_triangles(room: NDArray[np.float64]) -> None:
    triangles = room.copy()
    engine = EmbreeEngine(triangles)
    triangles += 100.0
    assert engine.first_hit(np.array([[2.0, 2.0, 2.0]]), np.array([[0.0, 0.0, 1.0]]))[0] >= 0
