"""Ray pieces against exact integrals and a fine quadrature."""

from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_offline.rays.pathprior import PathPrior, fill_path_prior
from rayfix_offline.rays.pieces import Pieces, cut_pieces
from rayfix_offline.rays.rays import RaySet, sample_rays
from rayfix_offline.rays.segments import Segments
from rayfix_offline.rays.settings import RaySettings
from rayfix_tables.freespace import FreeSpace
from tests.support.oracles.rays import Rows, no_reflections

Launch = Callable[..., Segments]
Kind = Literal["power", "uniform", "paper"]
STATION = np.array([3.6, 0.4, 2.6])
RATIO = 1.35


def prior_of(value: float) -> PathPrior:
    """Make a total that is the same everywhere."""
    return PathPrior(
        origin=np.zeros(3), voxel_size=0.5, total=np.full((8, 10, 6), value), free_volume=np.ones(1), coverage=(1.0,)
    )


@pytest.fixture(scope="module")
def rays() -> RaySet:
    """About 300 rays."""
    return sample_rays(0.2, np.random.default_rng(0))


@pytest.fixture(scope="module")
def segments(rays: RaySet, clutter: NDArray[np.float64], launch_in: Launch) -> Segments:
    """Launch the rays in the cluttered room, with two reflections."""
    return launch_in(clutter, STATION, rays.directions, max_reflections=2)


def cut(rays: RaySet, segments: Segments, kind: Kind, *, total: float = 1.0) -> Pieces:
    """Cut with the usual settings."""
    return cut_pieces(rays, segments, prior_of(total), exponent=1.0, kind=kind, slice_ratio=RATIO)


