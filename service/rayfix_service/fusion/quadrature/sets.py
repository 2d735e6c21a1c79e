"""The measured paths of all stations of a report, as the integration over the free space evaluates them."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.directions import (
    NO_DIRECTION,
    Direction,
    in_field_of_view,
    to_scene,
    without_bias,
)
from rayfix_service.fusion.measurements.report import MeasuredPath
from rayfix_service.fusion.quadrature.detection import DetectedPaths
from rayfix_service.fusion.quadrature.observed import measured_direction
from rayfix_service.fusion.quadrature.path_sets import (
    CLOCK,
    MOST_MEASURED,
    NO_CLOCK,
    MeasuredSet,
    collapse_beams,
    extend_beams,
    new_beams,
)
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station

_SPAN_STEP, _LEAST_SPAN, _MOST_SPAN = 5.0, 10.0, 40.0
"""Steps of how weak the paths may be that a station reports, dB; the table has none beyond the last."""

Array = NDArray[np.float64]


class StationSet(NamedTuple):
    """Measured paths of a station, and the paths that they may be of, with their probabilities to be reported."""

    paths: DetectedPaths
    measured: MeasuredSet


@dataclass(frozen=True, kw_only=True)
class PathSets:
    """Measured paths of all stations of a report.

    Attributes
    ----------
    groups : tuple of tuples of StationSet
        Stations that share a clock are one group, those on a known clock or on one of their own are each one.
    """

    groups: tuple[tuple[StationSet, ...], ...]

    def __len__(self) -> int:
        """Return the number of measured paths."""
        return sum(len(each.measured.zenith) for group in self.groups for each in group)

    @property
    def log_all_spurious(self) -> float:
        """Log density of the case that all measured paths are spurious, whatever paths there are."""
        return math.fsum(float(each.measured.log_spurious.sum()) for group in self.groups for each in group)

    def evaluate(
        self,
        points: Array,
        blocks: NDArray[np.int64],
        spread: float,
        resolution: float,
        together: float,
        level: int,
        log_likelihood: Array,
        information: Array,
    ) -> Array:
        """Add the log likelihood and the information at points; return who is spurious, shape (m, n).

        Parameters
        ----------
        together : float
            Measurements that tell of the same direction.
        level : int
            Size of the blocks, 0 for the smallest.
        """
        lost = np.zeros((len(self), len(points)))
        beams, first = tuple(new_beams(len(points))), 0
        for group in self.groups:
            bits: list[int] = []
            for detected, measured in group:
                paths = detected.paths
                geometry = paths.images, paths.mirrors
                extend_beams(
                    points,
                    blocks,
                    spread,
                    resolution,
                    together,
                    tuple(paths.levels[level]),
                    tuple(detected.detail(level)),
                    geometry,
                    tuple(measured),
                    beams,
                )
                bits += measured.bit.tolist()
            count = len(bits)
            collapse_beams(beams, log_likelihood, information, np.array(bits), lost[first : first + count])
            first += count
        return lost


NO_SETS = PathSets(groups=())


class SortedPaths(NamedTuple):
    """Measured paths by station, as the kernels take them.

    Attributes
    ----------
    groups : list of lists of tuples
        Name of a station, how weak its paths may be, dB, and its measured paths; a list for each clock.
    indices : list of tuples
        Name of the station and index in the report of each measured path, in the order of the groups.
    unused : dict of int to str
        Why others do not contribute.
    """

    groups: list[list[tuple[str, float, MeasuredSet]]]
    indices: list[tuple[str, int]]
    unused: dict[int, str]


def sort_paths(
    measured: Sequence[tuple[int, MeasuredPath]],
    site: SiteInfo,
    *,
    within_db: float,
    spurious_paths: float,
    single: Collection[int] = (),
) -> SortedPaths:
    """Sort the measured paths of a report by station and clock.

    Parameters
    ----------
    measured : sequence of (int, MeasuredPath)
        With their indices in the report.
    site : SiteInfo
    within_db : float
        How weak a path may be that a station reports, where its powers do not tell.
    spurious_paths : float
        Number of spurious paths that a station is expected to report.
    single : collection of int
        Indices of measured paths that are a set of their own, beside others of their station.

    Raises
    ------
    ReportError
        For too many paths, or paths of a station on different clocks.
    """
    unused: dict[int, str] = {}
    by_set: dict[tuple[str, int], list[tuple[int, MeasuredPath, Direction]]] = {}
    for index, path in measured:
        station = site.station_by_id[path.station_id]
        direction = NO_DIRECTION
        if path.angle is not None:
            direction = to_scene(without_bias(path.angle, station), station, site.north)
            if not in_field_of_view(station, direction):
                unused[index] = f"the path lies outside the field of view of station '{station.id}'"
                continue
        by_set.setdefault((station.id, index if index in single else -1), []).append((index, path, direction))
    if len(measured) - len(unused) > MOST_MEASURED:
        raise ReportError(
            f"the report has {len(measured)} paths; give at most {MOST_MEASURED}, the strongest",
            path=("measurements", measured[MOST_MEASURED][0]),
        )
    clocks: dict[Any, list[tuple[str, int]]] = {}
    for key, rows in by_set.items():
        clocks.setdefault("ue" if _clock_of(rows) == "ue" else key, []).append(key)
    first = min((p.length for _, p in measured if p.clock == "ue" and p.length is not None), default=0.0)
    groups, indices = [], list[tuple[str, int]]()
    for keys in clocks.values():
        group = []
        for key in keys:
            rows, name = by_set[key], key[0]
            station = site.station_by_id[name]
            own = _measured_set(rows, station, site.max_path_length, spurious_paths, first, len(indices))
            group.append((name, span_of([path for _, path, _ in rows], within_db), own))
            indices += [(name, index) for index, _, _ in rows]
        groups.append(group)
    return SortedPaths(groups, indices, unused)


def _clock_of(rows: Sequence[tuple[int, MeasuredPath, Direction]]) -> str:
    """Clock of a station's paths."""
    clock = None
    for index, path, _ in rows:
        if path.length is None:
            continue
        if clock not in (None, path.clock):
            raise ReportError(
                f"measurements[{index}] is a path of station '{path.station_id}' on another clock than the one "
                "before; give all lengths of a station as one of range_m, toa_m and delay_ns",
                path=("measurements", index),
            )
        clock = path.clock
    return clock or "known"


