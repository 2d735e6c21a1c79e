"""Sampled directions stand for the whole sphere."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_offline.rays.rays import RaySet, sample_rays

seeds = st.integers(0, 2**32 - 1)


def cells_of(rays: RaySet) -> NDArray[np.int64]:
    """Cell that each ray lies in."""
    return rays.grid.nearest(rays.azimuth, rays.zenith)


@settings(max_examples=25, deadline=None)
@given(spacing=st.floats(0.03, 0.5), seed=seeds)
def test_one_ray_in_each_cell(spacing: float, seed: int) -> None:
    rays = sample_rays(spacing, np.random.default_rng(seed))
    np.testing.assert_array_equal(cells_of(rays), np.arange(len(rays)))
    assert rays.solid_angle.sum() == pytest.approx(4.0 * np.pi, rel=1e-12)
    assert np.pi / rays.grid.num_rings <= spacing
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1.0, rtol=0, atol=1e-15 * 4)


def test_rays_are_uniform_on_the_sphere() -> None:
    """The integrals of the first and second moments, over 30 draws of about 5,000 rays.

    Within a cell of 0.05 rad a draw deviates by 0.05 / sqrt(6) at most, so the sum over the sphere, 4 pi, deviates by
    0.05^2 0.05 / sqrt(6) sqrt(5000 * 30) / 30 = 7e-4.
    """
    first, second = np.zeros(3), np.zeros((3, 3))
    for seed in range(30):
        rays = sample_rays(0.05, np.random.default_rng(seed))
        first += rays.solid_angle @ rays.directions / 30
        second += np.einsum("n,ni,nj->ij", rays.solid_angle, rays.directions, rays.directions) / 30
    np.testing.assert_allclose(first, 0.0, rtol=0, atol=4 * 7e-4)
    np.testing.assert_allclose(second, 4.0 * np.pi / 3.0 * np.eye(3), rtol=0, atol=4 * 7e-4)


def test_within_a_ring_the_cosine_is_uniform() -> None:
    """In the ring at the zenith, where sin changes most, the mean of the cosine is that of its edges."""
    num_rings = sample_rays(0.4, np.random.default_rng(0)).grid.num_rings
    low = np.cos(np.pi / num_rings)
    cosines = []
    for seed in range(2000):
        rays = sample_rays(0.4, np.random.default_rng(seed))
        cosines.append(np.cos(rays.zenith[: rays.grid.ring_cells[0]]))
    place = (np.concatenate(cosines) - low) / (1.0 - low)
    assert np.all((place >= 0.0) & (place <= 1.0))
    deviation = np.sqrt(1.0 / 12.0 / len(place))
    assert abs(place.mean() - 0.5) < 4.0 * deviation


def test_the_seed_decides() -> None:
    first, again, other = (sample_rays(0.1, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.directions, again.directions)
    assert np.abs(first.directions - other.directions).max() > 0.01