def ray_sums(pieces: Pieces, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Add up over the pieces of each ray."""
    return np.array([values[a:b].sum() for a, b in zip(pieces.offsets, pieces.offsets[1:], strict=False)])


def test_uniform_masses_add_up_to_the_integral(rays: RaySet, segments: Segments) -> None:
    """The hats are a partition of unity, so a ray's masses add up to the integral of s^2, which is end^3 / 3."""
    pieces = cut(rays, segments, "uniform")
    np.testing.assert_allclose(ray_sums(pieces, pieces.mass), Rows.of(segments).end.max(axis=1) ** 3 / 3.0, rtol=1e-12)


def test_paper_masses_add_up_to_the_length(rays: RaySet, segments: Segments) -> None:
    pieces = cut(rays, segments, "paper")
    np.testing.assert_allclose(ray_sums(pieces, pieces.mass), Rows.of(segments).end.max(axis=1), rtol=1e-13)


def test_power_masses_add_up_to_the_share_of_a_constant_total(rays: RaySet, segments: Segments) -> None:
    """With beta = 1, s^2 gain is 10^(-0.6 k) after k reflections: the integrand is constant where the total is."""
    pieces = cut(rays, segments, "power", total=1e6)
    rows = Rows.of(segments)
    span = rows.end - rows.start
    expected = (span * 10.0 ** (-0.6 * np.arange(3))).sum(axis=1) / 1e6
    np.testing.assert_allclose(ray_sums(pieces, pieces.mass), expected, rtol=1e-12)


def test_the_only_path_has_probability_one(rays: RaySet, segments: Segments) -> None:
    """Where a path's own gain is all of the total, or the map holds less for noise, s^2 alone is left."""
    power, uniform = cut(rays, segments, "power", total=0.0), cut(rays, segments, "uniform")
    # At a wall, a path may be outside of the map by a rounding error: that much is lost.
    np.testing.assert_allclose(power.mass, uniform.mass, rtol=1e-10)
    np.testing.assert_allclose(power.mean, uniform.mean, rtol=1e-10)


@pytest.mark.parametrize(("axis", "middle"), [(0, 2.0), (1, 2.5), (2, 1.5)])
def test_the_voxel_of_the_point_decides(rays: RaySet, segments: Segments, axis: int, middle: float) -> None:
    """Half of the room has four paths: with beta = 0 the weight is s^2 on one side of the middle, s^2 / 4 beyond."""
    total = np.ones((8, 10, 6))
    np.moveaxis(total, axis, 0)[total.shape[axis] // 2 :] = 4.0
    prior = PathPrior(origin=np.zeros(3), voxel_size=0.5, total=total, free_volume=np.ones(1), coverage=(1.0,))
    pieces = cut_pieces(rays, segments, prior, exponent=0.0, kind="power", slice_ratio=RATIO)
    sums = ray_sums(pieces, pieces.mass)
    rows, sequences = Rows.of(segments), segments.sequences
    for ray in range(0, len(rays), 20):
        expected = 0.0
        for depth in range(3):
            seq = rows.sequence[ray, depth]
            start, end = rows.start[ray, depth], rows.end[ray, depth]
            length = start + (np.arange(20_000) + 0.5) / 20_000 * (end - start)
            place = sequences.images[seq, axis] + length * (sequences.mirrors[seq] @ rays.directions[ray])[axis]
            expected += np.sum(length**2 * np.where(place < middle, 1.0, 0.25)) * (end - start) / 20_000
        # The quadrature takes one of its steps of at most 1 mm, at most 20 m away, on the wrong side of each crossing.
        assert sums[ray] == pytest.approx(expected, abs=2 * 0.001 * 20.0**2)


@pytest.mark.parametrize("kind", ["uniform", "paper"])
def test_moments_of_each_piece(rays: RaySet, segments: Segments, kind: Kind) -> None:
    """Against a fine quadrature with hats that are interpolated between nodes at 0.25 m x 1.35^n."""
    pieces = cut_pieces(rays, segments, prior_of(1.0), exponent=1.0, kind=kind, slice_ratio=RATIO)
    rows, nodes = Rows.of(segments), RaySettings.first_node * RATIO ** np.arange(25)
    for ray in range(0, len(rays), 15):
        mine = slice(pieces.offsets[ray], pieces.offsets[ray + 1])
        found = {
            (s, n): (mass, mean, variance)
            for s, n, mass, mean, variance in zip(
                pieces.sequence[mine],
                pieces.slice[mine],
                pieces.mass[mine],
                pieces.mean[mine],
                pieces.variance[mine],
                strict=True,
            )
        }
        assert len(found) == mine.stop - mine.start
        for depth in range(3):
            seq, start, end = (field[ray, depth] for field in (rows.sequence, rows.start, rows.end))
            length = start + (np.arange(20_000) + 0.5) / 20_000 * (end - start)
            weight = (length**2 if kind == "uniform" else np.ones_like(length)) * (end - start) / 20_000
            for n in range(25):
                hat = np.interp(length, nodes, np.eye(25)[n])
                mass = np.sum(weight * hat)
                if mass == 0.0:
                    assert found.get((seq, n), (0.0,))[0] == 0.0
                    continue
                mean = np.sum(weight * hat * length) / mass
                variance = np.sum(weight * hat * length**2) / mass - mean**2
                scale = weight.sum()
                assert found[seq, n][0] == pytest.approx(mass, abs=1e-5 * scale)
                if mass > 1e-3 * scale:
                    assert found[seq, n][1] == pytest.approx(mean, abs=3e-4)
                    assert found[seq, n][2] == pytest.approx(variance, abs=1e-4)


def test_pieces_lie_within_their_slice_and_their_segment(rays: RaySet, segments: Segments) -> None:
    pieces = cut(rays, segments, "uniform")
    assert np.all(pieces.mass >= 0.0)
    assert np.all(pieces.variance >= 0.0)
    used = pieces.mass > 0.0
    assert used.mean() > 0.5
    node = RaySettings.first_node * RATIO ** pieces.slice.astype(float)
    low, high = np.where(pieces.slice == 0, 0.0, node / RATIO), node * RATIO
    assert np.all((pieces.mean > low - 1e-9)[used])
    assert np.all((pieces.mean < high + 1e-9)[used])
    assert np.all((pieces.variance <= (high - low) ** 2 / 4.0)[used])
    ray = np.repeat(np.arange(len(rays)), np.diff(pieces.offsets))
    depth = segments.sequences.num_reflections[pieces.sequence]
    rows = Rows.of(segments)
    np.testing.assert_array_equal(rows.sequence[ray, depth], pieces.sequence)
    assert np.all((pieces.mean >= rows.start[ray, depth] - 1e-9)[used])
    assert np.all((pieces.mean <= rows.end[ray, depth] + 1e-9)[used])


@settings(max_examples=20, deadline=None)
@given(start=st.floats(0.0, 30.0), span=st.floats(1e-6, 30.0), ratio=st.floats(1.05, 3.0))
def test_any_segment(start: float, span: float, ratio: float) -> None:
    """Segments that begin or end at, below or far beyond the first node, and tiny ones."""
    end = start + span
    segments = Segments(
        offsets=np.array([0, 1]),
        sequence=np.zeros(1, np.int32),
        start=np.array([start]),
        end=np.array([end]),
        log_gain=np.zeros(1),
        excess=np.zeros(1),
        num_walls=np.zeros(1, np.int8),
        sequences=no_reflections(),
        max_reflections=0,
        lost_ray_share=0.0,
        cut_power_share=0.0,
    )
    rays = sample_rays(0.5, np.random.default_rng(0))
    pieces = cut_pieces(rays, segments, prior_of(1.0), exponent=1.0, kind="paper", slice_ratio=ratio)
    assert pieces.mass.sum() == pytest.approx(span, rel=1e-9)
    mean = np.sum(pieces.mass * pieces.mean) / pieces.mass.sum()
    assert mean == pytest.approx(start + span / 2, rel=1e-9)
    second = np.sum(pieces.mass * (pieces.variance + (pieces.mean - mean) ** 2)) / pieces.mass.sum()
    assert second == pytest.approx(span**2 / 12.0, rel=1e-9, abs=1e-11)
    assert len(np.unique(pieces.slice)) == len(pieces.slice)


def test_chosen_rays_keep_their_pieces(rays: RaySet, segments: Segments) -> None:
    pieces = cut(rays, segments, "uniform")
    index = np.random.default_rng(3).choice(len(rays), 40, replace=False)
    chosen = pieces.of_rays(index)
    assert chosen.offsets[0] == 0
    for n, ray in enumerate(index):
        mine = slice(chosen.offsets[n], chosen.offsets[n + 1])
        theirs = slice(pieces.offsets[ray], pieces.offsets[ray + 1])
        for name in ("sequence", "slice", "mass", "mean", "variance"):
            np.testing.assert_array_equal(getattr(chosen, name)[mine], getattr(pieces, name)[theirs])
    assert chosen.offsets[-1] == len(chosen.mass)
    none = pieces.of_rays(np.zeros(0, np.int64))
    assert (none.offsets.tolist(), len(none.mass)) == ([0], 0)


def test_the_number_of_threads_changes_nothing(rays: RaySet, segments: Segments) -> None:
    """Neither the map nor the pieces, to the last bit."""
    space = FreeSpace(origin=np.zeros(3), voxel_size=0.25, free=np.ones((16, 20, 12), bool))
    priors = [fill_path_prior(rays, segments, space, exponent=2.0, refinement=2, jobs=jobs) for jobs in (1, 2)]
    np.testing.assert_array_equal(priors[0].total, priors[1].total)
    assert priors[0].coverage == priors[1].coverage
    one, two = (
        cut_pieces(rays, segments, priors[0], exponent=2.0, kind="power", slice_ratio=RATIO, jobs=jobs)
        for jobs in (1, 2)
    )
    for name in ("offsets", "sequence", "slice", "mass", "mean", "variance"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
