"""Spread the paths to voxels a little into the voxels next to them.

A voxel's list of paths is as complete as the rays that fill it are dense: where a path reaches only a corner of a
voxel, no ray may have passed. In the hall 6 % of the five strongest paths to a place are not in the list of its voxel,
and four fifths of them are in one next to it.
"""

from typing import Any

import numba
import numpy as np

from rayfix_tables.paths import PathMap

_ASIDE = 0.1
"""Share of the mean over the voxels around in what a voxel is said to be reached by."""


def spread_paths(paths: PathMap) -> PathMap:
    """Return a map whose voxels also have the paths to those around them, reached to a small part.

    Parameters
    ----------
    paths : PathMap
        With gains. Its weights are not spread, and are 0 for what is added.
    """
    offsets, source, lit = _spread(
        paths.offsets, paths.sequence, paths.lit.astype(np.float32), np.array(paths.shape), len(paths.images), _ASIDE
    )
    return paths.rearranged(offsets, source, lit)


@numba.njit(cache=True, nogil=True)
def _spread(offsets: Any, sequence: Any, lit: Any, shape: Any, num_sequences: Any, aside: Any) -> Any:
    """Paths of each voxel and of those around it: CSR offsets, a path that each is a copy of, and its share."""
    num_voxels = len(offsets) - 1
    new_offsets = np.zeros(num_voxels + 1, np.int64)
    size = 2 * len(sequence) + 64
    source, share = np.empty(size, np.int64), np.empty(size, np.float32)
    place = np.full(num_sequences, -1, np.int64)
    total = 0
    for voxel in range(num_voxels):
        begin = total
        own = offsets[voxel + 1] > offsets[voxel]
        x, y, z = voxel // (shape[1] * shape[2]), voxel // shape[2] % shape[1], voxel % shape[2]
        heard = 0
        for i in range(max(x - 1, 0), min(x + 2, shape[0])):
            for j in range(max(y - 1, 0), min(y + 2, shape[1])):
                for k in range(max(z - 1, 0), min(z + 2, shape[2])):
                    other = (i * shape[1] + j) * shape[2] + k
                    heard += offsets[other + 1] > offsets[other]
        around = aside / max(heard - own, 1)
        for i in range(max(x - 1, 0), min(x + 2, shape[0])):
            for j in range(max(y - 1, 0), min(y + 2, shape[1])):
                for k in range(max(z - 1, 0), min(z + 2, shape[2])):
                    other = (i * shape[1] + j) * shape[2] + k
                    part = 1.0 - aside if other == voxel else around
                    for path in range(offsets[other], offsets[other + 1]):
                        at = place[sequence[path]]
                        if at < 0:
                            if total == size:
                                size *= 2
                                source, share = _longer(source, size), _longer(share, size)
                            at = place[sequence[path]] = total
                            share[total] = 0.0
                            source[total] = path
                            total += 1
                        share[at] += part * lit[path]
                        if other == voxel:
                            source[at] = path
        for n in range(begin, total):
            place[sequence[source[n]]] = -1
        new_offsets[voxel + 1] = total
    return new_offsets, source[:total].copy(), share[:total].copy()


@numba.njit(cache=True, nogil=True)
def _longer(array: Any, size: Any) -> Any:
    longer = np.empty(size, array.dtype)
    longer[: len(array)] = array
    return longer
