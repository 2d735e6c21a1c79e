"""Integrate the posterior over the free space by blocks, which are halved where it is large and not yet resolved."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.product.prior import Prior
from rayfix_service.fusion.quadrature.blocks import BlockPaths, BlockTree, StationPaths
from rayfix_service.fusion.quadrature.factor import PathFactor, evaluate, expected_directions
from rayfix_service.fusion.quadrature.layers import Layers, layers_of
from rayfix_service.fusion.quadrature.sets import NO_SETS, PathSets
from rayfix_service.fusion.stopping import NEVER, Stop

_OCTANTS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])

_TOGETHER = 0.3
"""Part of all measured paths that tell of the same direction; with a fifth, one posterior in ten was partly lost."""

Array = NDArray[np.float64]


class GridLimits(NamedTuple):
    """How finely the posterior is integrated.

    Attributes
    ----------
    least_share : float
        Blocks that hold a smaller fraction of the posterior are not halved.
    resolution : float
        A block is small enough when the variance of a position in it times the information there is below this.
    most_halvings : int
        Of the path map's voxels.
    most_leaves : int
        Halving ends when there would be more blocks than this.
    """

    least_share: float = 5e-4
    resolution: float = 0.12
    most_halvings: int = 4
    most_leaves: int = 50_000


class Leaves(NamedTuple):
    """Blocks that the posterior is a sum of.

    Attributes
    ----------
    point : ndarray of shape (n, 3), m
        Where the posterior was evaluated.
    halvings : ndarray of int64, shape (n,)
        Of the path map's voxels; negative for larger blocks.
    cell : ndarray of int64, shape (n, 3)
        Coordinates of the block among those of its size.
    width, height : ndarray of shape (n,), m
        Of the block; with a known height, of the layer of it that matters.
    log_mass : ndarray of shape (n,)
        Natural logarithm of the integral of prior times likelihood over the block.
    log_volume : ndarray of shape (n,), m3
        Of the block's free part.
    late, lost : ndarray of shape (n, n_factors + n_measured)
        Probability that a factor's times are outliers and its angle is not, and that all of it is or that its path is
        none of the map's; for the measured paths of sets, after the factors, that they are spurious.
    untold : ndarray of shape (n,)
        Probability that all factors are outliers and all measured paths spurious: nothing tells of the position.
    """

    point: Array
    halvings: NDArray[np.int64]
    cell: NDArray[np.int64]
    width: Array
    height: Array
    log_mass: Array
    log_volume: Array
    late: Array
    lost: Array
    untold: Array


class _Front(NamedTuple):
    """Blocks of one size that are to be evaluated; ``block`` is that of the paths to them."""

    cell: NDArray[np.int64]
    block: NDArray[np.int64]
    point: Array
    volume: Array


def integrate(
    tree: BlockTree,
    stations: Sequence[StationPaths],
    factors: Sequence[PathFactor],
    prior: Prior,
    limits: GridLimits,
    stop: Stop = NEVER,
    sets: PathSets = NO_SETS,
) -> tuple[Leaves, bool]:
    """Integrate the posterior of factors.

    Parameters
    ----------
    tree : BlockTree
    stations : sequence of StationPaths
        Of each factor in turn.
    factors : sequence of PathFactor
    prior : Prior
        In the frame of the tree.
    limits : GridLimits
    stop : Stop
        Ends it early.
    sets : PathSets
        Measured paths of stations that report several.

    Returns
    -------
    leaves : Leaves
    omitted : bool
        Whether blocks are larger than they should be, since there would be too many.

    Raises
    ------
    FixStoppedError
        When it was stopped.
    """
    geometries = [
        (each.images, each.mirrors, each.num_reflections, expected_directions(each.mirrors, _measured(factor)))
        for each, factor in zip(stations, factors, strict=True)
    ]
    # Several stations tell of a direction together; half of them, since each tells of two out of three.
    resolution = limits.resolution / max(1.0, 0.5 * (len(factors) + len(sets)))
    together = max(1.0, _TOGETHER * len(sets))
    log_all_outlier = sum(math.log(factor.outlier) for factor in factors) + sets.log_all_spurious
    halvings = 1 - len(tree.levels)
    front = _largest(tree)
    batches: list[_Batch] = []
    num_leaves, limited = 0, False
    while True:
        stop.check()
        width = tree.levels[0].size * 0.5**halvings
        front, layers = _in_layers(front, prior, tree, width)

        def at(points: Array, front: _Front = front, width: float = width, halvings: int = halvings) -> _Evaluated:
            level = max(-halvings, 0)
            levels = [station.levels[level] for station in stations]
            found = _evaluated(points, front.block, width**2 / 12.0, resolution, levels, geometries, factors, stop)
            return (
                _with_sets(found, sets, points, front.block, width**2 / 12.0, resolution, together, level)
                if sets
                else found
            )

        log_volume = np.log(front.volume)
        if layers.keep is None:
            point, height, found = front.point, layers.height, at(front.point)
        else:
            point, height, found = _at_two_heights(front.point, layers.height, at)
        log_mass = log_volume + layers.log_density + found.log_likelihood
        coarse = width**2 / 12.0 * found.information > limits.resolution
        if halvings >= limits.most_halvings:
            limited, coarse = limited or _matter(log_mass, coarse, batches, limits), np.zeros_like(coarse)
        batches.append(
            _Batch(halvings, width, front, point, height, log_volume, log_mass, coarse, found, _log_sum(log_mass))
        )
        num_leaves += len(front.block)
        # Halving a block changes what the posterior is thought to be, so that others may matter that did not before.
        least = _log_sum(np.array([batch.log_total for batch in batches])) + math.log(limits.least_share)
        which = [batch.coarse & (batch.log_mass > least) for batch in batches]
        waiting = [batch.halvings for batch, some in zip(batches, which, strict=True) if some.any()]
        if not waiting:
            break
        halvings = min(waiting)
        chosen = [n for n, batch in enumerate(batches) if batch.halvings == halvings and which[n].any()]
        count = sum(int(np.count_nonzero(which[n])) for n in chosen)
        if num_leaves + 7 * count > limits.most_leaves:
            limited = True
            break
        front = _joined([_halved(tree, batches[n].front, which[n], halvings) for n in chosen])
        for n in chosen:
            batches[n] = batches[n].without(which[n])
        num_leaves -= count
        halvings += 1
    return _leaves(batches, log_all_outlier), limited


def _matter(log_mass: Array, coarse: NDArray[np.bool_], batches: Sequence["_Batch"], limits: GridLimits) -> bool:
    """Whether blocks that are not halved any more, though they are coarse, hold a share that matters."""
    log_all = _log_sum(np.array([_log_sum(log_mass), *(batch.log_total for batch in batches)]))
    return bool(np.any(coarse & (log_mass - log_all > math.log(limits.least_share))))


def _log_sum(log_mass: Array) -> float:
    """Natural logarithm of a sum, whose terms are given by theirs."""
    most = float(log_mass.max(initial=-math.inf))
    return most + math.log(float(np.exp(log_mass - most).sum())) if most > -math.inf else most


class _Batch(NamedTuple):
    """Blocks of one size that were evaluated together.

    ``coarse`` are those that may be halved, ``log_total`` is the natural logarithm of what they hold together.
    """

    halvings: int
    width: float
    front: _Front
    point: Array
    height: Array
    log_volume: Array
    log_mass: Array
    coarse: NDArray[np.bool_]
    found: "_Evaluated"
    log_total: float

    def without(self, which: NDArray[np.bool_]) -> "_Batch":
        """Leave some blocks out."""
        keep = ~which
        found = self.found
        return _Batch(
            self.halvings,
            self.width,
            _Front(self.front.cell[keep], self.front.block[keep], self.front.point[keep], self.front.volume[keep]),
            self.point[keep],
            self.height[keep],
            self.log_volume[keep],
            self.log_mass[keep],
            self.coarse[keep],
            _Evaluated(found.log_likelihood[keep], found.information[keep], found.late[:, keep], found.lost[:, keep]),
            _log_sum(self.log_mass[keep]),
        )


def _joined(fronts: Sequence[_Front]) -> _Front:
    if len(fronts) == 1:
        return fronts[0]
    return _Front(*(np.concatenate(each) for each in zip(*fronts, strict=True)))


def _leaves(batches: Sequence[_Batch], log_all_outlier: float) -> Leaves:
    """Blocks that are left of all batches."""
    found = [batch.found for batch in batches]
    log_likelihood = np.concatenate([each.log_likelihood for each in found])
    counts = [len(batch.log_mass) for batch in batches]
    return Leaves(
        point=np.concatenate([batch.point for batch in batches]),
        halvings=np.repeat([batch.halvings for batch in batches], counts),
        cell=np.concatenate([batch.front.cell for batch in batches]),
        width=np.repeat([batch.width for batch in batches], counts),
        height=np.concatenate([batch.height for batch in batches]),
        log_mass=np.concatenate([batch.log_mass for batch in batches]),
        log_volume=np.concatenate([batch.log_volume for batch in batches]),
        late=np.concatenate([each.late.T for each in found]),
        lost=np.concatenate([each.lost.T for each in found]),
        untold=np.minimum(np.exp(log_all_outlier - log_likelihood), 1.0),
    )


class _Evaluated(NamedTuple):
    """The likelihood at some points; the last two have the shape (n_factors, n)."""

    log_likelihood: Array
    information: Array
    late: Array
    lost: Array


def _evaluated(
    points: Array,
    blocks: NDArray[np.int64],
    spread: float,
    resolution: float,
    levels: Sequence[BlockPaths],
    geometries: Sequence[tuple[NDArray[Any], ...]],
    factors: Sequence[PathFactor],
    stop: Stop,
) -> _Evaluated:
    """Evaluate all factors at points, unless it is stopped."""
    count = len(points)
    found = _Evaluated(np.zeros(count), np.zeros(count), *np.empty((2, len(factors), count)))
    density, told = np.empty(count), np.empty(count)
    for n, (paths, geometry, factor) in enumerate(zip(levels, geometries, factors, strict=True)):
        stop.check()
        out = density, found.late[n], found.lost[n], told
        evaluate(points, blocks, spread, resolution, tuple(paths), geometry, tuple(factor), out)
        np.add(found.log_likelihood, np.log(density), out=found.log_likelihood)
        np.add(found.information, told, out=found.information)
    return found


def _with_sets(
    found: _Evaluated,
    sets: PathSets,
    points: Array,
    blocks: NDArray[np.int64],
    spread: float,
    resolution: float,
    together: float,
    level: int,
) -> _Evaluated:
    """Multiply by the likelihood of measured paths."""
    lost = sets.evaluate(points, blocks, spread, resolution, together, level, found.log_likelihood, found.information)
    return found._replace(
        late=np.concatenate([found.late, np.zeros_like(lost)]), lost=np.concatenate([found.lost, lost])
    )


def _at_two_heights(point: Array, height: Array, at: Callable[[Array], _Evaluated]) -> tuple[Array, Array, _Evaluated]:
    """Integrate over the heights of thin layers, by the rule of Gauss with two nodes: the mean and one deviation off.

    Returns
    -------
    point : ndarray of shape (n, 3), m
        At the posterior's mean height in the layer.
    height : ndarray of shape (n,), m
        Of a layer in which a uniform height varies as much as the posterior's.
    found : _Evaluated
        Means over the heights.
    """
    step = np.zeros_like(point)
    step[:, 2] = height / math.sqrt(12.0)
    low, high = at(point - step), at(point + step)
    lean = np.tanh(0.5 * (high.log_likelihood - low.log_likelihood))
    of_low, of_high = 0.5 * (1.0 - lean), 0.5 * (1.0 + lean)
    found = _Evaluated(
        np.logaddexp(low.log_likelihood, high.log_likelihood) - math.log(2.0),
        *(of_low * below + of_high * above for below, above in zip(low[1:], high[1:], strict=True)),
    )
    return point + lean[:, None] * step, height * np.sqrt(np.maximum(1.0 - lean**2, 1e-4)), found


def _measured(factor: PathFactor) -> Array:
    """Measured direction in the scene; NaN where there is none."""
    return np.asarray(factor.turn.T @ np.array([math.sin(factor.zenith), 0.0, math.cos(factor.zenith)]))


def _largest(tree: BlockTree) -> _Front:
    blocks, top = tree.levels[-1], tree.top
    cell = np.stack(np.unravel_index(top, blocks.shape), axis=1)
    return _Front(cell, top, blocks.centre[top], blocks.volume[top])


def _halved(tree: BlockTree, front: _Front, which: NDArray[np.bool_], halvings: int) -> _Front:
    """Eight halves of each block, those without free space left out."""
    cell = (2 * front.cell[which][:, None, :] + _OCTANTS).reshape(-1, 3)
    if halvings < 0:
        blocks = tree.levels[-halvings - 1]
        cell = cell[np.all(cell < blocks.shape, axis=1)]
        block = (cell[:, 0] * blocks.shape[1] + cell[:, 1]) * blocks.shape[2] + cell[:, 2]
        free = blocks.volume[block] > 0.0
        block = block[free]
        return _Front(cell[free], block, blocks.centre[block], blocks.volume[block])
    width = tree.levels[0].size * 0.5 ** (halvings + 1)
    point = tree.free_space.origin + width * (cell + 0.5)
    free = tree.free_space.contains(point)
    block = np.repeat(front.block[which], 8)[free]
    return _Front(cell[free], block, point[free], np.full(len(block), width**3))


def _in_layers(front: _Front, prior: Prior, tree: BlockTree, width: float) -> tuple[_Front, Layers]:
    """Move the points of blocks to where the prior is in their layer, and leave out layers where it is not."""
    layers = layers_of(prior, front.cell[:, 2], float(tree.free_space.origin[2]), width)
    if layers.keep is None:
        return front, layers
    point = front.point[layers.keep]
    point[:, 2] = layers.middle
    return _Front(front.cell[layers.keep], front.block[layers.keep], point, front.volume[layers.keep]), layers
