"""The angular grid against what a partition of the sphere must be."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_tables.geometry.angles import angles_of, wrap
from rayfix_tables.grid import AngularGrid

spacings = st.floats(0.02, 1.5)  # rad


@settings(deadline=None)
@given(spacings)
def test_cells_are_about_as_wide_as_asked(spacing: float) -> None:
    grid = AngularGrid.from_spacing(spacing)
    assert grid.num_cells == grid.ring_cells.sum() == len(grid.centres)
    assert np.pi / grid.num_rings <= spacing
    zenith = (np.arange(grid.num_rings) + 0.5) * np.pi / grid.num_rings
    widths = 2.0 * np.pi * np.sin(zenith) / grid.ring_cells
    assert np.all(widths <= spacing * (1.0 + 1e-15))
    # Not finer than needed: one cell fewer would be too wide.
    wider = 2.0 * np.pi * np.sin(zenith) / np.maximum(grid.ring_cells - 1, 1)
    assert np.all((grid.ring_cells == 1) | (wider > spacing * (1.0 - 1e-15)))


@settings(deadline=None)
@given(spacings)
def test_solid_angles_add_up_to_the_sphere(spacing: float) -> None:
    grid = AngularGrid.from_spacing(spacing)
    assert np.all(grid.solid_angles > 0.0)
    assert np.sum(grid.solid_angles * grid.ring_cells) == pytest.approx(4.0 * np.pi, rel=1e-13)


@settings(deadline=None)
@given(spacings)
def test_centres_lie_in_their_own_cells(spacing: float) -> None:
    grid = AngularGrid.from_spacing(spacing)
    azimuth, zenith = grid.centres.T
    assert np.all((azimuth > -np.pi) & (azimuth <= np.pi) & (zenith > 0.0) & (zenith < np.pi))
    np.testing.assert_array_equal(grid.nearest(azimuth, zenith), np.arange(grid.num_cells))


@settings(deadline=None)
@given(spacings, st.integers(0, 2**32 - 1))
def test_the_nearest_cell_holds_the_direction(spacing: float, seed: int) -> None:
    """Within half a cell of the centre in azimuth and zenith, whatever turns the azimuth is given with."""
    grid = AngularGrid.from_spacing(spacing)
    rng = np.random.default_rng(seed)
    azimuth, zenith = angles_of(rng.normal(size=(200, 3)))
    cell = grid.nearest(azimuth, zenith)
    ring = np.searchsorted(grid.ring_offsets, cell, side="right") - 1
    half_width, half_height = np.pi / grid.ring_cells[ring], np.pi / grid.num_rings / 2
    assert np.all(np.abs(wrap(azimuth - grid.centres[cell, 0])) <= half_width + 1e-12)
    assert np.all(np.abs(zenith - grid.centres[cell, 1]) <= half_height + 1e-12)
    turned = grid.nearest(azimuth + 2.0 * np.pi * rng.integers(-2, 3, 200), zenith)
    # A turn costs a rounding error, which matters at a cell's edge only.
    at_edge = np.abs(np.abs(wrap(azimuth - grid.centres[cell, 0])) - half_width) < 1e-12
    assert np.all((turned == cell) | at_edge)


def test_directions_spread_over_cells_as_their_solid_angles_say() -> None:
    """Uniform directions; the chi-square of the counts has mean 1 a cell and variance 2 a cell."""
    grid = AngularGrid.from_spacing(0.5)
    count = 200_000
    vectors = np.random.default_rng(3).normal(size=(count, 3))
    found = np.bincount(grid.nearest(*angles_of(vectors)), minlength=grid.num_cells)
    expected = np.repeat(grid.solid_angles, grid.ring_cells) / (4.0 * np.pi) * count
    chi_square = np.sum((found - expected) ** 2 / expected)
    freedom = grid.num_cells - 1
    assert abs(chi_square - freedom) < 4.0 * np.sqrt(2.0 * freedom)


@pytest.mark.parametrize("azimuth", [-np.pi, np.pi, np.nextafter(np.pi, 4.0), 3.0 * np.pi, np.nextafter(-np.pi, 0.0)])
@pytest.mark.parametrize("zenith", [0.0, np.pi / 2, np.pi, np.nextafter(np.pi, 4.0)])
def test_the_seam_and_the_poles_have_cells(azimuth: float, zenith: float) -> None:
    grid = AngularGrid.from_spacing(0.3)
    cell = int(grid.nearest(azimuth, zenith))
    ring = min(int(zenith / np.pi * grid.num_rings), grid.num_rings - 1)
    first, last = grid.ring_offsets[ring], grid.ring_offsets[ring + 1] - 1
    # The seam itself belongs to the last cell, what lies a rounding error beyond it to the first.
    assert cell == (first if wrap(azimuth) < 0.0 else last)


def test_a_small_grid_by_hand() -> None:
    """Three rings of 60 deg; cells of at most 1.1 rad: 6.28 sin(30 deg) / 1.1 = 2.9 and 6.28 / 1.1 = 5.7."""
    grid = AngularGrid.from_spacing(1.1)
    np.testing.assert_array_equal(grid.ring_cells, [3, 6, 3])
    np.testing.assert_array_equal(grid.ring_offsets, [0, 3, 9, 12])
    np.testing.assert_allclose(
        np.rad2deg(grid.centres[[0, 1, 3, 8, 11]]), [(-120, 30), (0, 30), (-150, 90), (150, 90), (120, 150)], atol=1e-12
    )
    np.testing.assert_allclose(grid.solid_angles, np.pi * np.array([1 / 3, 1 / 3, 1 / 3]), rtol=1e-14)
    assert grid.nearest(np.deg2rad([-179, 179, 1]), np.deg2rad([10, 61, 119])).tolist() == [0, 8, 6]
