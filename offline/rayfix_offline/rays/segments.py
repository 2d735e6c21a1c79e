"""Straight segments of rays, and the reflection sequences that they belong to."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """Reflection sequences of rays; sequence 0 is the direct path.

    Attributes
    ----------
    images : ndarray of shape (n_sequences, 3), m
        Mirror images of the station.
    mirrors : ndarray of shape (n_sequences, 3, 3)
        Matrix that turns a launch direction into the direction after the last reflection.
    parents : ndarray of int32, shape (n_sequences,)
        Index of the sequence without its last reflection, -1 for the direct path.
    planes : ndarray of int32, shape (n_sequences,)
        Plane of the last reflection, -1 for the direct path.
    num_reflections : ndarray of int8, shape (n_sequences,)
    """

    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]
    parents: NDArray[np.int32]
    planes: NDArray[np.int32]
    num_reflections: NDArray[np.int8]


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Straight segments of rays, one column for each number of reflections.

    Attributes
    ----------
    sequence : ndarray of int32, shape (n_rays, max_reflections + 1)
        Reflection sequence of the segment, -1 if the ray has ended before.
    start, end : ndarray of that shape, m
        Path lengths at which the segment begins and ends.
    log_gain : ndarray of that shape
        Logarithm to base 10 of the fraction of the power that remains after the reflections before the segment.
    lost_ray_share : float
        Fraction of the rays that left the scene instead of hitting a surface.
    """

    sequence: NDArray[np.int32]
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    log_gain: NDArray[np.float64]
    sequences: Sequences
    lost_ray_share: float


class SegmentArrays(NamedTuple):
    """Straight segments of some rays, as the kernels read them.

    Attributes
    ----------
    sequence, start, end
        As in :class:`Segments`.
    images, mirrors
        As in :class:`Sequences`.
    directions : ndarray of shape (n_rays, 3)
        Launch directions.
    factors : ndarray of shape (n_rays, max_reflections + 1)
        Factor of gain^beta due to the reflections before a segment.
    """

    sequence: NDArray[np.int32]
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]
    directions: NDArray[np.float64]
    factors: NDArray[np.float64]

    @classmethod
    def of(
        cls, segments: Segments, directions: NDArray[np.float64], factors: NDArray[np.float64], first: int, stop: int
    ) -> "SegmentArrays":
        """Segments of the rays from ``first`` to before ``stop``."""
        return cls(
            sequence=segments.sequence[first:stop],
            start=segments.start[first:stop],
            end=segments.end[first:stop],
            images=segments.sequences.images,
            mirrors=segments.sequences.mirrors,
            directions=directions[first:stop],
            factors=factors[first:stop],
        )
