"""Straight pieces of rays, and the reflection sequences that they belong to."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """Reflection sequences that rays went through; number 0 is the direct one.

    Attributes
    ----------
    images : ndarray of shape (n_sequences, 3), m
        The station, mirrored.
    mirrors : ndarray of shape (n_sequences, 3, 3)
        Takes a launch direction to the direction after the last reflection.
    parents : ndarray of int32, shape (n_sequences,)
        The sequence without its last reflection, -1 for the direct one.
    planes : ndarray of int32, shape (n_sequences,)
        Plane of the last reflection, -1 for the direct one.
    num_reflections : ndarray of int8, shape (n_sequences,)
    """

    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]
    parents: NDArray[np.int32]
    planes: NDArray[np.int32]
    num_reflections: NDArray[np.int8]


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Straight pieces of rays, one column per number of reflections.

    Attributes
    ----------
    sequence : ndarray of int32, shape (n_rays, max_reflections + 1)
        Reflection sequence of the piece, -1 where the ray has ended before.
    start, end : ndarray of that shape, m
        Path lengths at which the piece begins and ends.
    log_gain : ndarray of that shape
        Logarithm to base 10 of the share of the power that the reflections before the piece left, 0 before the first.
    lost_ray_share : float
        Share of the rays that left the scene instead of hitting a surface.
    """

    sequence: NDArray[np.int32]
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    log_gain: NDArray[np.float64]
    sequences: Sequences
    lost_ray_share: float


class SegmentArrays(NamedTuple):
    """Straight pieces of some rays, as the kernels read them.

    Attributes
    ----------
    sequence, start, end
        As in :class:`Segments`.
    images, mirrors
        As in :class:`Sequences`.
    directions : ndarray of shape (n_rays, 3)
        In which the rays are launched.
    factors : ndarray of shape (n_rays, max_reflections + 1)
        What the reflections before a piece put on gain^beta.
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
        """Pieces of the rays from ``first`` to before ``stop``."""
        return cls(
            sequence=segments.sequence[first:stop],
            start=segments.start[first:stop],
            end=segments.end[first:stop],
            images=segments.sequences.images,
            mirrors=segments.sequences.mirrors,
            directions=directions[first:stop],
            factors=factors[first:stop],
        )
