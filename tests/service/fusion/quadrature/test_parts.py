"""The parts of the quadrature: layers, blocks, modes."""

import numpy as np
import pytest
from scipy import stats

from rayfix_service.fusion.measurements.report import Height
from rayfix_service.fusion.product.prior import height_prior, uniform_prior
from rayfix_service.fusion.quadrature.blocks import BlockTree, StationPaths
from rayfix_service.fusion.quadrature.layers import layers_of
from rayfix_service.fusion.quadrature.modes import modes_of_blocks
from tests.support.tables.open_room import POSITIONS, direct_paths, room_space
from tests.support.tables.random_tables import random_paths

VALLEY = float(np.log(2.0))


@pytest.mark.parametrize("stdev", [0.02, 0.3, 2.0])
def test_layers_of_a_known_height(stdev: float) -> None:
    """Mass, mean and variance of a cut normal, by SciPy; the mean density over the room is its inverse volume."""
    space = room_space()
    prior = height_prior(Height(z=1.17, stdev=stdev), space)
    thickness = 0.4
    layer = np.arange(8)
    found = layers_of(prior, layer, 0.0, thickness)
    assert found.keep is not None
    lows = thickness * layer[found.keep]
    normal = stats.norm(1.17, stdev)
    mass = normal.cdf(lows + thickness) - normal.cdf(lows)
    of_room = normal.cdf(3.0) - normal.cdf(0.0)
    exact = mass > 1e-12
    density = mass / of_room / (36.0 * thickness)
    np.testing.assert_allclose(np.exp(found.log_density)[exact], density[exact], rtol=1e-6)
    for n in np.flatnonzero(mass > 1e-9):
        cut = stats.truncnorm((lows[n] - 1.17) / stdev, (lows[n] + thickness - 1.17) / stdev, 1.17, stdev)
        assert found.middle[n] == pytest.approx(cut.mean(), abs=1e-6)
        assert found.height[n] == pytest.approx(np.sqrt(12.0 * max(cut.var(), (0.01 * thickness) ** 2)), rel=1e-3)
    assert layer[~found.keep].tolist() == [n for n in layer if abs(thickness * (n + 0.5) - 1.17) > 6.5 * stdev + 0.2]


def test_layers_of_no_known_height_are_uniform() -> None:
    prior = uniform_prior(room_space())
    found = layers_of(prior, np.arange(4), 0.0, 0.4)
    assert found.keep is None
    np.testing.assert_allclose(np.exp(found.log_density), 1.0 / 108.0, rtol=1e-12)


def test_blocks_hold_the_free_space() -> None:
    """Volumes of each size add up to that of the room, and centres are those of the free part."""
    rng = np.random.default_rng(1)
    space = room_space(rng.random((60, 60, 30)) < 0.7)
    tree = BlockTree(space, 2)
    assert len(tree.levels) > 2
    for blocks in tree.levels:
        assert blocks.volume.sum() == pytest.approx(space.volume, rel=1e-12)
        middle = (blocks.volume[:, None] * blocks.centre).sum(axis=0) / blocks.volume.sum()
        voxels = space.origin + space.voxel_size * (np.argwhere(space.free) + 0.5)
        np.testing.assert_allclose(middle, voxels.mean(axis=0), rtol=1e-12)
    assert tree.levels[-1].size == pytest.approx(0.2 * 2 ** (len(tree.levels) - 1))


def test_paths_of_larger_blocks_are_means() -> None:
    """Weights are averaged over the free volume, against a dictionary for each block."""
    rng = np.random.default_rng(2)
    space = room_space(rng.random((60, 60, 30)) < 0.7)
    paths, tree = random_paths(rng, space), BlockTree(space, 2)
    finer, coarser = tree.levels[0], tree.levels[1]
    found = StationPaths(paths, tree).levels[1]
    for block in rng.choice(np.flatnonzero(coarser.volume), 40, replace=False):
        cell = np.array(np.unravel_index(block, coarser.shape))
        sums: dict[int, float] = {}
        free = 0.0
        for octant in np.ndindex(2, 2, 2):
            at = 2 * cell + octant
            if np.any(at >= finer.shape):
                continue
            child = int(np.ravel_multi_index(tuple(at), finer.shape))
            free += finer.volume[child]
            for n in range(paths.offsets[child], paths.offsets[child + 1]):
                sequence = int(paths.sequence[n])
                sums[sequence] = sums.get(sequence, 0.0) + finer.volume[child] * float(paths.weight[n])
        own = slice(found.offsets[block], found.offsets[block + 1])
        weights = dict(zip(found.sequence[own].tolist(), found.weight[own].tolist(), strict=True))
        for sequence, weight in weights.items():
            assert weight == pytest.approx(sums[sequence] / free, rel=1e-5)
        left_out = [value / free for sequence, value in sums.items() if sequence not in weights]
        assert max(left_out, default=0.0) < 0.004 * max(weights.values(), default=1.0)
        assert np.all(np.diff(found.weight[own]) <= 0.0)


def hills(apart: float, *, wall: bool = False) -> int:
    """Count the modes of two equal hills of deviation 1 on a plane of blocks of 0.5."""
    cells = np.array([[i, j, 0] for i in range(40) for j in range(20)])
    if wall:
        cells = cells[cells[:, 0] != 19]
    x, y = 0.5 * cells[:, 0] - 10.0, 0.5 * cells[:, 1] - 5.0
    log = np.logaddexp(-0.5 * (x - 0.5 * apart) ** 2, -0.5 * (x + 0.5 * apart) ** 2) - 0.5 * y**2
    return len(set(modes_of_blocks(np.zeros(len(cells), np.int64), cells, log, VALLEY).tolist()))


def test_two_hills_are_two_modes_when_the_density_halves_between_them() -> None:
    """Two equal normals: their sum falls to half of its peak between them at 3.3 deviations."""
    assert [hills(apart) for apart in (0.0, 2.0, 3.0, 3.8, 6.0)] == [1, 1, 1, 2, 2]


def test_a_thin_wall_divides_no_hill() -> None:
    assert hills(0.0, wall=True) == 1
    assert hills(6.0, wall=True) == 2


def test_modes_of_blocks_of_different_sizes() -> None:
    """One half of a hill is divided more finely than the other."""
    large = np.array([[i, j, 0] for i in range(4) for j in range(8)])
    small = np.array([[i, j, k] for i in range(8, 16) for j in range(16) for k in range(2)])
    cells = np.concatenate([large, small])
    halvings = np.repeat([0, 1], [len(large), len(small)])
    centres = (cells + 0.5) * np.where(halvings == 0, 1.0, 0.5)[:, None]
    log = -0.5 * ((centres[:, 0] - 4.0) ** 2 + (centres[:, 1] - 4.0) ** 2) / 2.0
    assert len(set(modes_of_blocks(halvings, cells, log, VALLEY).tolist())) == 1


def test_the_room_is_seen_from_everywhere() -> None:
    space = room_space()
    paths = StationPaths(direct_paths(POSITIONS["a"], space), BlockTree(space, 2))
    for level in paths.levels:
        np.testing.assert_allclose(level.weight, 1.0, rtol=1e-6)
