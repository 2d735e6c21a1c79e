"""Rays by hand."""

import numpy as np

from rayfix_offline.rays.segments import Sequences


def no_reflections() -> Sequences:
    """Return the one sequence of rays that leave a station at the origin and meet nothing."""
    return Sequences(
        images=np.zeros((1, 3)),
        mirrors=np.eye(3)[None],
        parents=np.array([-1], np.int32),
        planes=np.array([-1], np.int32),
        num_reflections=np.zeros(1, np.int8),
    )
