"""Selection of points by times: step 3 of the paper's Algorithm 1, and the pairs and bins of its Algorithm 2."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.paper.points import RayPoints


@dataclass(frozen=True, kw_only=True)
class RelativeLength:
    """A relative propagation time (RPT) as a length: path length to a station minus that to the reference.

    Attributes
    ----------
    length_difference : float, m
    stdev : float, m
    """

    length_difference: float
    stdev: float


def select_by_length(points: RayPoints, length: float, stdev: float, rng: np.random.Generator) -> RayPoints:
    """Keep each point with a probability proportional to the likelihood of a propagation time.

    Parameters
    ----------
    length, stdev : float, m
        Measured path length and its standard deviation.
    """
    likelihood = np.exp(-0.5 * ((points.path_length - length) / stdev) ** 2)
    return points.take(np.flatnonzero(rng.random(len(points)) < likelihood))


def select_tuples(
    reference: RayPoints,
    others: Sequence[RayPoints],
    differences: Sequence[RelativeLength],
    *,
    count: int,
    bins_per_stdev: int,
    rng: np.random.Generator,
) -> list[RayPoints]:
    """Draw tuples of points of all stations with length differences that agree with the relative propagation times.

    With one other station these are the pairs of Algorithm 2. The cost of all pairs is the product of the numbers of
    points. Because the likelihood depends only on the lengths, points are sorted into bins of path length; bins are
    drawn, and then a point from each bin.

    Parameters
    ----------
    reference : RayPoints
        Points of the reference station.
    others : sequence of RayPoints
        Points of the other stations.
    differences : sequence of RelativeLength
        One for each of ``others``.
    count : int
        Number of tuples to draw.
    bins_per_stdev : int
        The width of a bin is the smallest standard deviation divided by this.

    Returns
    -------
    list of RayPoints
        ``count`` points of the reference and of each other station; points with the same index form a tuple. All are
        empty if no lengths agree.
    """
    width = min(d.stdev for d in differences) / bins_per_stdev
    own = _Bins.of(reference.path_length, width)
    bins = [_Bins.of(points.path_length, width) for points in others]
    # Row a: likelihood of the difference, for a reference point in bin a and any point in each bin of the other.
    tables = [
        np.exp(-0.5 * ((theirs.centres - own.centres[:, None] - d.length_difference) / d.stdev) ** 2) * theirs.counts
        for theirs, d in zip(bins, differences, strict=True)
    ]
    weight = own.counts * np.prod([table.sum(axis=1) for table in tables], axis=0)
    if not weight.sum() > 0.0:
        nothing = np.zeros(0, np.int64)
        return [points.take(nothing) for points in (reference, *others)]
    rows = rng.choice(len(weight), size=count, p=weight / weight.sum())
    drawn = [reference.take(own.draw(rows, rng))]
    for points, theirs, table in zip(others, bins, tables, strict=True):
        cumulative = np.cumsum(table, axis=1)
        level = rng.random(count) * cumulative[rows, -1]
        columns = (cumulative[rows] <= level[:, None]).sum(axis=1)
        drawn.append(points.take(theirs.draw(columns, rng)))
    return drawn


@dataclass(frozen=True, kw_only=True)
class _Bins:
    """Points sorted into bins of path length; those of bin b are ``order[begins[b]:begins[b] + counts[b]]``."""

    centres: NDArray[np.float64]
    counts: NDArray[np.int64]
    begins: NDArray[np.int64]
    order: NDArray[np.int64]

    @classmethod
    def of(cls, lengths: NDArray[np.float64], width: float) -> "_Bins":
        number = np.floor(lengths / width).astype(np.int64)
        counts = np.bincount(number)
        return cls(
            centres=np.asarray((np.arange(len(counts)) + 0.5) * width, np.float64),
            counts=counts,
            begins=np.cumsum(counts) - counts,
            order=np.argsort(number, kind="stable"),
        )

    def draw(self, bins: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
        """Draw one point from each of the given bins."""
        step = (rng.random(len(bins)) * self.counts[bins]).astype(np.int64)
        return np.asarray(self.order[self.begins[bins] + step])
