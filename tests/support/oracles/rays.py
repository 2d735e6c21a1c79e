"""Rays by hand, and rays as rows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.segments import Segments, Sequences


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Segments of rays that pass no wall, one column for each number of reflections; -1 and 0 where there is none."""

    sequence: NDArray[np.int32]
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    log_gain: NDArray[np.float64]
    sequences: Sequences
    lost_ray_share: float

    @classmethod
    def of(cls, segments: Segments) -> "Rows":
        """Arrange segments by ray and number of reflections."""
        assert not segments.num_walls.any()
        shape = (len(segments.offsets) - 1, segments.max_reflections + 1)
        place = segments.ray, segments.sequences.num_reflections[segments.sequence]
        sequence = np.full(shape, -1, np.int32)
        sequence[place] = segments.sequence
        floats = {name: np.zeros(shape) for name in ("start", "end", "log_gain")}
        for name, column in floats.items():
            column[place] = getattr(segments, name)
        return cls(
            sequence=sequence,
            **floats,
            sequences=segments.sequences,
            lost_ray_share=segments.lost_ray_share,
        )


def no_reflections() -> Sequences:
    """Return the one sequence of rays that leave a station at the origin and meet nothing."""
    return Sequences(
        images=np.zeros((1, 3)),
        mirrors=np.eye(3)[None],
        parents=np.array([-1], np.int32),
        planes=np.array([-1], np.int32),
        num_reflections=np.zeros(1, np.int8),
    )
