"""Blocks of the free space: some hundred large ones, and each size halved, down to the voxels of the path map."""

from functools import cached_property
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_tables.freespace import FreeSpace
from rayfix_tables.paths import PathMap

_MOST_TOP_BLOCKS = 400
"""Blocks are doubled in size until no more than this many have free space."""


_LEAST_WEIGHT = 0.003
"""Lighter paths to large blocks, relative to the heaviest one, are left out: large blocks only tell where to look."""


class Blocks(NamedTuple):
    """Blocks of one size.

    Attributes
    ----------
    size : float, m
    shape : tuple of 3 ints
    volume : ndarray of shape (n_blocks,), m3
        Of the free part.
    centre : ndarray of shape (n_blocks, 3), m
        Of the free part.
    """

    size: float
    shape: tuple[int, ...]
    volume: NDArray[np.float64]
    centre: NDArray[np.float64]


class BlockTree:
    """All sizes of blocks of a free space, smallest first.

    Parameters
    ----------
    free_space : FreeSpace
    refinement : int
        Width of a smallest block in voxels of the free space.
    """

    def __init__(self, free_space: FreeSpace, refinement: int) -> None:
        self.free_space = free_space
        self.levels = [_smallest(free_space, refinement)]
        while np.count_nonzero(self.levels[-1].volume) > _MOST_TOP_BLOCKS:
            self.levels.append(_doubled(self.levels[-1]))

    @cached_property
    def top(self) -> NDArray[np.int64]:
        """Largest blocks with free space, as indices in C order."""
        return np.flatnonzero(self.levels[-1].volume)


