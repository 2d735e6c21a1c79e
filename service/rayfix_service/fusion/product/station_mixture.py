"""A station's mixture given a measured direction: Gaussians over (position, path length)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.lookup.lookup import Lookup, look_up
from rayfix_service.fusion.measurements.directions import NO_DIRECTION, Direction
from rayfix_service.fusion.measurements.line_of_sight import LineOfSightWeights
from rayfix_service.fusion.product.merging import merge_gaussians
from rayfix_tables.compact.expanding import expand, half, no_tubes
from rayfix_tables.compact.tubes import CompactTubes
from rayfix_tables.gaussians.conditioning import Conditioned, MeasuredCells, condition_on_angle
from rayfix_tables.mixture import Tubes
from rayfix_tables.part import StationPart

_RANGE_STDEV = 0.1
"""Noise of path lengths, m, under which paths of all directions are compared."""

_MAX_DIVERGENCE = 1e-4
"""What merging two of them may cost, nats: a path length picks a small part of them all."""


class StationMixture(NamedTuple):
    """Weighted Gaussians over (x, path length).

    Attributes
    ----------
    log_evidence : ndarray of shape (k,)
    mean : ndarray of shape (k, 4), m
    cov : ndarray of shape (k, 4, 4), m2
    """

    log_evidence: NDArray[np.float64]
    mean: NDArray[np.float64]
    cov: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.log_evidence)

    def those(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> "StationMixture":
        """Gaussians that an index picks."""
        return StationMixture(*(array[index] for array in self))

    def weighted(self, log_weight: NDArray[np.float64] | float) -> "StationMixture":
        """Give them more weight, by its logarithm."""
        return StationMixture(self.log_evidence + log_weight, self.mean, self.cov)

    def merged(self) -> "StationMixture":
        """Merge in place those that no path length distinguishes."""
        return self.those(merge_gaussians(*self, (0.0, 0.0, 0.0, _RANGE_STDEV**2), _MAX_DIVERGENCE))


def join(parts: Sequence[StationMixture]) -> StationMixture:
    """Gaussians of all parts."""
    return parts[0] if len(parts) == 1 else StationMixture(*map(np.concatenate, zip(*parts, strict=True)))


@dataclass(frozen=True)
class StationMixtures:
    """A station's part of the table, and what follows from it for reports without an angle.

    Attributes
    ----------
    part : StationPart
    origin : tuple of 3 floats, m
        Of the frame of the part's Gaussians, in the scene's.
    """

    part: StationPart
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def position(self) -> NDArray[np.float64]:
        """Position of the station in the frame of the Gaussians, shape (3,), m."""
        return np.subtract(self.part.station.position, self.origin)

    def towards(self, measured: Direction, weights: LineOfSightWeights | None = None) -> StationMixture:
        """Gaussians of the paths from a measured direction; none where no ray comes.

        Parameters
        ----------
        weights : LineOfSightWeights, optional
            What the weights of direct and of reflected paths are multiplied by.
        """
        anywhere = measured.azimuth is None and measured.zenith is None
        if weights is None:
            return self.everywhere if anywhere else _condition(look_up(self.part.levels, measured))
        if anywhere:
            return join(
                [mixture.weighted(log) for mixture, log in zip(self.everywhere_by_line_of_sight, weights, strict=True)]
            )
        lookup = look_up(self.part.levels, measured)
        return _condition(lookup).weighted(np.where(is_direct(lookup), *weights))

    def kept(self, by_line_of_sight: bool) -> int | None:
        """Return how many Gaussians the paths of all directions are, None while they are not merged yet."""
        found = self.__dict__.get("everywhere_by_line_of_sight" if by_line_of_sight else "everywhere")
        if found is None:
            return None
        return sum(map(len, found)) if by_line_of_sight else len(found)

    @cached_property
    def everywhere(self) -> StationMixture:
        """Gaussians of the paths of all directions, those merged that no path length distinguishes."""
        return _condition(look_up(self.part.levels, NO_DIRECTION)).merged()

    @cached_property
    def everywhere_by_line_of_sight(self) -> tuple[StationMixture, StationMixture]:
        """Direct paths and reflected ones of all directions, either merged like :attr:`everywhere`."""
        lookup = look_up(self.part.levels, NO_DIRECTION)
        mixture, direct = _condition(lookup), is_direct(lookup)
        return mixture.those(direct).merged(), mixture.those(~direct).merged()


def _condition(lookup: Lookup) -> StationMixture:
    """Condition every component of the cells looked up on the rest of the measured angle."""
    level, mixture = lookup.level, lookup.level.mixture
    rest_mean, rest_cov = np.ascontiguousarray(lookup.rest_mean), np.ascontiguousarray(lookup.rest_cov)
    looked_up = lookup.cells, rest_mean, rest_cov, lookup.log_factor
    if isinstance(mixture, CompactTubes):
        balance = level.log_balance.view(np.uint16)
        compact = tuple(mixture.arrays), mixture.window, balance, level.cell_offsets, level.cell_log_mass
        return StationMixture(*_condition_compact_cells(compact, looked_up))
    components = tuple(mixture.tubes), level.log_balance, level.cell_offsets, level.cell_log_mass
    return StationMixture(*_condition_cells(components, looked_up))


@numba.njit(cache=True, nogil=True)
def _ranges(looked_up: Any, cell_offsets: Any, cell_log_mass: Any) -> Any:
    """Ranges of the components of some cells, the logarithms of the cells' factors, and the number of components."""
    cells, _, _, log_factor = looked_up
    count = len(cells)
    begins, ends, log_scale = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    total = 0
    for n in range(count):
        begins[n], ends[n] = cell_offsets[cells[n]], cell_offsets[cells[n] + 1]
        log_scale[n] = log_factor[n] + cell_log_mass[cells[n]]
        total += ends[n] - begins[n]
    return begins, ends, log_scale, total


