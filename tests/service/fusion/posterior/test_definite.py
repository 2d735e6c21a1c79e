"""A Gaussian whose covariance is not positive definite takes no part in a fix; it got the factor of the one before."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.fusion.posterior.credible import _squared_distances
from rayfix_service.fusion.posterior.cut_by_walls import cut_to_free_space
from rayfix_service.fusion.posterior.modes import find_modes
from rayfix_service.fusion.posterior.points import draw_points
from rayfix_service.fusion.posterior.posterior import free_shares
from rayfix_service.fusion.posterior.voxels import nearest_free
from rayfix_service.fusion.stopping import NEVER
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.normal_points import normal_points, unit_points

Array = NDArray[np.float64]

HALL = FreeSpace(origin=np.zeros(3), voxel_size=0.5, free=np.ones((20, 20, 20), bool))
SPACE = (HALL.origin, HALL.voxel_size, HALL.free)
MEAN = np.array([[3.0, 3.0, 3.0], [7.0, 7.0, 7.0], [9.9, 5.0, 5.0]])
WEIGHT = np.array([0.3, 0.5, 0.2])
BROKEN = {"indefinite": np.diag([0.04, -0.04, 0.04]), "singular": np.zeros((3, 3)), "nan": np.full((3, 3), np.nan)}


@pytest.fixture(params=sorted(BROKEN))
def mixture(request: pytest.FixtureRequest) -> tuple[Array, Array, Array]:
    """Three Gaussians in a hall; the one in the middle of the list has no covariance."""
    cov = np.tile(0.04 * np.eye(3), (3, 1, 1))
    cov[1] = BROKEN[request.param]
    return np.log(WEIGHT), MEAN, cov


def without_the_second(mixture: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    log_weight, mean, cov = (array[[0, 2]] for array in mixture)
    return log_weight, mean, cov


def test_it_loses_its_weight_when_it_is_cut(mixture: tuple[Array, Array, Array]) -> None:
    log_weight, mean, cov = cut_to_free_space(*mixture, unit_points(), *SPACE)
    expected = cut_to_free_space(*without_the_second(mixture), unit_points(), *SPACE)
    assert log_weight[1] == -np.inf
    for found, others in zip((log_weight, mean, cov), expected, strict=True):
        np.testing.assert_array_equal(found[[0, 2]], others)


def test_it_is_in_no_mode(mixture: tuple[Array, Array, Array]) -> None:
    probability, position, moment, member = find_modes(*mixture, *SPACE, NEVER.cell)
    its_probability, its_position, its_moment, its_member = find_modes(*without_the_second(mixture), *SPACE, NEVER.cell)
    np.testing.assert_array_equal(probability, its_probability)
    np.testing.assert_array_equal(position, its_position)
    np.testing.assert_array_equal(moment, its_moment)
    np.testing.assert_array_equal(member[[0, 2]], its_member)


def test_no_point_is_drawn_from_it(mixture: tuple[Array, Array, Array]) -> None:
    mean, root, owner = draw_points(*mixture, normal_points(1024), *SPACE)
    np.testing.assert_array_equal(mean, MEAN[[0, 2]])
    assert np.isfinite(root).all()
    assert owner.max() == 1


def test_it_has_no_free_share(mixture: tuple[Array, Array, Array]) -> None:
    _, mean, cov = mixture
    shares = free_shares(mean, cov, HALL)
    assert shares[1] == 0.0
    assert np.all(shares[[0, 2]] > 0.3)


@pytest.mark.parametrize("kind", sorted(BROKEN))
def test_nothing_is_near_by_it(kind: str) -> None:
    position = np.array([-1.0, 5.0, 5.0])
    assert not nearest_free(position, BROKEN[kind], *SPACE)
    np.testing.assert_array_equal(position, [-1.0, 5.0, 5.0])


@pytest.mark.parametrize("kind", sorted(BROKEN))
def test_no_ellipsoid_of_its_shape_reaches_a_point(kind: str) -> None:
    assert np.all(np.isinf(_squared_distances(np.ones((3, 4)), BROKEN[kind])))


@pytest.mark.parametrize("kind", sorted(BROKEN))
def test_points_of_it_alone_are_its_mean(kind: str) -> None:
    mean, root, _ = draw_points(np.zeros(1), MEAN[:1], BROKEN[kind][None], normal_points(64), *SPACE)
    np.testing.assert_array_equal(mean, MEAN[:1])
    np.testing.assert_array_equal(root, 0.0)
