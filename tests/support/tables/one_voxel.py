"""A path map of one voxel, whose weights follow in closed form."""

import numpy as np

from rayfix_tables.paths import PathMap

LENGTHS = np.array([8.0, 2.0, 4.0])


def one_voxel(lit: list[float], log_gain: list[float]) -> PathMap:
    """Return a map of one voxel with paths of the lengths above."""
    count = len(lit)
    return PathMap(
        origin=np.zeros(3),
        voxel_size=1.0,
        shape=(1, 1, 1),
        offsets=np.array([0, count]),
        sequence=np.arange(count, dtype=np.int32),
        weight=np.full(count, 1.0 / count, np.float32),
        excess=np.zeros(0, np.float32),
        num_walls=np.zeros(0, np.int8),
        images=0.5 + np.outer(LENGTHS, [1.0, 0.0, 0.0]),
        mirrors=np.broadcast_to(np.eye(3), (count, 3, 3)),
        num_reflections=np.zeros(count, np.int8),
        log_gain=np.array(log_gain, np.float16),
        lit=np.array(lit, np.float16),
    )
