"""Moments of a cell's ray pieces against a plain NumPy twin; their blur against derivatives."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_offline.fit.moments import (
    blur,
    gather_groups,
    gathered_rays,
    new_rows,
)
from rayfix_offline.fit.settings import RayFit
from rayfix_offline.rays.pathprior import PathPrior
from rayfix_offline.rays.pieces import Pieces, cut_pieces
from rayfix_offline.rays.rays import RaySet, sample_rays
from rayfix_offline.rays.segments import Segments, Sequences
from rayfix_tables.geometry.angles import direction, tangent
from tests.support.oracles.rays import no_reflections

Launch = Callable[..., Segments]
FLOORS = (RayFit.length_floor, RayFit.position_floor)
Groups = dict[tuple[int, int], tuple[float, NDArray[np.float64], NDArray[np.float64]]]


@dataclass(frozen=True)
class Traced:
    """Rays, their pieces and their sequences."""

    rays: RaySet
    pieces: Pieces
    sequences: Sequences


@pytest.fixture(scope="module")
def traced(clutter: NDArray[np.float64], launch_in: Launch) -> Traced:
    """About 3,000 rays in the cluttered room, with two reflections."""
    rays = sample_rays(0.065, np.random.default_rng(0))
    segments = launch_in(clutter, (3.6, 0.4, 2.6), rays.directions, max_reflections=2)
    prior = PathPrior(
        origin=np.zeros(3), voxel_size=1.0, total=np.ones((4, 5, 3)), free_volume=np.ones(1), coverage=(1.0,)
    )
    pieces = cut_pieces(rays, segments, prior, exponent=1.0, kind="uniform", slice_ratio=1.35)
    return Traced(rays, pieces, segments.sequences)


def gather(traced: Traced, centre: tuple[float, float], window: float, rows: NDArray[np.int32] | None = None) -> Groups:
    """Run the kernel; groups by sequence and slice."""
    rays, pieces = traced.rays, traced.pieces
    sequence, slices, _, mass, mean, cov = gather_groups(
        *centre,
        window,
        RayFit.cutoff,
        gathered_rays(rays, pieces, traced.sequences),
        pieces.num_slices,
        new_rows(len(traced.sequences.images)) if rows is None else rows,
    )
    found = zip(sequence, slices, mass, mean, cov, strict=True)
    return {(int(s), int(n)): (m, u, c) for s, n, m, u, c in found}


def naive_groups(traced: Traced, centre: tuple[float, float], window: float) -> Groups:
    """Weighted moments of all pieces of all rays, group by group."""
    rays, pieces = traced.rays, traced.pieces
    at = tangent(rays.azimuth, rays.zenith, *centre)
    square = (at**2).sum(axis=1) / window**2
    density = np.exp(-square / 2.0) / (2.0 * np.pi * window**2) * rays.solid_angle
    density[square > RayFit.cutoff**2] = 0.0
    ray = np.repeat(np.arange(len(rays)), np.diff(pieces.offsets))
    weight = density[ray] * pieces.mass
    heading = np.einsum("nij,nj->ni", traced.sequences.mirrors[pieces.sequence], rays.directions[ray])
    place = traced.sequences.images[pieces.sequence] + pieces.mean[:, None] * heading
    measured = pieces.mean + pieces.excess
    joint = np.concatenate([measured[:, None], at[ray], place], axis=1)
    along = np.concatenate([np.ones((len(ray), 1)), np.zeros((len(ray), 2)), heading], axis=1)
    found: Groups = {}
    for key in sorted(set(zip(pieces.sequence.tolist(), pieces.slice.tolist(), strict=True))):
        mine = np.flatnonzero((pieces.sequence == key[0]) & (pieces.slice == key[1]) & (weight > 0.0))
        if not len(mine):
            continue
        w = weight[mine] / weight[mine].sum()
        mean = w @ joint[mine]
        off = joint[mine] - mean
        cov = np.einsum("n,ni,nj->ij", w, off, off)
        cov += np.einsum("n,ni,nj->ij", w * pieces.variance[mine], along[mine], along[mine])
        found[key] = (weight[mine].sum(), mean, cov)
    return found


CENTRES = [
    (2.3, 1.9),  # into the room
    (np.pi - 0.01, 1.6),  # at the seam of azimuths
    (-np.pi + 0.02, 2.0),
    (0.3, 0.04),  # next to the zenith
    (-2.0, np.pi - 0.1),  # next to the nadir
]


@pytest.mark.parametrize("walls", [False, True])
@pytest.mark.parametrize("centre", CENTRES)
@pytest.mark.parametrize("window", [0.03, 0.2])
def test_gathered_groups(traced: Traced, centre: tuple[float, float], window: float, walls: bool) -> None:
    """Walls make measured lengths longer, and move no position."""
    if walls:
        excess = np.random.default_rng(0).choice([0.0, 0.1, 0.4], len(traced.pieces.mass)).astype(np.float32)
        traced = replace(traced, pieces=replace(traced.pieces, excess=excess))
    found, expected = gather(traced, centre, window), naive_groups(traced, centre, window)
    assert len(found) == len(expected) > 2
    assert found.keys() == expected.keys()
    for key, (mass, mean, cov) in found.items():
        its_mass, its_mean, its_cov = expected[key]
        assert mass == pytest.approx(its_mass, rel=1e-11)
        np.testing.assert_allclose(mean, its_mean, rtol=0, atol=1e-11)
        np.testing.assert_allclose(cov, its_cov, rtol=0, atol=1e-11)
        np.testing.assert_array_equal(cov, cov.T)


def test_the_scratch_is_left_clean(traced: Traced) -> None:
    rows = new_rows(len(traced.sequences.images))
    first = gather(traced, CENTRES[0], 0.2, rows)
    np.testing.assert_array_equal(rows, -1)
    gather(traced, CENTRES[1], 0.2, rows)
    again = gather(traced, CENTRES[0], 0.2, rows)
    assert first.keys() == again.keys()
    for key, (mass, mean, cov) in first.items():
        assert again[key][0] == mass
        np.testing.assert_array_equal(again[key][1], mean)
        np.testing.assert_array_equal(again[key][2], cov)


def test_more_groups_than_the_first_capacity(traced: Traced) -> None:
    """A wide cell has more than 64 groups, and their masses add up to the integral over its rays."""
    window = 0.5
    groups = gather(traced, CENTRES[0], window)
    assert len(groups) > 128
    expected = sum(mass for mass, _, _ in naive_groups(traced, CENTRES[0], window).values())
    assert sum(mass for mass, _, _ in groups.values()) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("window", [0.05, 0.2])
def test_the_mass_is_the_integral_of_the_window(window: float) -> None:
    """Rays of equal mass 1: in the chart, dOmega is sin(zenith) / sin(centre) da, which the window averages.

    The disc within three standard deviations holds 1 - exp(-4.5) = 0.989 of it.
    """
    rays = sample_rays(window / 6.0, np.random.default_rng(1))
    one = np.ones(len(rays))
    pieces = Pieces(
        offsets=np.arange(len(rays) + 1),
        sequence=np.zeros(len(rays), np.int32),
        slice=np.full(len(rays), 5, np.int16),
        mass=one,
        mean=2.0 * one,
        variance=0.01 * one,
        excess=np.zeros(len(rays), np.float32),
        num_walls=np.zeros(len(rays), np.int8),
    )
    centre = (0.4, 1.2)
    ((mass, mean, cov),) = gather(Traced(rays, pieces, no_reflections()), centre, window).values()
    inside = 1.0 - np.exp(-(RayFit.cutoff**2) / 2.0)
    assert mass == pytest.approx(inside * np.exp(-(window**2) / 2.0), rel=0.01)
    # Of a Gaussian cut at radius c, the variance along either axis shrinks by c^2 / 2 exp(-c^2 / 2) / inside.
    variance = window**2 * (1.0 - RayFit.cutoff**2 / 2.0 * np.exp(-(RayFit.cutoff**2) / 2.0) / inside)
    np.testing.assert_allclose(cov[1:3, 1:3] / variance, np.eye(2), rtol=0, atol=0.04)
    # The chart's slope shifts the vertical mean by cot(zenith) variance.
    np.testing.assert_allclose(mean[:3], (2.0, 0.0, variance / np.tan(1.2)), rtol=0, atol=0.02 * window)
    np.testing.assert_allclose(mean[3:] / 2.0, direction(*centre), rtol=0, atol=window**2 + 0.02 * window)
    assert cov[0, 0] == pytest.approx(0.01, rel=1e-9)


# Blur


def position(u: NDArray[np.float64], mirror: NDArray[np.float64], centre: tuple[float, float]) -> NDArray[np.float64]:
    """Place of ray coordinates, seen from the image."""
    return np.asarray(u[0] * mirror @ direction(centre[0] + u[1] / np.sin(centre[1]), centre[1] + u[2]))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_blur_adds_the_width_of_a_ray(seed: int) -> None:
    """G V G^T with G the derivative of (u, x) by u, V = diag(floor^2, spacing^2 / 12, spacing^2 / 12), and a floor."""
    rng = np.random.default_rng(seed)
    centre = (rng.uniform(-3, 3), rng.uniform(0.3, 2.8))
    mean = np.concatenate([[rng.uniform(0.3, 30.0)], rng.uniform(-0.2, 0.2, 2), rng.normal(size=3)])
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    mirror = np.eye(3) - 2.0 * np.outer(normal, normal)
    root = rng.normal(size=(6, 6)) * 0.1
    before = root @ root.T
    after = before.copy()
    spacing = rng.uniform(0.005, 0.1)
    blur(mean, after, mirror, *centre, spacing, *FLOORS)
    step = 1e-6
    slope = np.array(
        [
            (position(mean[:3] + d, mirror, centre) - position(mean[:3] - d, mirror, centre)) / (2 * step)
            for d in step * np.eye(3)
        ]
    ).T
    gradient = np.concatenate([np.eye(3), slope])
    widths = np.array([RayFit.length_floor, spacing / np.sqrt(12.0), spacing / np.sqrt(12.0)])
    expected = (gradient * widths**2) @ gradient.T + np.diag([0, 0, 0, 1, 1, 1]) * RayFit.position_floor**2
    np.testing.assert_allclose(after - before, expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(after, after.T, rtol=1e-14, atol=1e-16)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.005, 3.136), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_blur_makes_a_point_a_tube(seed: int, zenith: float, horizontal: float, vertical: float) -> None:
    """A group of a single ray has no covariance at all; blurred it can be inverted, at the poles, too."""
    rng = np.random.default_rng(seed)
    mean = np.array([rng.uniform(0.1, 60.0), horizontal, vertical, 0.0, 0.0, 0.0])
    cov = np.zeros((6, 6))
    blur(mean, cov, np.eye(3), rng.uniform(-3, 3), zenith, 0.01, *FLOORS)
    scale = np.sqrt(np.diag(cov))
    assert np.linalg.eigvalsh(cov / np.outer(scale, scale)).min() > 1e-9
    assert np.all(scale[3:] >= RayFit.position_floor)
    # Across the tube, given the ray coordinates, only the floor is left.
    rest = cov[3:, 3:] - cov[3:, :3] @ np.linalg.solve(cov[:3, :3], cov[:3, 3:])
    np.testing.assert_allclose(
        rest, RayFit.position_floor**2 * np.eye(3), rtol=0, atol=1e-6 * scale[3:].max() ** 2 + 1e-12
    )
