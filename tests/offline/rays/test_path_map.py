"""The map of paths against the image method, which shares no code with the rays."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_evaluation.truth.forward import ForwardSolver, Paths
from rayfix_offline.rays.pathmap import FieldOfView, fill_path_map
from rayfix_offline.rays.pathprior import fill_path_prior
from rayfix_offline.rays.rays import RaySet, sample_rays
from rayfix_offline.rays.segments import Segments
from rayfix_offline.rays.settings import PathKind
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.geometry.angles import direction
from rayfix_tables.paths import PathMap
from tests.support.scenes.shapes import box

Launch = Callable[..., Segments]
STATION = np.array([1.0, 1.0, 1.0])
ROOM_SPACE = FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=np.ones((40, 50, 30), bool))
EXPONENT = 2.0


@pytest.fixture(scope="module")
def rays() -> RaySet:
    """Draw a dense isotropic set."""
    return sample_rays(0.008, np.random.default_rng(0))


@pytest.fixture(scope="module")
def segments(rays: RaySet, room: NDArray[np.float64], launch_in: Launch) -> Segments:
    """Launch the rays in a room, with a box in it that casts shadows."""
    return launch_in(screened(room), STATION, rays.directions, max_reflections=2)


def screened(room: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the triangles of the room with a box in it."""
    return np.concatenate([room, box([2.0, 2.0, 0.0], [2.5, 3.5, 2.0])])


def path_map(rays: RaySet, segments: Segments, kind: PathKind = "power", **options: object) -> PathMap:
    """Fill the map of the room."""
    prior = fill_path_prior(rays, segments, ROOM_SPACE, exponent=EXPONENT, refinement=2)
    return fill_path_map(rays, segments, prior, exponent=EXPONENT, kind=kind, least_share=1e-3, **options)  # type: ignore[arg-type]


