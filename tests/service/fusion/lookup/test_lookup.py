"""Look-up: what the cells' windows and the rest of the measurement multiply to."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_service.fusion.lookup.lookup import SUM_RATIO, Lookup, look_up
from rayfix_service.fusion.measurements.directions import NO_DIRECTION, Direction, MeasuredAngles
from rayfix_tables.geometry.angles import angles_of, local_to_scene, wrap
from rayfix_tables.geometry.angles import direction as direction_of
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import WINDOW_RATIO, Level
from rayfix_tables.mixture import TubeMixture

Array = NDArray[np.float64]


def empty_level(window_deg: float) -> Level:
    """Make a level as a table has it, but for its components."""
    window = float(np.deg2rad(window_deg))
    grid = AngularGrid.from_spacing(window / 0.8)
    return Level(
        window=window,
        grid=grid,
        cell_offsets=np.zeros(grid.num_cells + 1, np.int64),
        cell_log_mass=np.full(grid.num_cells, -np.inf),
        mixture=TubeMixture.empty(),
    )


LEVELS = tuple(empty_level(window) for window in (1.25, 5.0, 15.0))


def log_normal(apart: Array, cov: Array) -> Array:
    """Log density of two-dimensional normals."""
    det = cov[0, 0] * cov[1, 1] - cov[0, 1] * cov[1, 0]
    square = cov[1, 1] * apart[:, 0] ** 2 - 2.0 * cov[0, 1] * apart[:, 0] * apart[:, 1] + cov[0, 0] * apart[:, 1] ** 2
    return np.asarray(-0.5 * square / det - 0.5 * np.log(det) - np.log(2.0 * np.pi))


def tangent_to(lookup: Lookup, cell: int, azimuth: Array, zenith: Array) -> Array:
    """Tangent coordinates of directions about a cell, written out."""
    centre_azimuth, centre_zenith = lookup.level.grid.centres[cell]
    turned = (azimuth - centre_azimuth + np.pi) % (2.0 * np.pi) - np.pi
    return np.stack([np.sin(centre_zenith) * turned, zenith - centre_zenith], axis=-1)


def represented(lookup: Lookup, azimuth: Array, zenith: Array) -> Array:
    """Sum factor x N(.; 0, W) x N(.; a_rest, R_rest) over the cells looked up: what they say of directions."""
    total = np.zeros(len(azimuth))
    window = np.eye(2) * lookup.level.window**2
    for cell, mean, (hh, hv, vv), log_factor in zip(
        lookup.cells, lookup.rest_mean, lookup.rest_cov, lookup.log_factor, strict=True
    ):
        z = tangent_to(lookup, cell, azimuth, zenith)
        rest = np.array([[hh, hv], [hv, vv]])
        total += np.exp(log_factor + log_normal(z, window) + log_normal(z - mean, rest))
    return total


def directions(count: int, margin: float) -> tuple[Array, Array]:
    """Directions spread evenly over the sphere but for caps of this angle [rad] at its poles."""
    rng = np.random.default_rng(0)
    return rng.uniform(-np.pi, np.pi, count), np.arccos(rng.uniform(-np.cos(margin), np.cos(margin), count))


noise = st.tuples(st.floats(1e-3, 11.9), st.floats(1e-3, 11.9), st.floats(-0.99, 0.99))
"""Standard deviations of azimuth and zenith, degrees, and their correlation."""


def measured(azimuth: float, zenith: float, noise: tuple[float, float, float]) -> Direction:
    h, v = np.deg2rad(noise[:2])
    cov = np.array([[h * h, noise[2] * h * v], [noise[2] * h * v, v * v]])
    return Direction(azimuth=azimuth, zenith=zenith, cov=cov)


def widest(level: Level, direction: Direction) -> float:
    """Largest standard deviation of a measurement in its cell's tangent plane, rad."""
    assert direction.azimuth is not None
    assert direction.zenith is not None
    zenith = level.grid.centres[level.grid.nearest(direction.azimuth, direction.zenith), 1]
    stretch = np.diag([np.sin(zenith), 1.0])
    return float(np.sqrt(np.linalg.eigvalsh(stretch @ direction.cov @ stretch)[-1]))


