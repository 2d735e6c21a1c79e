"""The voxel map of the path-selection prior against closed forms."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_offline.rays.pathprior import PathPrior, fill_path_prior, wall_factors
from rayfix_offline.rays.rays import RaySet, sample_rays
from rayfix_offline.rays.segments import Segments
from rayfix_offline.scene.walls import opaque_walls
from rayfix_tables.freespace import FreeSpace
from tests.support.scenes.shapes import box

Launch = Callable[..., Segments]
STATION = np.array([1.0, 1.0, 1.0])
SPACING = 0.008  # rad; at 3 m, 70 rays cross a voxel of 0.2 m
ROOM_SPACE = FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=np.ones((40, 50, 30), bool))


@pytest.fixture(scope="module")
def rays() -> RaySet:
    """Draw a dense isotropic set."""
    return sample_rays(SPACING, np.random.default_rng(0))


@pytest.fixture(scope="module")
def direct(rays: RaySet, room: NDArray[np.float64], launch_in: Launch) -> Segments:
    """Launch the rays in the empty room, without reflections."""
    return launch_in(room, STATION, rays.directions, max_reflections=0)


def centres(prior: PathPrior) -> NDArray[np.float64]:
    """Centres of the voxels, shape (nx, ny, nz, 3), m."""
    index = np.stack(np.meshgrid(*(np.arange(n) for n in prior.total.shape), indexing="ij"), axis=-1)
    return prior.origin + (index + 0.5) * prior.voxel_size


def distances(prior: PathPrior, place: ArrayLike) -> NDArray[np.float64]:
    """Distance of the voxels from a place, m."""
    return np.asarray(np.linalg.norm(centres(prior) - place, axis=-1))


def test_wall_factors(rays: RaySet, room: NDArray[np.float64], launch_in: Launch) -> None:
    """6 dB are a factor of 0.251 in power; to the power of beta = 2, 0.0631."""
    segments = launch_in(room, STATION, rays.directions[:100], max_reflections=2)
    expected = np.tile([1.0, 10**-1.2, 10**-2.4], 100)
    np.testing.assert_allclose(wall_factors(segments, 2.0), expected, rtol=1e-14)
    np.testing.assert_array_equal(wall_factors(segments, 0.0), 1.0)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
def test_an_empty_room_has_one_path_everywhere(rays: RaySet, direct: Segments, exponent: float) -> None:
    """The total is gain^beta = r^(-2 beta); at beta = 0 it counts the paths, exactly one.

    Its mean over a voxel of width h is larger by h^2 beta (2 beta - 1) / (12 r^2), which is 2 % at 1 m for beta = 2.
    """
    prior = fill_path_prior(rays, direct, ROOM_SPACE, exponent=exponent, refinement=2)
    assert (prior.total.shape, prior.voxel_size) == ((20, 25, 15), 0.2)
    distance = distances(prior, STATION)
    curved = 1.0 + prior.voxel_size**2 * exponent * (2.0 * exponent - 1.0) / (12.0 * distance**2)
    ratio = (prior.total * distance ** (2.0 * exponent) / curved)[distance > 1.0]
    assert ratio.mean() == pytest.approx(1.0, abs=0.002)
    assert ratio.std() < 0.04
    assert np.abs(ratio - 1.0).max() < 0.25
    assert prior.coverage == pytest.approx((1.0,), abs=1e-12)


def test_the_whole_of_space_is_filled(rays: RaySet, direct: Segments) -> None:
    """At beta = 0, the sum over the voxels is the room's volume, whatever the noise in each."""
    prior = fill_path_prior(rays, direct, ROOM_SPACE, exponent=0.0, refinement=2)
    assert prior.total.sum() * prior.voxel_size**3 == pytest.approx(60.0, rel=2e-4)


