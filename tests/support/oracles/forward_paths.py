"""Solvers of triangles, and their paths beside each other."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rayfix.example.hall import HALL_SIZE, hall_stations
from rayfix_evaluation.truth.forward import ForwardSolver, Paths

Array = NDArray[np.float64]
EXACT = 1e-9  # m and rad
SIX_DB = 6.0


def solver_of(*parts: Array, max_reflections: int = 3, max_path_length: float = 60.0) -> ForwardSolver:
    """Build the solver of triangles, each with vertices of its own."""
    triangles = np.concatenate(parts)
    return ForwardSolver.from_mesh(
        triangles.reshape(-1, 3),
        np.arange(3 * len(triangles)).reshape(-1, 3),
        max_reflections=max_reflections,
        max_path_length=max_path_length,
        reflection_loss_db=SIX_DB,
    )


def rotation(rng: np.random.Generator) -> Array:
    """Draw a rotation uniformly."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q *= np.sign(np.diag(r))
    return np.asarray(q * np.sign(np.linalg.det(q)), np.float64)


def direction(paths: Paths) -> Array:
    """Return the unit vectors of the paths' angles at the station."""
    ring = np.sin(paths.zenith)
    return np.stack([ring * np.cos(paths.azimuth), ring * np.sin(paths.azimuth), np.cos(paths.zenith)], axis=1)


def bounces(paths: Paths, i: int) -> Array:
    """Return the reflection points of path i, of shape (num_reflections, 3), m."""
    return paths.vertices[i, 1 : 1 + paths.num_reflections[i]]


def assert_same_paths(actual: Paths, expected: Paths, atol: float = EXACT) -> None:
    """Check that both hold the same paths; those of equal gain may be in any order."""
    assert len(actual) == len(expected)
    np.testing.assert_allclose(actual.gain_db, expected.gain_db, rtol=0, atol=1e-7)
    if len(actual) == 0:
        return
    # Match by all vertices at once, so that a duplicate cannot stand for a missing path.
    gaps = np.abs(actual.vertices[:, None] - expected.vertices[None]).max(axis=(2, 3))
    match = gaps.argmin(axis=1)
    assert sorted(match) == list(range(len(expected)))
    assert gaps[np.arange(len(actual)), match].max() < atol
    np.testing.assert_allclose(actual.path_length, expected.path_length[match], rtol=0, atol=atol)
    np.testing.assert_allclose(direction(actual), direction(expected)[match], rtol=0, atol=atol)
    np.testing.assert_array_equal(actual.num_reflections, expected.num_reflections[match])


def hall_pairs(count: int, seed: int) -> Iterator[tuple[Array, Array]]:
    """Yield stations and points in the hall; some points are inside solids, where only leaks would lead."""
    rng = np.random.default_rng(seed)
    stations = [np.array(position) for _, position in hall_stations()]
    for i in range(count):
        yield stations[i % 4], rng.uniform((0.1, 0.1, 0.1), np.array(HALL_SIZE) - 0.1)
