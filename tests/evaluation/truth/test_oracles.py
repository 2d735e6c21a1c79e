"""The image method against a naive oracle and an exhaustive tree."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix.example.hall import HALL_SIZE, hall_stations
from rayfix_evaluation.truth.forward import ForwardSolver, Paths, StationSolver
from rayfix_evaluation.truth.mirrors import ImageTree
from tests.support.oracles.forward_paths import assert_same_paths, bounces, solver_of
from tests.support.scenes.shapes import box, quad

Array = NDArray[np.float64]


def crosses(start: Array, end: Array, triangles: Array) -> bool:
    """Tell whether a segment crosses a triangle strictly between its ends (Moeller and Trumbore)."""
    along = end - start
    e1, e2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(along, e2)
    det = np.einsum("fi,fi->f", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = start - triangles[:, 0]
        u = np.einsum("fi,fi->f", s, p) / det
        q = np.cross(s, e1)
        v = q @ along / det
        t = np.einsum("fi,fi->f", e2, q) / det
        margin = 1e-6 / np.linalg.norm(along)
        return bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > margin) & (t < 1 - margin)).any())


def naive_paths(planes: list[Array], station: Array, point: Array, max_reflections: int) -> list[tuple[int, ...]]:
    """Try all sequences of planes, each given by its triangles; return those that carry a path."""
    triangles = np.concatenate(planes)
    normals = [np.cross(t[0, 1] - t[0, 0], t[0, 2] - t[0, 0]) for t in planes]
    normals = [n / np.linalg.norm(n) for n in normals]
    anchors = [t[0, 0] for t in planes]
    found = []
    for order in range(max_reflections + 1):
        for sequence in itertools.product(range(len(planes)), repeat=order):
            if any(a == b for a, b in itertools.pairwise(sequence)):
                continue
            # Mirror the point from the last plane to the first; walk from the station towards the images.
            images = [point]
            for k in reversed(sequence):
                images.append(images[-1] - 2 * ((images[-1] - anchors[k]) @ normals[k]) * normals[k])
            vertices = [station]
            for k, image in zip(sequence, reversed(images[1:]), strict=True):
                start, stop = ((x - anchors[k]) @ normals[k] for x in (vertices[-1], image))
                if start * stop >= 0:
                    break
                hit = vertices[-1] + start / (start - stop) * (image - vertices[-1])
                across = 0.01 * normals[k]
                if not crosses(hit - across, hit + across, planes[k]):
                    break
                vertices.append(hit)
            else:
                vertices.append(point)
                sides = [
                    ((vertices[i] - anchors[k]) @ normals[k]) * ((vertices[i + 2] - anchors[k]) @ normals[k])
                    for i, k in enumerate(sequence)
                ]
                clear = not any(crosses(a, b, triangles) for a, b in itertools.pairwise(vertices))
                if clear and all(side > 0 for side in sides):
                    found.append(sequence)
    return found


def sequences_of(planes: list[Array], paths: Paths) -> list[tuple[int, ...]]:
    """Name the paths' sequences in terms of the given planes, from where the bounces lie."""
    normals = np.array([np.cross(t[0, 1] - t[0, 0], t[0, 2] - t[0, 0]) for t in planes])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    anchors = np.array([t[0, 0] for t in planes])
    return [
        tuple(int(np.abs(((x - anchors) * normals).sum(axis=1)).argmin()) for x in bounces(paths, i))
        for i in range(len(paths))
    ]


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_naive_oracle_on_tilted_quads(seed: int) -> None:
    """Seven tilted parallelograms around the ends, with gaps and overlaps; every sequence is tried."""
    rng = np.random.default_rng(seed)
    planes = []
    for outward in rng.permutation(np.concatenate([np.eye(3), -np.eye(3), np.ones((1, 3))])):
        tilted = np.linalg.qr(np.column_stack([outward, rng.standard_normal((3, 2))]) + 0.2 * rng.random((3, 3)))[0]
        centre = rng.uniform(2.0, 3.0) * outward
        along, across = tilted[:, 1] * rng.uniform(1.5, 3.5), tilted[:, 2] * rng.uniform(1.5, 3.5)
        corners = [centre + a * along + b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        planes.append(quad(*corners))
    solver = solver_of(*planes, max_path_length=1000.0)
    assert solver.num_planes == 7
    orders = np.zeros(4, dtype=int)
    for _ in range(6):
        station, point = rng.uniform(-2, 2, (2, 3))
        expected = naive_paths(planes, station, point, 3)
        actual = sequences_of(planes, solver.paths(station, point))
        assert sorted(actual) == sorted(expected)
        for sequence in expected:
            orders[len(sequence)] += 1
    assert orders[1] > 5
    assert orders[2:].sum() > 5


def test_agrees_with_naive_oracle_in_a_cluttered_room() -> None:
    """A room with one box on its floor, which also shares the floor's plane: eleven planes, two bounces."""
    room, crate = box((0, 0, 0), (6, 5, 3)), box((2, 2, 0), (3.5, 3, 2))
    sides = [room[i : i + 2] for i in range(0, 12, 2)] + [crate[i : i + 2] for i in range(0, 12, 2)]
    planes = [np.concatenate([sides[0], sides[6]]), *sides[1:6], *sides[7:]]
    solver = solver_of(room, crate, max_reflections=2)
    assert solver.num_planes == 11
    rng = np.random.default_rng(11)
    counts = set()
    for _ in range(6):
        station, point = rng.uniform((0.1, 0.1, 0.1), (5.9, 4.9, 2.9), (2, 3))
        expected = naive_paths(planes, station, point, 2)
        assert sorted(sequences_of(planes, solver.paths(station, point))) == sorted(expected)
        counts.add(len(expected))
    assert max(counts) > 10


def exhaustive_tree(solver: ForwardSolver, station: Array) -> ImageTree:
    """Mirror a station at all sequences of planes, with windows without bounds."""
    normals, offsets = solver.scene.normals, solver.scene.offsets
    images, planes, parents = [station], [-1], [-1]
    level = [0]
    for _ in range(solver.max_reflections - 1):
        following = []
        for node in level:
            heights = normals @ images[node] - offsets
            mirrored = images[node] - 2.0 * heights[:, None] * normals
            for k in range(len(normals)):
                if k != planes[node]:
                    following.append(len(images))
                    images.append(mirrored[k])
                    planes.append(k)
                    parents.append(node)
        level = following
    infinite = np.full((len(images), 3), np.inf)
    return ImageTree(np.array(images), np.array(planes), np.array(parents), -infinite, infinite)


def test_pruned_tree_finds_what_the_exhaustive_one_finds(hall: ForwardSolver) -> None:
    rng = np.random.default_rng(12)
    found = 0
    for position in (hall_stations()[0][1], (4.6, 7.9, 2.2)):
        pruned = hall.station(position)
        full = StationSolver(solver=hall, position=pruned.position, tree=exhaustive_tree(hall, pruned.position))
        assert len(full.tree.planes) == 1 + hall.num_planes + hall.num_planes * (hall.num_planes - 1)
        assert len(pruned.tree.planes) < len(full.tree.planes) / 3
        for point in rng.uniform((0.1, 0.1, 0.1), np.array(HALL_SIZE) - 0.1, (12, 3)):
            assert_same_paths(pruned.paths(point), full.paths(point), atol=1e-12)
            found += len(full.paths(point))
    assert found > 100


def test_line_of_sight_agrees_with_plain_numpy(hall: ForwardSolver, hall_triangles: Array) -> None:
    rng = np.random.default_rng(13)
    points = rng.uniform((0.1, 0.1, 0.1), np.array(HALL_SIZE) - 0.1, (150, 3))
    for _, position in hall_stations():
        station = np.array(position)
        expected = [not crosses(station, point, hall_triangles) for point in points]
        np.testing.assert_array_equal(hall.line_of_sight(station, points), expected)
        assert 0 < sum(expected) < len(points)