@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_one_mirror_adds_the_image(rays: RaySet, launch_in: Launch, exponent: float) -> None:
    """A large mirror at x = 0: the total is that of the station plus that of its image, weaker by the loss.

    ::

                |  s (1, 1, 1)
       image    |        +-------+
       *        |        | voxels|  x from 0 to 4
                |        +-------+
    """
    wall = np.array([[(0, -50, -50), (0, 50, -50), (0, 50, 50)], [(0, -50, -50), (0, 50, 50), (0, -50, 50)]], float)
    frame = np.array([[(9, 0, 0), (9, 0.1, 0), (9, 0, 0.1)]])
    segments = launch_in(
        np.concatenate([wall, frame]), STATION, rays.directions, max_reflections=1, max_path_length=30.0, loss_db=3.0
    )
    prior = fill_path_prior(rays, segments, ROOM_SPACE, exponent=exponent, refinement=2)
    near, far = distances(prior, STATION), distances(prior, (-1.0, 1.0, 1.0))
    expected = near ** (-2.0 * exponent) + 10.0 ** (-0.3 * exponent) * far ** (-2.0 * exponent)
    ratio = (prior.total / expected)[near > 1.0]
    assert ratio.mean() == pytest.approx(1.0, abs=0.01)
    assert ratio.std() < 0.04
    assert np.abs(ratio - 1.0).max() < 0.25
    # The image is an effect, not noise: without it the ratio would be this.
    assert (expected * near ** (2.0 * exponent)).mean() > 1.05


def test_more_rays_are_less_noise(rays: RaySet, direct: Segments, room: NDArray[np.float64], launch_in: Launch) -> None:
    """Down to a few percent: the steps of neighbouring rays do not fall into the same voxels."""
    noise = []
    for set_of_rays in (rays, sample_rays(2.0 * SPACING, np.random.default_rng(9))):
        segments = launch_in(room, STATION, set_of_rays.directions, max_reflections=0)
        prior = fill_path_prior(set_of_rays, segments, ROOM_SPACE, exponent=0.0, refinement=2)
        noise.append(prior.total[distances(prior, STATION) > 1.0].std())
    assert noise[0] < 0.04
    assert noise[1] > 2.0 * noise[0]


def test_the_map_is_bounded_next_to_the_station(rays: RaySet, direct: Segments) -> None:
    """Within half a voxel the gain counts as that of half a voxel, so that no strange power of 0 comes in."""
    prior = fill_path_prior(rays, direct, ROOM_SPACE, exponent=20.0, refinement=2)
    assert np.all(prior.total <= 0.1 ** (-40.0))
    assert prior.total.max() > 0.2 ** (-40.0)


def test_the_number_of_rays_does_not_matter(rays: RaySet, room: NDArray[np.float64], launch_in: Launch) -> None:
    totals = []
    for set_of_rays in (rays, sample_rays(0.016, np.random.default_rng(9))):
        segments = launch_in(room, STATION, set_of_rays.directions, max_reflections=2)
        totals.append(fill_path_prior(set_of_rays, segments, ROOM_SPACE, exponent=2.0, refinement=2).total)
    ratio = totals[1] / totals[0]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.01)
    assert np.percentile(np.abs(ratio - 1.0), 90) < 0.15


def test_a_shadow_is_not_covered(rays: RaySet, clutter: NDArray[np.float64], launch_in: Launch) -> None:
    """Voxels whose centres the image method sees from the station are reached without reflections."""
    free = np.ones((40, 50, 30), bool)
    free[5:13, 10:22, :18] = False
    free[24:34, 28:41, 9:11] = False
    space = FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=free)
    station = np.array([3.6, 0.4, 2.6])
    segments = launch_in(clutter, station, rays.directions, max_reflections=2)
    prior = fill_path_prior(rays, segments, space, exponent=2.0, refinement=1)
    solver = ForwardSolver.from_mesh(clutter.reshape(-1, 3), np.arange(108).reshape(-1, 3))
    seen = solver.line_of_sight(station, centres(prior)[free])
    # A voxel is reached when any part of it is seen; half of those at the shadow's edge have a hidden centre.
    assert seen.mean() < prior.coverage[0] < seen.mean() + 0.04
    assert seen.mean() < 0.94
    assert 0.99 < prior.coverage[1] <= prior.coverage[2] <= 1.0
    np.testing.assert_array_equal(prior.total[5:13, 10:22, :18][1:-1, 1:-1, :-1], 0.0)


