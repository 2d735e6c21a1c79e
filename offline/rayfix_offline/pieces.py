"""Ray pieces: every ray cut into overlapping slices of length, with the weight and moments of each slice.

A slice has the shape of a hat over log(length): it rises from the previous node to its own and falls to the next, so
that slices add up to one everywhere. Moment-matched Gaussians of hats add up to a nearly flat density along a long
ray (ripple 8 %), where those of abutting boxes leave deep valleys (39 %).

A piece is shared by all cells of all levels whose window the ray lies in.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.launch import RaySet, Segments
from rayfix_offline.pathprior import PathPrior, reflection_factors

FIRST_NODE = 0.25
"""Length of the first slice node, m; whatever is nearer belongs to it."""


@dataclass(frozen=True, kw_only=True)
class Pieces:
    """Pieces of all rays; those of ray r are ``offsets[r]`` to ``offsets[r + 1]``.

    Attributes
    ----------
    sequence : ndarray of int32, shape (n_pieces,)
    slice : ndarray of int16, shape (n_pieces,)
    mass : ndarray of shape (n_pieces,), m3 / sr
        Integral of s^2 pi over the length, times the hat.
    mean : ndarray of shape (n_pieces,), m
        Mean path length under that weight.
    variance : ndarray of shape (n_pieces,), m2
    """

    offsets: NDArray[np.int64]
    sequence: NDArray[np.int32]
    slice: NDArray[np.int16]
    mass: NDArray[np.float64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]

    @property
    def num_slices(self) -> int:
        """Number of slices that occur, counted from the station."""
        return int(self.slice.max(initial=-1)) + 1

    def of_rays(self, index: NDArray[np.int64]) -> "Pieces":
        """Pieces of chosen rays, in the order of ``index``."""
        counts = self.offsets[index + 1] - self.offsets[index]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        take = np.repeat(self.offsets[index] - offsets[:-1], counts) + np.arange(offsets[-1])
        return Pieces(
            offsets=offsets,
            sequence=self.sequence[take],
            slice=self.slice[take],
            mass=self.mass[take],
            mean=self.mean[take],
            variance=self.variance[take],
        )


def cut_pieces(
    rays: RaySet,
    segments: Segments,
    prior: PathPrior,
    *,
    exponent: float,
    kind: Literal["power", "uniform", "paper"],
    slice_ratio: float,
    step: float,
) -> Pieces:
    """Cut rays into pieces.

    Parameters
    ----------
    exponent : float
        The prior's beta.
    kind : {"power", "uniform", "paper"}
        Weight along a ray: s^2 pi, s^2, or 1.
    slice_ratio : float
        Ratio of a slice's node to the one before.
    step : float, m
        Longest step of the integration along a ray.
    """
    counts = _count(segments.sequence, segments.start, segments.end, np.log(slice_ratio))
    offsets = np.concatenate([[0], np.cumsum(counts)])
    total = int(offsets[-1])
    pieces = Pieces(
        offsets=offsets,
        sequence=np.empty(total, np.int32),
        slice=np.empty(total, np.int16),
        mass=np.zeros(total),
        mean=np.zeros(total),
        variance=np.zeros(total),
    )
    _cut(
        segments.sequence,
        segments.start,
        segments.end,
        segments.sequences.images,
        segments.sequences.mirrors,
        rays.directions,
        reflection_factors(segments, exponent),
        exponent,
        prior.origin,
        prior.voxel_size,
        prior.total,
        ("power", "uniform", "paper").index(kind),
        np.log(slice_ratio),
        step,
        offsets,
        pieces.sequence,
        pieces.slice,
        pieces.mass,
        pieces.mean,
        pieces.variance,
    )
    return pieces


@numba.njit(cache=True, nogil=True)
def _node(
    length: Any,
    log_ratio: Any,
) -> Any:
    """Slice coordinate of a length: n at node n, between the nodes linear in the logarithm."""
    return max(0.0, np.log(max(length, FIRST_NODE) / FIRST_NODE) / log_ratio)


@numba.njit(cache=True, nogil=True)
def _count(
    sequence: Any,
    start: Any,
    end: Any,
    log_ratio: Any,
) -> Any:
    counts = np.zeros(sequence.shape[0], np.int64)
    for ray in range(sequence.shape[0]):
        for depth in range(sequence.shape[1]):
            if sequence[ray, depth] < 0:
                break
            first = int(_node(start[ray, depth], log_ratio))
            last = int(_node(end[ray, depth], log_ratio))
            counts[ray] += last - first + 2
    return counts


@numba.njit(cache=True, nogil=True)
def _cut(
    sequence: Any,
    start: Any,
    end: Any,
    images: Any,
    mirrors: Any,
    directions: Any,
    factors: Any,
    exponent: Any,
    origin: Any,
    voxel: Any,
    total: Any,
    kind: Any,
    log_ratio: Any,
    step: Any,
    offsets: Any,
    out_sequence: Any,
    out_slice: Any,
    out_mass: Any,
    out_mean: Any,
    out_variance: Any,
) -> None:
    nx, ny, nz = total.shape
    heading = np.empty(3)
    for ray in range(sequence.shape[0]):
        at = offsets[ray]
        for depth in range(sequence.shape[1]):
            seq = sequence[ray, depth]
            if seq < 0:
                break
            for i in range(3):
                heading[i] = (
                    mirrors[seq, i, 0] * directions[ray, 0]
                    + mirrors[seq, i, 1] * directions[ray, 1]
                    + mirrors[seq, i, 2] * directions[ray, 2]
                )
            begin, stop = start[ray, depth], end[ray, depth]
            first = int(_node(begin, log_ratio))
            last = int(_node(stop, log_ratio))
            for n in range(first, last + 2):
                out_sequence[at + n - first] = seq
                out_slice[at + n - first] = n
            for n in range(first, last + 1):
                a = begin if n == first else FIRST_NODE * np.exp(n * log_ratio)
                b = stop if n == last else FIRST_NODE * np.exp((n + 1) * log_ratio)
                if b <= a:
                    continue
                steps = int(np.ceil((b - a) / step))
                size = (b - a) / steps
                for k in range(steps):
                    length = a + (k + 0.5) * size
                    weight = size
                    if kind != 2:
                        weight *= length * length
                    if kind == 0:
                        ix = int(np.floor((images[seq, 0] + length * heading[0] - origin[0]) / voxel))
                        iy = int(np.floor((images[seq, 1] + length * heading[1] - origin[1]) / voxel))
                        iz = int(np.floor((images[seq, 2] + length * heading[2] - origin[2]) / voxel))
                        ix = min(max(ix, 0), nx - 1)
                        iy = min(max(iy, 0), ny - 1)
                        iz = min(max(iz, 0), nz - 1)
                        own = factors[ray, depth] * length ** (-2.0 * exponent)
                        # A path so weak that its gain^beta is 0 is never reported.
                        weight *= min(1.0, own / max(total[ix, iy, iz], own)) if own > 0.0 else 0.0
                    share = _node(length, log_ratio) - n
                    for side in range(2):
                        part = weight * (share if side else 1.0 - share)
                        i = at + n - first + side
                        out_mass[i] += part
                        out_mean[i] += part * length
                        out_variance[i] += part * length * length
            for n in range(first, last + 2):
                i = at + n - first
                if out_mass[i] > 0.0:
                    out_mean[i] /= out_mass[i]
                    out_variance[i] = max(0.0, out_variance[i] / out_mass[i] - out_mean[i] ** 2)
            at += last - first + 2