def paths_at(paths: PathMap, place: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Lengths, directions at the station, and weights of the paths to a place."""
    voxel = np.floor((place - paths.origin) / paths.voxel_size).astype(int)
    index = int(np.ravel_multi_index(tuple(voxel), paths.shape))
    own = slice(paths.offsets[index], paths.offsets[index + 1])
    apart = place - paths.images[paths.sequence[own]]
    length = np.linalg.norm(apart, axis=1)
    heading = np.einsum("nij,ni->nj", paths.mirrors[paths.sequence[own]], apart / length[:, None])
    return length, heading, np.asarray(paths.weight[own], float)


def true_paths(room: NDArray[np.float64], place: NDArray[np.float64]) -> Paths:
    """Solve for the paths to a place by the image method."""
    triangles = screened(room)
    solver = ForwardSolver.from_mesh(
        triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), max_reflections=2
    )
    return solver.station(STATION).paths(place)


def even_places(room: NDArray[np.float64], count: int) -> list[NDArray[np.float64]]:
    """Centres of voxels in whose corners the same paths arrive as in the middle: no shadow ends there."""
    rng, places = np.random.default_rng(3), []
    while len(places) < count:
        centre = 0.2 * (rng.integers((0, 0, 0), (20, 25, 15)) + 0.5)
        if np.linalg.norm(centre - STATION) < 0.5 or np.all((centre > [1.9, 1.9, 0.0]) & (centre < [2.6, 3.6, 2.1])):
            continue
        corners = centre + 0.099 * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
        sets = [sorted(true_paths(room, place).num_reflections) for place in (centre, *corners)]
        if all(each == sets[0] for each in sets):
            places.append(centre)
    return places


def shares(truth: Paths) -> NDArray[np.float64]:
    """Path-selection prior of the true paths."""
    strength = 10.0 ** (0.1 * EXPONENT * truth.gain_db)
    return np.asarray(strength / strength.sum())


def test_it_has_the_paths_of_the_image_method(rays: RaySet, segments: Segments, room: NDArray[np.float64]) -> None:
    """Each path above the least share, its length and direction exact, its probability but for the number of rays."""
    paths = path_map(rays, segments)
    compared = 0
    for place in even_places(room, 25):
        truth, (length, heading, weight) = true_paths(room, place), paths_at(paths, place)
        expected = shares(truth)
        assert weight.sum() == pytest.approx(1.0, abs=0.01)
        assert np.all(np.diff(weight) <= 0.0)
        for n in np.flatnonzero(expected > 0.003):
            toward = direction(truth.azimuth[n], truth.zenith[n])
            found = np.flatnonzero(
                (np.abs(length - truth.path_length[n]) < 1e-9) & (np.abs(heading - toward).max(axis=1) < 1e-9)
            )
            assert len(found) == 1
            assert weight[found[0]] == pytest.approx(expected[n], rel=0.15, abs=0.01)
            compared += 1
        assert len(weight) <= len(truth)
    assert compared > 60


def test_gains_are_those_of_the_reflections_and_lit_is_the_share_of_the_voxel(
    rays: RaySet, segments: Segments, room: NDArray[np.float64]
) -> None:
    """The image method's gain, times the square of the length, is what the interactions leave."""
    paths = path_map(rays, segments)
    lit = []
    for place in even_places(room, 10):
        truth, (length, heading, _) = true_paths(room, place), paths_at(paths, place)
        voxel = np.floor((place - paths.origin) / paths.voxel_size).astype(int)
        first = paths.offsets[np.ravel_multi_index(tuple(voxel), paths.shape)]
        for n in range(len(truth)):
            toward = direction(truth.azimuth[n], truth.zenith[n])
            found = np.flatnonzero(
                (np.abs(length - truth.path_length[n]) < 1e-9) & (np.abs(heading - toward).max(axis=1) < 1e-9)
            )
            if len(found):
                expected = np.log(10.0) / 10.0 * truth.gain_db[n] + 2.0 * np.log(truth.path_length[n])
                assert float(paths.log_gain[first + found[0]]) == pytest.approx(
                    expected, abs=2e-3 * (1.0 + abs(expected))
                )
                lit.append(float(paths.lit[first + found[0]]))
    assert len(lit) > 60
    assert np.median(lit) > 0.95


def test_weights_of_the_other_priors(rays: RaySet, segments: Segments, room: NDArray[np.float64]) -> None:
    """Uniform: any path counts in full. Paper: by the inverse square of its length."""
    uniform, paper = path_map(rays, segments, "uniform"), path_map(rays, segments, "paper")
    for place in even_places(room, 10):
        length, _, weight = paths_at(uniform, place)
        assert np.median(weight) > 0.9
        np.testing.assert_allclose(paths_at(paper, place)[2].sum(), (weight / length**2).sum(), rtol=1e-5)


def test_paths_from_outside_of_the_field_of_view_are_left_out(
    rays: RaySet, segments: Segments, room: NDArray[np.float64]
) -> None:
    """The others keep their probabilities: the station does report from there, but its array cannot see it."""
    axis, half = np.array([0.6, 0.8, 0.0]), np.deg2rad(50.0)
    whole, seen = (path_map(rays, segments, field_of_view=view) for view in (None, FieldOfView(axis, half)))
    left_out = 0
    for place in even_places(room, 10):
        length, heading, weight = paths_at(whole, place)
        inside = heading @ axis >= np.cos(half)
        for mine, other in zip(paths_at(seen, place), (length, heading, weight), strict=True):
            np.testing.assert_array_equal(mine, other[inside])
        left_out += np.count_nonzero(~inside)
    assert left_out > 10
    assert len(seen.images) < len(whole.images)


def test_the_number_of_threads_does_not_matter(rays: RaySet, segments: Segments) -> None:
    one, two = (path_map(rays, segments, jobs=jobs).to_arrays() for jobs in (1, 2))
    assert all(one[name].tobytes() == two[name].tobytes() for name in one)


def test_it_comes_back_from_its_arrays(rays: RaySet, segments: Segments) -> None:
    paths = path_map(rays, segments)
    again = PathMap.from_arrays({"other": np.zeros(1), **paths.to_arrays()})
    assert (again.shape, again.voxel_size, len(again)) == (paths.shape, paths.voxel_size, len(paths))
    assert all(np.array_equal(value, again.to_arrays()[name]) for name, value in paths.to_arrays().items())