def span_of(paths: Sequence[MeasuredPath], within_db: float) -> float:
    """How weak a path of a station may be, dB: from the powers, in steps, which are few rules to keep.

    Parameters
    ----------
    paths : sequence of MeasuredPath
        Of one station.
    within_db : float
        Where fewer than two have a power.
    """
    powers = [path.power_db for path in paths if path.power_db is not None]
    if len(powers) < 2:
        return within_db
    steps = math.ceil((max(powers) - min(powers)) / _SPAN_STEP) + 1
    return min(max(_SPAN_STEP * steps, _LEAST_SPAN), _MOST_SPAN)


def _measured_set(
    rows: Sequence[tuple[int, MeasuredPath, Direction]],
    station: Station,
    max_path_length: float,
    spurious_paths: float,
    first: float,
    bit: int,
) -> MeasuredSet:
    """Write a station's paths as arrays; times on the UE's clock count from the first one of all."""
    count = len(rows)
    turn, toward, cov = np.empty((count, 3, 3)), np.full((count, 3), np.nan), np.empty((count, 3))
    zenith, length, variance = np.empty(count), np.zeros(count), np.full(count, np.inf)
    log_spurious = np.full(count, math.log(spurious_paths))
    clock = _clock_of(rows)
    for n, (_, path, direction) in enumerate(rows):
        turn[n], zenith[n], cov[n] = measured_direction(direction)
        if np.isfinite(cov[n, 2]):
            toward[n] = turn[n].T @ np.array([math.sin(zenith[n]), 0.0, math.cos(zenith[n])])
            log_spurious[n] -= math.log(4.0 * math.pi)
        elif np.isfinite(cov[n, 0]):
            log_spurious[n] -= math.log(2.0 * math.pi)
        if path.length is not None and path.stdev is not None:
            length[n], variance[n] = path.length, path.stdev**2
            if clock == "ue":
                length[n] -= first
            if clock != "station":
                length[n] -= station.bias.range
                variance[n] += station.bias.range_stdev**2
            log_spurious[n] -= math.log(max_path_length + math.sqrt(2.0 * math.pi * variance[n]))
    return MeasuredSet(
        turn=turn,
        toward=toward,
        zenith=zenith,
        cov=cov,
        length=length,
        length_variance=variance,
        log_spurious=log_spurious,
        bit=np.arange(bit, bit + count),
        on_clock=NO_CLOCK if clock == "known" else CLOCK,
        log_range=math.log(max_path_length),
    )
