"""Polygons of all shapes, cut into triangles."""

from collections import Counter

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_offline.scene.polygons import Triangles, cut_polygons
from tests.support.scenes.polygon_scene import PARTITION_VOLUME, indexed, partition, volume

WALL = [(0, 0), (2.5, 0), (2.5, 2.1), (3.5, 2.1), (3.5, 0), (6, 0), (6, 3), (0, 3)]
COMB = [(0, 0), (9, 0), (9, 4), (8, 4), (8, 1), (6, 1), (6, 4), (5, 4), (5, 1), (3, 1), (3, 4), (2, 4), (2, 1), (0, 1)]
ARROW = [(0, 0), (2, 1), (0, 2), (0.5, 1)]
IN_LINE = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (3, 2), (2, 2), (1, 2), (0, 2), (0, 1)]
WINDOWS = [(0, 0), (1, 0), (1, 1), (2, 1), (2, 0), (3, 0), (4, 0), (4, 1), (5, 1), (5, 0), (6, 0), (6, 3), (0, 3)]
REPEATED = [(0, 0), (0, 0), (2, 0), (2, 1), (1, 1), (1, 1), (1, 2), (0, 2)]
SPIRAL = [
    (0, 0),
    (6, 0),
    (6, 6),
    (1, 6),
    (1, 2),
    (4, 2),
    (4, 4),
    (3, 4),
    (3, 3),
    (2, 3),
    (2, 5),
    (5, 5),
    (5, 1),
    (0, 1),
]
SHAPES = {
    "wall": WALL,
    "comb": COMB,
    "arrow": ARROW,
    "in line": IN_LINE,
    "windows": WINDOWS,
    "repeated": REPEATED,
    "spiral": SPIRAL,
}


def placed(outline: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Put a flat outline somewhere in space, turned at random."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return np.asarray(np.insert(outline, 2, 0.0, axis=1) @ turn + rng.uniform(-50.0, 50.0, 3))


def area_vectors(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.asarray(0.5 * np.cross(b - a, c - a))


def whole_area(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    off = ring - ring[0]
    return np.asarray(0.5 * np.cross(off, np.roll(off, -1, axis=0)).sum(axis=0))


def cut(ring: NDArray[np.float64]) -> Triangles:
    return cut_polygons(ring, np.arange(len(ring)), np.array([len(ring)]))


def border(faces: NDArray[np.int64]) -> Counter[tuple[int, int]]:
    sides = Counter((int(f[k]), int(f[(k + 1) % 3])) for f in faces for k in range(3))
    return Counter({side: n for side, n in sides.items() if side[::-1] not in sides})


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("name", SHAPES)
def test_triangles_cover_a_polygon_once(name: str, backwards: bool, first: int) -> None:
    """All face as it does, so that the sum of their areas is that of their area vectors: the polygon's."""
    outline = np.roll(np.array(SHAPES[name], float), first, axis=0)
    ring = placed(outline[::-1] if backwards else outline, seed=first)
    found = cut(ring)
    vectors, expected = area_vectors(ring, found.faces), whole_area(ring)
    size = np.linalg.norm(expected)
    np.testing.assert_allclose(vectors.sum(axis=0), expected, rtol=0, atol=1e-9 * size)
    assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(size, rel=1e-9)
    assert (vectors @ expected > 0.0).all()
    assert len(found.crossing) == len(found.bent) == 0


@pytest.mark.parametrize("first", range(3))
@pytest.mark.parametrize("name", [name for name in SHAPES if name != "repeated"])
def test_all_corners_stay_corners(name: str, first: int) -> None:
    """The border is the polygon's own, edge for edge: a neighbour with the same corners leaves no gap."""
    ring = placed(np.roll(np.array(SHAPES[name], float), first, axis=0), seed=7)
    count = len(ring)
    assert border(cut(ring).faces) == Counter((k, (k + 1) % count) for k in range(count))
    assert len(cut(ring).faces) == count - 2


@pytest.mark.parametrize("seed", range(40))
def test_random_star_shapes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(4, 30))
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    if np.diff(np.append(angle, angle[0] + 2.0 * np.pi)).max() > 3.0:
        angle = np.arange(count) * 2.0 * np.pi / count
    radius = rng.uniform(0.2, 3.0, count)
    ring = placed(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), seed)
    vectors = area_vectors(ring, cut(ring).faces)
    assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(np.linalg.norm(whole_area(ring)), rel=1e-9)
    assert len(vectors) == count - 2


def test_a_solid_of_polygons_stays_closed() -> None:
    """Each edge twice, once in each direction; and the volume is that of the polygons."""
    for first in range(8):
        polygons = partition(first=first)
        points, rings = indexed(polygons)
        found = cut_polygons(points, np.concatenate(rings), np.array([len(ring) for ring in rings]))
        assert not border(found.faces)
        inside = np.einsum("ij,ij->", points[found.faces[:, 0]], area_vectors(points, found.faces)) / 3.0
        assert inside == pytest.approx(PARTITION_VOLUME, rel=1e-12)
        assert volume(polygons) == pytest.approx(PARTITION_VOLUME, rel=1e-12)


def test_holes() -> None:
    outline = np.array([(0, 0, 0), (6, 0, 0), (6, 3, 0), (0, 3, 0)], float)
    holes = [
        np.array([(1, 1, 0), (2, 1, 0), (2, 2, 0), (1, 2, 0)], float),
        np.array([(4, 1, 0), (4, 2, 0), (5, 1.5, 0)]),
    ]
    points = np.concatenate([outline, *holes])
    found = cut_polygons(points, np.arange(4), np.array([4]), holes={0: [np.arange(4, 8), np.arange(8, 11)]})
    vectors = area_vectors(points, found.faces)
    assert (vectors[:, 2] > 0.0).all()
    assert vectors[:, 2].sum() == pytest.approx(18.0 - 1.0 - 0.5, rel=1e-12)
    assert sum(border(found.faces).values()) == 11


def test_polygons_without_a_right_cut_are_told_of() -> None:
    """A bow-tie, one without an area, a flat one and one with a corner far off its plane."""
    bow_tie = [(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1.5, 0)]
    line = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), (1.5, 0, 0)]
    flat = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    bent = [(0, 0, 0), (1, 0, 0), (1, 1, 0.3), (0, 1, 0)]
    points = np.array([*bow_tie, *line, *flat, *bent], float)
    sizes = np.array([4, 5, 4, 4])
    found = cut_polygons(points, np.arange(17), sizes)
    assert (list(found.crossing), list(found.bent)) == ([0, 1], [3])
    assert list(found.polygons) == [0, 0, 1, 1, 1, 2, 2, 3, 3]
    problems = [remark.problem for remark in found.remarks(points, np.arange(17), np.cumsum(sizes) - sizes)]
    assert problems[0].startswith("2 polygons that cross themselves")
    assert problems[1].startswith("1 polygon not flat")


def test_nothing_to_cut() -> None:
    found = cut_polygons(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64))
    assert found.faces.shape == (0, 3)
    assert not found.remarks(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64))