@settings(max_examples=200, deadline=None)
@given(
    azimuth=st.one_of(st.floats(-np.pi, np.pi), st.sampled_from([np.pi, -3.1415926, 0.0])),
    zenith=st.one_of(st.floats(0.0, np.pi), st.sampled_from([0.0, 1e-9, np.pi])),
    noise=noise,
)
def test_one_cell_represents_the_measurement_exactly(
    azimuth: float, zenith: float, noise: tuple[float, float, float]
) -> None:
    """Also across azimuth +-180 degrees and at the poles."""
    direction = measured(azimuth, zenith, noise)
    assume(WINDOW_RATIO * widest(LEVELS[-1], direction) < LEVELS[-1].window)
    # Without the finer levels, which may answer by a sum.
    served = tuple(level for level in LEVELS if WINDOW_RATIO * widest(level, direction) < level.window)
    lookup = look_up(served, direction)
    assert len(lookup.cells) == 1
    centre_azimuth, centre_zenith = lookup.level.grid.centres[lookup.cells[0]]
    stretch = np.diag([np.sin(centre_zenith), 1.0])
    cov = stretch @ direction.cov @ stretch
    turned = (azimuth - centre_azimuth + np.pi) % (2.0 * np.pi) - np.pi
    a = np.array([np.sin(centre_zenith) * turned, zenith - centre_zenith])
    z = a + np.random.default_rng(0).standard_normal((20, 2)) @ np.linalg.cholesky(cov).T
    mean, (hh, hv, vv) = lookup.rest_mean[0], lookup.rest_cov[0]
    product = (
        lookup.log_factor[0]
        + log_normal(z, np.eye(2) * lookup.level.window**2)
        + log_normal(z - mean, np.array([[hh, hv], [hv, vv]]))
    )
    np.testing.assert_allclose(product, log_normal(z - a, cov), rtol=0, atol=1e-8)  # relative to the density


def test_the_cell_is_the_one_that_holds_the_direction() -> None:
    """A direction is at most half a cell from the centre, so that the rest of the measurement is near the cell, too."""
    azimuth, zenith = directions(500, 0.0)
    for a, z in zip(azimuth, zenith, strict=True):
        lookup = look_up(LEVELS, measured(float(a), float(z), (0.5, 0.5, 0.0)))
        apart = tangent_to(lookup, int(lookup.cells[0]), np.array([a]), np.array([z]))[0]
        # A cell of the last but one ring is a little wider than high.
        assert np.abs(apart).max() <= 0.5 * lookup.level.window / 0.8 * 1.0001
        assert np.hypot(*lookup.rest_mean[0]) <= 1.3 * np.hypot(*apart) + 1e-12


@settings(max_examples=200, deadline=None)
@given(azimuth=st.floats(-np.pi, np.pi), zenith=st.floats(0.0, np.pi), noise=noise)
def test_the_finest_level_that_is_wide_enough_answers(
    azimuth: float, zenith: float, noise: tuple[float, float, float]
) -> None:
    """By one cell where its window serves the noise, by a sum of cells up to ``SUM_RATIO`` times that."""
    direction = measured(azimuth, zenith, noise)
    fits = [WINDOW_RATIO * widest(level, direction) / level.window for level in LEVELS]
    assume(min(abs(np.array(fits) - 1.0)) > 1e-6)
    assume(min(abs(np.array(fits) - SUM_RATIO)) > 1e-6)
    lookup = look_up(LEVELS, direction)
    expected = next((level for level, fit in zip(LEVELS, fits, strict=True) if fit < SUM_RATIO), LEVELS[-1])
    assert lookup.level is expected
    if fits[LEVELS.index(expected)] < 1.0:
        assert len(lookup.cells) == 1


@pytest.mark.parametrize(
    ("stdev_deg", "window_deg", "one_cell"),
    [
        (1.0, 1.25, True),
        (1.001, 1.25, False),
        (1.599, 1.25, False),
        (1.601, 5.0, True),
        (4.0, 5.0, True),
        (6.399, 5.0, False),
        (6.401, 15.0, True),
        (12.0, 15.0, True),
    ],
)
def test_noise_of_exactly_four_fifths_of_a_window_is_served_by_a_cell(
    stdev_deg: float, window_deg: float, one_cell: bool
) -> None:
    lookup = look_up(LEVELS, measured(1.0, 0.5 * np.pi, (0.1, stdev_deg, 0.0)))
    assert np.rad2deg(lookup.level.window) == pytest.approx(window_deg)
    assert (len(lookup.cells) == 1) is one_cell


