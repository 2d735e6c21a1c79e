"""Maxima of a mixture that are of one mode, and those that are not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.fusion.posterior.modes import find_modes
from rayfix_service.fusion.posterior.saddles import unite_maxima
from rayfix_service.fusion.stopping import NEVER
from rayfix_tables.freespace import FreeSpace

Array = NDArray[np.float64]

ANYWHERE = FreeSpace(origin=np.full(3, -50.0), voxel_size=10.0, free=np.ones((10, 10, 10), np.bool_))

DEPTH = float(np.log(2.0))


def unit_gaussians(x: list[float], weight: list[float] | None = None) -> tuple[Array, Array, Array]:
    """Log density at the mean, means and precisions of Gaussians of unit covariance on a line."""
    mean = np.zeros((len(x), 3))
    mean[:, 0] = x
    return np.log(weight or [1.0] * len(x)), mean, np.tile(np.eye(3), (len(x), 1, 1))


def united(x: list[float], weight: list[float] | None = None, reach: float = 64.0) -> list[int]:
    mixture = unit_gaussians(x, weight)
    return [int(n) for n in unite_maxima(*mixture, mixture[1], mixture[2], DEPTH, reach, NEVER.cell)]


def number_of_modes(x: list[float]) -> int:
    _, mean, cov = unit_gaussians(x)
    space = ANYWHERE.origin, ANYWHERE.voxel_size, ANYWHERE.free
    return len(find_modes(np.full(len(x), -np.log(len(x))), mean, cov, *space, NEVER.cell)[0])


def test_two_equal_gaussians_are_two_modes_where_the_density_between_them_halves() -> None:
    """At a distance d the middle is 2 exp(-d^2 / 8) of a peak: half of it at d = sqrt(8 log 4) = 3.33."""
    limit = np.sqrt(8.0 * np.log(4.0))
    assert united([0.0, limit - 0.02]) == [0, 0]
    assert united([0.0, limit + 0.02]) == [0, 1]
    assert number_of_modes([0.0, limit - 0.1]) == 1
    assert number_of_modes([0.0, limit + 0.1]) == 2


def test_the_lower_of_two_maxima_counts() -> None:
    """A foothill of a tenth of the weight: the density beside the peak falls far, but hardly below the foothill."""
    assert united([0.0, 3.0], [0.9, 0.1]) == [0, 0]
    assert united([0.0, 5.0], [0.9, 0.1]) == [0, 1]


def test_a_row_of_ripples_is_one_mode_from_end_to_end() -> None:
    """Neighbours are connected, so all are, though between the ends no straight line need be looked at."""
    row = [3.0 * n for n in range(8)]
    assert united(row) == [0] * 8
    assert united(row, reach=10.0) == [0] * 8
    assert number_of_modes(row) == 1


def test_two_positions_stay_two() -> None:
    assert united([0.0, 3.0, 9.0, 12.0]) == [0, 0, 2, 2]
    assert number_of_modes([0.0, 3.0, 9.0, 12.0]) == 2


def test_maxima_out_of_reach_are_not_compared() -> None:
    assert united([0.0, 3.0], reach=8.0) == [0, 1]


@pytest.mark.parametrize("seed", range(5))
def test_modes_are_united_as_a_fine_line_says(seed: int) -> None:
    """Two maxima, and the least density of 1,000 points between them."""
    rng = np.random.default_rng(seed)
    mean = np.array([[0.0, 0.0, 0.0], rng.uniform(1.5, 3.5, 3)])
    root = rng.standard_normal((2, 3, 3)) + 2.0 * np.eye(3)
    precision = np.linalg.inv(root @ root.transpose(0, 2, 1))
    log_peak = np.log(rng.uniform(0.3, 1.0, 2))
    line = mean[0] + np.linspace(0.0, 1.0, 1000)[:, None] * (mean[1] - mean[0])
    apart = line[:, None] - mean
    logs = np.logaddexp.reduce(log_peak - 0.5 * np.einsum("nhi,hij,nhj->nh", apart, precision, apart), axis=1)
    fall = float(min(logs[0], logs[-1]) - logs.min())
    for depth in (fall - 0.05, fall + 0.05):
        first = unite_maxima(log_peak, mean, precision, mean, precision, depth, np.inf, NEVER.cell)
        assert (first[1] == 0) == (depth > fall)
