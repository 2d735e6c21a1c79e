"""Covariances stay positive definite when they are rounded; those that are not are found."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_tables.gaussians.definite import cholesky_factors, is_definite, rounded_definite
from rayfix_tables.mixture import TubeMixture, pack, unpack

EPS = float(np.finfo(np.float32).eps)


def covariances(rng: np.random.Generator, count: int, decades: float) -> NDArray[np.float64]:
    """Draw covariances whose axes differ by up to this many powers of ten."""
    root = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0] * 10.0 ** rng.uniform(-decades, 0.0, (count, 1, 3))
    return np.asarray(root @ root.transpose(0, 2, 1))


@pytest.mark.parametrize("broken", [-1.0, 0.0, np.nan, np.inf])
def test_what_is_not_definite_is_found(broken: float) -> None:
    cov = covariances(np.random.default_rng(0), 5, 1.0)
    cov[2, 1, 1] = broken
    factors, definite = cholesky_factors(cov)
    assert definite.tolist() == [True, True, False, True, True]
    assert not factors[2].any()
    np.testing.assert_allclose((factors @ factors.transpose(0, 2, 1))[definite], cov[definite], rtol=0, atol=1e-15)


def test_nothing_is_definite() -> None:
    assert is_definite(np.zeros((0, 3, 3))).shape == (0,)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rounding_keeps_covariances_definite(seed: int) -> None:
    cov = covariances(np.random.default_rng(seed), 50, 6.0)
    cov = cov[is_definite(cov)]
    plain = cov.astype(np.float32).astype(np.float64)
    rounded = rounded_definite(cov)
    assert is_definite(rounded).all()
    np.testing.assert_array_equal(rounded, rounded.astype(np.float32))
    kept = is_definite(plain)
    np.testing.assert_array_equal(rounded[kept], plain[kept])
    scale = np.sqrt(np.einsum("ni,nj->nij", *[np.einsum("nii->ni", cov)] * 2))
    assert np.all(np.abs(rounded - cov) <= 20.0 * EPS * scale)


def test_rounding_alone_makes_some_singular() -> None:
    cov = covariances(np.random.default_rng(1), 200, 6.0)
    cov = cov[is_definite(cov)]
    lost = ~is_definite(cov.astype(np.float32).astype(np.float64))
    assert np.count_nonzero(lost) > 5


def test_a_mixture_is_stored_with_definite_covariances() -> None:
    cov = covariances(np.random.default_rng(2), 200, 5.0)
    cov = cov[is_definite(cov)]
    count = len(cov)
    mixture = TubeMixture(
        log_weight=np.zeros(count),
        u_mean=np.ones((count, 3)),
        u_cov=pack(cov),
        x_mean=np.zeros((count, 3)),
        jacobian=np.zeros((count, 3, 3)),
        x_cov=pack(cov),
        num_reflections=np.zeros(count),
        num_walls=np.zeros(count),
    ).as_stored()
    assert mixture.u_cov.dtype == mixture.x_cov.dtype == np.float32
    assert is_definite(unpack(mixture.u_cov.astype(np.float64))).all()
    assert is_definite(unpack(mixture.x_cov.astype(np.float64))).all()


def test_what_was_never_definite_is_stored_as_it_is() -> None:
    cov = -np.eye(3)[None]
    np.testing.assert_array_equal(rounded_definite(cov), cov)
