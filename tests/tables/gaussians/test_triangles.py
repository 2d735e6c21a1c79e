"""Packed triangles: the compiled functions against NumPy's indices."""

import numpy as np
import pytest

from rayfix_tables.gaussians.triangles import pack_lower, triangle, unpack_lower, unpack_upper
from rayfix_tables.mixture import pack, unpack


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_lower_triangles_row_by_row(size: int) -> None:
    rng = np.random.default_rng(size)
    matrices = rng.normal(size=(4, size, size))
    matrices += matrices.transpose(0, 2, 1)
    columns = np.full((triangle(size), 4), np.nan)
    for n in range(4):
        pack_lower(matrices[n], columns, n)
    np.testing.assert_array_equal(columns, matrices[:, *np.tril_indices(size)].T)
    found = np.full_like(matrices, np.nan)
    for n in range(4):
        unpack_lower(columns, n, found[n])
    np.testing.assert_array_equal(found, matrices)


def test_upper_triangles_are_those_of_a_table() -> None:
    matrix = np.random.default_rng(0).normal(size=(3, 3))
    packed = np.stack([np.full(6, np.nan), pack(matrix)])
    found = np.zeros((6, 6))
    unpack_upper(packed, 1, found, 2)
    np.testing.assert_array_equal(found[2:5, 2:5], unpack(packed[1]))
    found[2:5, 2:5] = 0.0
    assert not found.any()