def _smallest(free_space: FreeSpace, refinement: int) -> Blocks:
    shape = tuple((-(-np.array(free_space.free.shape) // refinement)).tolist())
    voxels = np.argwhere(free_space.free)
    i, j, k = (voxels // refinement).T
    block = (i * shape[1] + j) * shape[2] + k
    count = np.asarray(np.bincount(block, minlength=int(np.prod(shape))), np.float64)
    at = free_space.origin + free_space.voxel_size * (voxels + 0.5)
    sums = np.stack([np.bincount(block, at[:, axis], len(count)) for axis in range(3)], axis=1)
    return Blocks(
        size=free_space.voxel_size * refinement,
        shape=shape,
        volume=count * free_space.voxel_size**3,
        centre=sums / np.maximum(count, 1.0)[:, None],
    )


def _doubled(finer: Blocks) -> Blocks:
    shape = tuple((-(-np.array(finer.shape) // 2)).tolist())
    i, j, k = np.unravel_index(np.arange(len(finer.volume)), finer.shape)
    block = (i // 2 * shape[1] + j // 2) * shape[2] + k // 2
    volume = np.asarray(np.bincount(block, finer.volume, int(np.prod(shape))), np.float64)
    moments = [np.bincount(block, finer.volume * finer.centre[:, axis], len(volume)) for axis in range(3)]
    return Blocks(
        size=2.0 * finer.size,
        shape=shape,
        volume=volume,
        centre=np.stack(moments, axis=1) / np.where(volume > 0.0, volume, 1.0)[:, None],
    )


class BlockPaths(NamedTuple):
    """Paths from a station to blocks of one size: CSR by block, heaviest first.

    Attributes
    ----------
    offsets : ndarray of int64, shape (n_blocks + 1,)
    sequence : ndarray of int32 or uint16, shape (n_paths,)
    weight : ndarray of float32, shape (n_paths,)
        Mean over the block's free part.
    excess : ndarray of float32, shape (n_paths,) or (0,), m
        What the walls passed add to the length; empty where none is.
    num_walls : ndarray of int8, shape (n_paths,) or (0,)
    """

    offsets: NDArray[np.int64]
    sequence: NDArray[np.int32] | NDArray[np.uint16]
    weight: NDArray[np.float32]
    excess: NDArray[np.float32]
    num_walls: NDArray[np.int8]


class StationPaths:
    """Paths from one station to blocks of all sizes.

    Parameters
    ----------
    paths : PathMap
    tree : BlockTree
        Of the same free space.
    of_voxels : BlockPaths, optional
        Paths to the voxels of the map with other weights than it has.
    """

    def __init__(self, paths: PathMap, tree: BlockTree, of_voxels: BlockPaths | None = None) -> None:
        self.images, self.mirrors = _read_only(paths.images), _read_only(paths.mirrors)
        self.num_reflections = _read_only(paths.num_reflections)
        if of_voxels is None:
            of_voxels = BlockPaths(paths.offsets, paths.sequence, paths.weight_of_1, paths.excess, paths.num_walls)
        self.levels = [_only_read(of_voxels)]
        for finer, coarser in zip(tree.levels, tree.levels[1:], strict=False):
            joined = _joined(*self.levels[-1], np.array(finer.shape), finer.volume, np.array(coarser.shape))
            self.levels.append(_only_read(BlockPaths(*joined)))


def _only_read(paths: BlockPaths) -> BlockPaths:
    return BlockPaths(*(_read_only(array) for array in paths))


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """View of an array that cannot be written to, as those of a table are: kernels are compiled for one kind only."""
    view = array.view()
    view.flags.writeable = False
    return view


@numba.njit(cache=True, nogil=True)
def _joined(
    offsets: Any,
    sequence: Any,
    weight: Any,
    excess: Any,
    num_walls: Any,
    shape: Any,
    volume: Any,
    coarser: Any,
) -> Any:
    """Paths to blocks of twice the size, their weights averaged over the free volume, the rest over the weights."""
    num_blocks = coarser[0] * coarser[1] * coarser[2]
    passes = len(excess) > 0
    new_offsets = np.zeros(num_blocks + 1, np.int64)
    new_sequence, sums = np.empty(len(sequence), sequence.dtype), np.zeros((len(sequence), 3))
    total = 0
    for block in range(num_blocks):
        i, j, k = block // (coarser[1] * coarser[2]), block // coarser[2] % coarser[1], block % coarser[2]
        begin, free = total, 0.0
        for x in range(2 * i, min(2 * i + 2, shape[0])):
            for y in range(2 * j, min(2 * j + 2, shape[1])):
                for z in range(2 * k, min(2 * k + 2, shape[2])):
                    child = (x * shape[1] + y) * shape[2] + z
                    free += volume[child]
                    for n in range(offsets[child], offsets[child + 1]):
                        at = begin
                        while at < total and new_sequence[at] != sequence[n]:
                            at += 1
                        if at == total:
                            new_sequence[at] = sequence[n]
                            sums[at] = 0.0
                            total += 1
                        held = volume[child] * weight[n]
                        sums[at, 0] += held
                        if passes:
                            sums[at, 1] += held * excess[n]
                            sums[at, 2] += held * num_walls[n]
        if free > 0.0:
            order = np.argsort(-sums[begin:total, 0])
            # Loops, since numba compiles a message with shapes for the assignment of an array to a slice.
            found, their_sums = new_sequence[begin:total].copy(), sums[begin:total].copy()
            for n in range(total - begin):
                new_sequence[begin + n] = found[order[n]]
                for column in range(3):
                    sums[begin + n, column] = their_sums[order[n], column]
            while total > begin and sums[total - 1, 0] < _LEAST_WEIGHT * sums[begin, 0]:
                total -= 1
            for n in range(begin, total):
                if sums[n, 0] > 0.0:
                    sums[n, 1:] /= sums[n, 0]
                sums[n, 0] /= free
        else:
            total = begin
        new_offsets[block + 1] = total
    kept = total if passes else 0
    return (
        new_offsets,
        new_sequence[:total].copy(),
        sums[:total, 0].astype(np.float32),
        sums[:kept, 1].astype(np.float32),
        np.rint(sums[:kept, 2]).astype(np.int8),
    )
