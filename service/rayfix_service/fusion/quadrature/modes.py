"""The modes of a posterior on blocks, and the blocks that belong to each.

Blocks are taken from the densest on; each joins the mode of its densest neighbour, and modes that meet are one unless
the density has fallen to less than half of the lower one's peak there (ToMATo: F. Chazal, L. J. Guibas, S. Y. Oudot,
P. Skraba, "Persistence-based clustering in Riemannian manifolds", J. ACM 60 (6), 2013).
"""

from typing import Any

import numba
import numpy as np

_STEPS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
_BITS = 19
"""Of each coordinate in a key."""

_MOST_NEIGHBOURS = 12
"""Of its own size or larger that a block has: behind each face one, or one beyond a thin wall."""


@numba.njit(cache=True, nogil=True)
def modes_of_blocks(halvings: Any, cell: Any, log_density: Any, valley: Any) -> Any:
    """Find the mode that each block belongs to.

    Parameters
    ----------
    halvings : ndarray of int64, shape (n,)
    cell : ndarray of int64, shape (n, 3)
        Coordinates of a block among those of its size.
    log_density : ndarray of shape (n,)
    valley : float, nats
        Modes are one where the density between them falls by less.

    Returns
    -------
    ndarray of int64, shape (n,)
        Densest block of the mode.
    """
    count = len(halvings)
    neighbours, offsets = _neighbours(halvings, cell)
    parent = np.full(count, -1, np.int64)
    for n in np.argsort(-log_density):
        best = -1
        for at in range(offsets[n], offsets[n + 1]):
            other = neighbours[at]
            if parent[other] >= 0 and (best < 0 or log_density[other] > log_density[best]):
                best = other
        if best < 0:
            parent[n] = n
            continue
        root = _root(parent, best)
        parent[n] = root
        for at in range(offsets[n], offsets[n + 1]):
            if parent[neighbours[at]] < 0:
                continue
            other = _root(parent, neighbours[at])
            if other != root and min(log_density[other], log_density[root]) < log_density[n] + valley:
                if log_density[other] > log_density[root]:
                    root, other = other, root
                parent[other] = root
    for n in range(count):
        parent[n] = _root(parent, n)
    return parent


@numba.njit(cache=True, nogil=True)
def _root(parent: Any, n: Any) -> Any:
    """First of the union of a block; the way there is shortened."""
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


@numba.njit(cache=True, nogil=True)
def _neighbours(halvings: Any, cell: Any) -> Any:
    """Blocks behind the faces of each block, CSR. Where there is none, a thin wall may be between it and the next."""
    count = len(halvings)
    least = halvings.min()
    size = 4
    while size < 2 * count:
        size *= 2
    table = np.full(size, -1, np.int64)
    keys = np.empty(count, np.int64)
    for n in range(count):
        keys[n] = _key(halvings[n] - least, cell[n, 0], cell[n, 1], cell[n, 2])
        slot = _place(table, keys, keys[n])
        table[slot] = n
    first, second = np.empty(_MOST_NEIGHBOURS * count, np.int64), np.empty(_MOST_NEIGHBOURS * count, np.int64)
    pairs = 0
    for n in range(count):
        for dx, dy, dz in _STEPS:
            for far in (1, 2):
                x, y, z = cell[n, 0] + far * dx, cell[n, 1] + far * dy, cell[n, 2] + far * dz
                other = _containing(table, keys, halvings[n] - least, x, y, z)
                if other >= 0 and other != n:
                    first[pairs], second[pairs] = n, other
                    pairs += 1
                    break
    offsets = np.zeros(count + 1, np.int64)
    for p in range(pairs):
        offsets[first[p] + 1] += 1
        offsets[second[p] + 1] += 1
    offsets = np.cumsum(offsets)
    neighbours, filled = np.empty(2 * pairs, np.int64), offsets[:-1].copy()
    for p in range(pairs):
        neighbours[filled[first[p]]] = second[p]
        filled[first[p]] += 1
        neighbours[filled[second[p]]] = first[p]
        filled[second[p]] += 1
    return neighbours, offsets


@numba.njit(cache=True, nogil=True)
def _containing(table: Any, keys: Any, halved: Any, x: Any, y: Any, z: Any) -> Any:
    """Block of this size or larger that contains a place, -1 for none."""
    while halved >= 0 and x >= 0 and y >= 0 and z >= 0:
        found = table[_place(table, keys, _key(halved, x, y, z))]
        if found >= 0:
            return found
        halved -= 1
        x, y, z = x >> 1, y >> 1, z >> 1
    return -1


@numba.njit(cache=True, nogil=True)
def _key(halved: Any, x: Any, y: Any, z: Any) -> Any:
    return ((np.int64(halved) << _BITS | x) << _BITS | y) << _BITS | z


@numba.njit(cache=True, nogil=True)
def _place(table: Any, keys: Any, key: Any) -> Any:
    """Place of a key in a hash table of indices, or the empty one where it belongs."""
    mask = len(table) - 1
    slot = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)) & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & mask
    return slot
