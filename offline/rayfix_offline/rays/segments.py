"""Straight segments of rays, and the reflection sequences that they belong to."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """Reflection sequences of rays; sequence 0 is the direct path.

    Walls that a ray passes do not turn it, and leave its sequence as it is.

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
    """Straight segments of rays. Those of ray r are ``offsets[r]`` to ``offsets[r + 1]``, parents before children.

    A ray is a tree: at a wall it is mirrored, and goes on straight if the wall lets signals through.

    Attributes
    ----------
    offsets : ndarray of int64, shape (n_rays + 1,)
    sequence : ndarray of int32, shape (n_segments,)
        Reflection sequence.
    start, end : ndarray of shape (n_segments,), m
        Geometric path lengths at which the segment begins and ends.
    log_gain : ndarray of shape (n_segments,)
        Logarithm to base 10 of the fraction of the power that remains after the walls before the segment.
    excess : ndarray of shape (n_segments,), m
        Length that the walls passed before the segment add to the measured one.
    num_walls : ndarray of int8, shape (n_segments,)
        Number of walls passed before the segment.
    max_reflections : int
        Largest number of reflections that was allowed.
    lost_ray_share : float
        Fraction of the rays that left the scene instead of hitting a surface, without passing a wall.
    cut_power_share : float
        Fraction of the power whose rays ended because they were too weak or had passed too many walls.
    """

    offsets: NDArray[np.int64]
    sequence: NDArray[np.int32]
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    log_gain: NDArray[np.float64]
    excess: NDArray[np.float64]
    num_walls: NDArray[np.int8]
    sequences: Sequences
    max_reflections: int
    lost_ray_share: float
    cut_power_share: float

    @cached_property
    def ray(self) -> NDArray[np.int64]:
        """Ray of each segment, shape (n_segments,)."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


class SegmentArrays(NamedTuple):
    """Straight segments of some rays, as the kernels read them.

    Attributes
    ----------
    offsets : ndarray of int64, shape (n_rays + 1,)
        Segments of each ray in the arrays of all segments.
    sequence, start, end, excess, num_walls
        As in :class:`Segments`.
    images, mirrors, num_reflections
        As in :class:`Sequences`.
    directions : ndarray of shape (n_rays, 3)
        Launch directions.
    factors : ndarray of shape (n_segments,)
        Factor of gain^beta due to the walls before a segment.
    log_gain
        As in :class:`Segments`.
    """

    offsets: NDArray[np.int64]
    sequence: NDArray[np.int32]
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    excess: NDArray[np.float64]
    num_walls: NDArray[np.int8]
    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]
    num_reflections: NDArray[np.int8]
    directions: NDArray[np.float64]
    factors: NDArray[np.float64]
    log_gain: NDArray[np.float64]

    @classmethod
    def of(
        cls, segments: Segments, directions: NDArray[np.float64], factors: NDArray[np.float64], first: int, stop: int
    ) -> "SegmentArrays":
        """Segments of the rays from ``first`` to before ``stop``."""
        return cls(
            offsets=segments.offsets[first : stop + 1],
            sequence=segments.sequence,
            start=segments.start,
            end=segments.end,
            excess=segments.excess,
            num_walls=segments.num_walls,
            images=segments.sequences.images,
            mirrors=segments.sequences.mirrors,
            num_reflections=segments.sequences.num_reflections,
            directions=directions[first:stop],
            factors=factors,
            log_gain=segments.log_gain,
        )