def test_voxels_that_a_solid_cuts_are_lit_over_their_free_part(rays: RaySet, launch_in: Launch) -> None:
    """A floor slab of 0.5 m in voxels of 0.2 m: the third layer is half free, and as bright as it would be."""
    slab = box((0, 0, 0), (4, 5, 0.5))
    scene = np.concatenate([box((0, 0, 0), (4, 5, 3)), slab])
    free = np.ones((40, 50, 30), bool)
    free[:, :, :5] = False
    space = FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=free)
    station = np.array([2.0, 2.5, 2.5])
    segments = launch_in(scene, station, rays.directions, max_reflections=0)
    prior = fill_path_prior(rays, segments, space, exponent=0.0, refinement=2)
    np.testing.assert_array_equal(prior.total[:, :, :2], 0.0)
    layers = prior.total.mean(axis=(0, 1))[2:]
    # Half of what is traced in the first layer is a voxel and a half at grazing angles: it alone is a bit noisier.
    np.testing.assert_allclose(layers[0], 1.0, rtol=0, atol=0.03)
    np.testing.assert_allclose(layers[1:], 1.0, rtol=0, atol=0.005)
    assert prior.coverage == pytest.approx((1.0,), abs=1e-12)


def test_rays_that_leave_the_map_do_no_harm(rays: RaySet, direct: Segments) -> None:
    """A map of a corner of the room only, whose size is no multiple of the coarser voxel's."""
    corner = FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=np.ones((7, 9, 5), bool))
    prior = fill_path_prior(rays, direct, corner, exponent=0.0, refinement=2)
    assert prior.total.shape == (4, 5, 3)
    # The outer voxels are half outside the map, and count as half free.
    np.testing.assert_allclose(prior.total[:3, :4, :2], 1.0, rtol=0, atol=0.12)
    assert prior.total[3, :4, :2].mean() == pytest.approx(2.0, abs=0.1)


def test_a_wall_weakens_what_is_behind_it(rays: RaySet, launch_in: Launch) -> None:
    """A sheet at x = 2 m that takes 3 dB, and a pillar behind it in which nothing can be."""
    sheet = np.array([[(2, 0, 0), (2, 5, 0), (2, 5, 3)], [(2, 0, 0), (2, 5, 3), (2, 0, 3)]], float)
    scene = np.concatenate([box((0, 0, 0), (4, 5, 3)), sheet])
    walls = opaque_walls(len(scene), loss_db=6.0)
    lets = np.arange(len(scene)) >= 12
    walls = replace(walls, transmission_loss_db=np.where(lets, 3.0, np.inf))
    free = np.ones((40, 50, 30), bool)
    free[30:34, 20:24, :] = False
    space = FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=free)
    segments = launch_in(scene, STATION, rays.directions, max_reflections=0, walls=walls)
    prior = fill_path_prior(rays, segments, space, exponent=1.0, refinement=2)
    ratio = prior.total * distances(prior, STATION) ** 2
    assert ratio[2:10].mean() == pytest.approx(1.0, abs=0.02)
    behind = ratio[10:]
    pillar = np.zeros(prior.total.shape, bool)
    pillar[15:17, 10:12] = True
    np.testing.assert_array_equal(prior.total[pillar], np.inf)
    assert behind[~pillar[10:]].mean() == pytest.approx(10.0**-0.3, rel=0.02)
    assert prior.coverage == (1.0,)
    assert prior.wall_coverage == pytest.approx((0.5 / (1.0 - 0.16 * 3 / 60), 1.0), rel=0.01)