def test_without_an_angle_all_cells_add_up_to_one() -> None:
    azimuth, zenith = directions(500, np.deg2rad(30.0))
    lookup = look_up(LEVELS, NO_DIRECTION)
    assert len(np.unique(lookup.cells)) == lookup.level.num_cells
    np.testing.assert_allclose(represented(lookup, azimuth, zenith), 1.0, atol=0.03)
    # No ring lies beyond the poles, so only half as much comes together there.
    anywhere = represented(lookup, *directions(2000, 0.0))
    assert 0.5 < anywhere.min() < 0.7
    assert anywhere.max() < 1.03
    assert anywhere.mean() == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("stdev_deg", [1.0, 8.0, 12.5, 15.0, 20.0, 30.0, 60.0])
@pytest.mark.parametrize("azimuth", [0.3, np.pi])
def test_an_azimuth_alone_says_the_same_of_every_zenith(stdev_deg: float, azimuth: float) -> None:
    stdev = np.deg2rad(stdev_deg)
    around, zenith = directions(2000, np.deg2rad(30.0))
    apart = wrap(around - azimuth)
    near = np.abs(apart) < 2.0 * stdev
    lookup = look_up(LEVELS, Direction(azimuth=azimuth, zenith=None, cov=np.diag([stdev**2, np.inf])))
    expected = np.exp(-0.5 * (apart / stdev) ** 2) / (np.sqrt(2.0 * np.pi) * stdev)
    found = represented(lookup, around, zenith)
    np.testing.assert_allclose(found[near], expected[near], rtol=0.05)
    assert found.max() < 1.05 * expected.max()


@pytest.mark.parametrize(
    "stdev_deg", [(12.1, 12.1), (14.0, 14.0), (18.0, 18.0), (30.0, 20.0), (60.0, 60.0), (1.0, 20.0), (20.0, 1.0)]
)
@pytest.mark.parametrize("azimuth", [0.3, np.pi])
def test_a_wide_angle_is_a_sum_of_cells(stdev_deg: tuple[float, float], azimuth: float) -> None:
    """Just above the widest window as well as far above it, and on across azimuth +-180 degrees."""
    stdev, zenith = np.deg2rad(stdev_deg), 1.4
    around, up = directions(20_000, np.deg2rad(30.0))
    apart = np.stack([wrap(around - azimuth), up - zenith], axis=-1)
    near = ((apart / stdev) ** 2).sum(axis=1) < 4.0
    assert near.sum() > 50
    lookup = look_up(LEVELS, Direction(azimuth=azimuth, zenith=zenith, cov=np.diag(stdev**2)))
    rings = lookup.level.grid.num_rings
    sine = np.sin((np.floor(zenith * rings / np.pi) + 0.5) * np.pi / rings)
    # Per steradian.
    expected = np.exp(log_normal(apart, np.diag(stdev**2))) / sine
    np.testing.assert_allclose(represented(lookup, around, up)[near], expected[near], rtol=0.08)


@pytest.mark.parametrize("stdev_deg", [(12.1, 13.0), (20.0, 30.0), (40.0, 10.0), (2.0, 20.0)])
@pytest.mark.parametrize("correlation", [-0.95, -0.5, 0.3, 0.9])
@pytest.mark.parametrize("azimuth", [0.3, np.pi])
def test_a_wide_correlated_angle_is_a_sum_of_cells(
    stdev_deg: tuple[float, float], correlation: float, azimuth: float
) -> None:
    stdev, zenith = np.deg2rad(stdev_deg), 1.4
    cov = np.multiply.outer(stdev, stdev) * np.array([[1.0, correlation], [correlation, 1.0]])
    around, up = directions(40_000, np.deg2rad(35.0))
    apart = np.stack([wrap(around - azimuth), up - zenith], axis=-1)
    near = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(cov), apart) < 4.0
    assert near.sum() > 50
    lookup = look_up(LEVELS, Direction(azimuth=azimuth, zenith=zenith, cov=cov))
    rings = lookup.level.grid.num_rings
    sine = np.sin((np.floor(zenith * rings / np.pi) + 0.5) * np.pi / rings)
    expected = np.exp(log_normal(apart, cov)) / sine
    found = represented(lookup, around, up)
    np.testing.assert_allclose(found[near], expected[near], rtol=0, atol=0.15 * expected.max())
    assert np.abs(found - expected)[near].mean() < 0.04 * expected.max()
    # Without the correlation it would be another likelihood.
    other = np.exp(log_normal(apart, np.diag(stdev**2))) / sine
    assert np.abs(other - expected)[near].mean() > np.abs(found - expected)[near].mean()