@numba.njit(cache=True, nogil=True)
def _condition_compact_cells(components: Any, looked_up: Any) -> Any:
    """Condition the components of some cells, which are compact; as :func:`_condition_cells`."""
    stored, window, log_balance, cell_offsets, cell_log_mass = components
    begins, ends, log_scale, total = _ranges(looked_up, cell_offsets, cell_log_mass)
    tubes = no_tubes(total)
    expand(stored, window, begins, ends, tubes)
    after = np.cumsum(ends - begins)
    out = Conditioned(np.empty(total), np.empty((total, 4)), np.empty((total, 4, 4)))
    cells = MeasuredCells(after - (ends - begins), after, looked_up[1], looked_up[2], log_scale)
    condition_on_angle(tubes, cells, out)
    if len(log_balance):
        row = 0
        for n in range(len(begins)):
            for k in range(begins[n], ends[n]):
                out.log_evidence[row] += half(log_balance[k])
                row += 1
    return out.log_evidence, out.mean, out.cov


@numba.njit(cache=True, nogil=True)
def _condition_cells(components: Any, looked_up: Any) -> Any:
    """Condition the components of some cells. Plain tuples, since it takes numba 4 us to find out what a named one is.

    Parameters
    ----------
    components : tuple
        Of a level: :class:`~rayfix_tables.mixture.Tubes` as a tuple, ``log_balance``, ``cell_offsets``,
        ``cell_log_mass``.
    looked_up : tuple
        The fields of a :class:`~rayfix_service.fusion.lookup.partition_of_unity.CellSum`.

    Returns
    -------
    log_evidence, mean, cov : ndarray
        As in :class:`StationMixture`.
    """
    tubes, log_balance, cell_offsets, cell_log_mass = components
    begins, ends, log_scale, total = _ranges(looked_up, cell_offsets, cell_log_mass)
    out = Conditioned(np.empty(total), np.empty((total, 4)), np.empty((total, 4, 4)))
    condition_on_angle(Tubes(*tubes), MeasuredCells(begins, ends, looked_up[1], looked_up[2], log_scale), out)
    if len(log_balance):
        row = 0
        for n in range(len(begins)):
            for k in range(begins[n], ends[n]):
                out.log_evidence[row] += log_balance[k]
                row += 1
    return out.log_evidence, out.mean, out.cov


def is_direct(lookup: Lookup) -> NDArray[np.bool_]:
    """Find which components of the cells of a lookup, cell after cell, are of paths that meet no wall.

    A straight path through a wall is not direct. A component of several paths counts as the one that carries most of
    it.
    """
    offsets = lookup.level.cell_offsets
    begins, counts = offsets[lookup.cells], offsets[lookup.cells + 1] - offsets[lookup.cells]
    rows = np.repeat(begins - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
    mixture = lookup.level.mixture
    return np.asarray((mixture.num_reflections[rows] == 0) & (mixture.num_walls[rows] == 0))
