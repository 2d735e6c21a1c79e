"""Reflection sequences of the same surfaces."""

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.segments import Sequences
from rayfix_offline.twin.planes import Planes


def surface_sequences(sequences: Sequences, planes: Planes) -> NDArray[np.int64]:
    """Find the reflection sequences of the same surfaces in the same order.

    Returns
    -------
    ndarray of int64, shape (n_sequences,)
        First of the sequences that are equivalent to each one; itself where nothing is curved.
    """
    out = np.arange(len(sequences.parents))
    if planes.curved:
        for depth in range(1, int(sequences.num_reflections.max()) + 1):
            mine = np.flatnonzero(sequences.num_reflections == depth)
            key = out[sequences.parents[mine]] * len(planes) + planes.surfaces[sequences.planes[mine]]
            _, first, same = np.unique(key, return_index=True, return_inverse=True)
            out[mine] = mine[first[same]]
    return out