@pytest.mark.parametrize("tilt_deg", [(20.0, 30.0, 0.0), (-100.0, 10.0, 25.0), (0.0, 0.0, 90.0)])
@pytest.mark.parametrize("stdev_deg", [1.0, 5.0, 20.0])
@pytest.mark.parametrize("azimuth", [0.3, np.pi])
def test_an_azimuth_alone_in_a_tilted_frame(
    tilt_deg: tuple[float, float, float], stdev_deg: float, azimuth: float
) -> None:
    """Seen from the tilted frame it is as any azimuth."""
    a, b, c = (float(angle) for angle in np.deg2rad(tilt_deg))
    rotation, stdev = local_to_scene((a, b, c)), float(np.deg2rad(stdev_deg))
    around, up = directions(40_000, np.deg2rad(25.0))
    seen_azimuth, seen_zenith = angles_of(direction_of(around, up) @ rotation)
    apart = wrap(azimuth - seen_azimuth)
    expected = np.exp(-0.5 * (apart / stdev) ** 2) / (np.sqrt(2.0 * np.pi) * stdev)
    cov = np.diag([stdev**2, np.inf])
    local = MeasuredAngles(azimuth, None, cov, rotation)
    lookup = look_up(LEVELS, Direction(azimuth=azimuth, zenith=None, cov=cov, local=local))
    found = represented(lookup, around, up)
    # Far from the tilted frame's poles, where azimuths crowd.
    there = np.abs(seen_zenith - 0.5 * np.pi) < np.deg2rad(50.0)
    assert np.abs(found - expected)[there & (expected > 0.01 * expected.max())].mean() < 0.04 * expected.max()
    assert np.abs(found - expected)[there].max() < 0.25 * expected.max()


@pytest.mark.parametrize(
    ("stdev_deg", "level", "tolerance"),
    [(0.999, 0, 1e-6), (1.001, 0, 0.06), (1.599, 0, 0.06), (1.601, 1, 1e-6)],
)
def test_on_either_side_of_a_switch_of_levels_the_likelihood_is_the_same(
    stdev_deg: float, level: int, tolerance: float
) -> None:
    """One cell is exact; in a sum, weights from cell to cell do not quite add up to 1."""
    azimuth, zenith = 0.7, 1.3
    lookup = look_up(LEVELS, measured(azimuth, zenith, (stdev_deg, stdev_deg, 0.0)))
    assert lookup.level is LEVELS[level]
    apart = np.random.default_rng(0).standard_normal((200, 2)) * np.deg2rad(stdev_deg)
    found = represented(lookup, azimuth + apart[:, 0], zenith + apart[:, 1])
    rings = lookup.level.grid.num_rings
    sine = np.sin((np.floor(zenith * rings / np.pi) + 0.5) * np.pi / rings)
    expected = np.exp(log_normal(apart * [sine, 1.0], np.diag([sine, 1.0]) ** 2 * np.deg2rad(stdev_deg) ** 2))
    near = (apart**2).sum(axis=1) < (2.0 * np.deg2rad(stdev_deg)) ** 2
    np.testing.assert_allclose(found[near], expected[near], rtol=tolerance)


@pytest.mark.parametrize("zenith", [0.0, 0.02, np.pi])
@pytest.mark.parametrize("stdev_deg", [0.5, 5.0, 60.0])
def test_the_poles_are_directions_like_others(zenith: float, stdev_deg: float) -> None:
    """Seen from straight above, 40 degrees of azimuth are hardly an angle."""
    lookup = look_up(LEVELS, measured(1.0, zenith, (40.0, stdev_deg, 0.0)))
    rings = np.searchsorted(lookup.level.grid.ring_offsets, lookup.cells, side="right") - 1
    last = lookup.level.grid.num_rings - 1
    assert (0 if zenith < 1.0 else last) in rings
    assert all(np.isfinite(field).all() for field in (lookup.rest_mean, lookup.rest_cov, lookup.log_factor))
    assert (lookup.rest_cov[:, [0, 2]] > 0.0).all()
