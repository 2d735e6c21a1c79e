"""Groups of one surface become one: the moments are those of all points."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_offline.fit.join_surfaces import join_groups


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_moments_of_all_points(seed: int) -> None:
    """Weighted points in 12 groups of 5 surface sequences and 2 slices, against the moments of their union."""
    rng = np.random.default_rng(seed)
    sequence, piece = rng.integers(0, 5, 12) * 7, rng.integers(3, 5, 12)
    points, weights = rng.normal(size=(12, 40, 6)) + 3.0 * rng.normal(size=(12, 1, 6)), rng.uniform(0.1, 1, (12, 40))
    mirror = rng.normal(size=(12, 3, 3))
    mass = weights.sum(axis=1)
    mean = np.einsum("gp,gpi->gi", weights, points) / mass[:, None]
    off = points - mean[:, None]
    cov = np.einsum("gp,gpi,gpj->gij", weights, off, off) / mass[:, None, None]
    found = join_groups(sequence, piece, mass, mean, cov, mirror, rng.integers(0, 4, 12))
    keys = list(dict.fromkeys(zip(sequence.tolist(), piece.tolist(), strict=True)))
    assert found[0].tolist() == [key[0] for key in keys]
    for n, key in enumerate(keys):
        mine = (sequence == key[0]) & (piece == key[1])
        w, x = weights[mine].reshape(-1), points[mine].reshape(-1, 6)
        expected = np.average(x, axis=0, weights=w)
        np.testing.assert_allclose(found[1][n], w.sum(), rtol=1e-13)
        np.testing.assert_allclose(found[2][n], expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found[3][n], np.cov(x.T, aweights=w, ddof=0), rtol=0, atol=1e-12)
        np.testing.assert_allclose(found[4][n], np.average(mirror[mine], axis=0, weights=mass[mine]), atol=1e-13)


def test_groups_that_stay_alone_are_not_touched() -> None:
    rng = np.random.default_rng(0)
    mass, mean, cov = rng.random(4), rng.normal(size=(4, 6)), rng.normal(size=(4, 6, 6))
    sequence, piece = np.array([3, 1, 1, 0]), np.array([0, 5, 2, 5])
    found = join_groups(sequence, piece, mass, mean, cov, rng.normal(size=(4, 3, 3)), np.arange(4))
    np.testing.assert_array_equal(found[5], np.arange(4))
    for joined, alone in zip(found, (sequence, mass, mean, cov), strict=False):
        np.testing.assert_array_equal(joined, alone)


def test_the_numbers_of_sequences_do_not_matter() -> None:
    """Another scene numbers them in another way; a cell that it leaves alone must not change by a bit."""
    rng = np.random.default_rng(1)
    sequence, piece = rng.integers(0, 4, 15), rng.integers(0, 3, 15)
    mass, mean, cov, mirror = (rng.random((15, *shape)) for shape in ((), (6,), (6, 6), (3, 3)))
    rest = mass, mean, cov, mirror, rng.integers(0, 4, 15)
    found = join_groups(sequence, piece, *rest)
    numbers = np.array([70, 20, 90, 40])
    again = join_groups(numbers[sequence], piece, *rest)
    np.testing.assert_array_equal(again[0], numbers[found[0]])
    for ours, theirs in zip(again[1:], found[1:], strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_no_groups() -> None:
    empty = np.zeros(0, np.int64)
    found = join_groups(empty, empty, np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros((0, 3, 3)), empty)
    assert [len(part) for part in found] == [0] * 6
