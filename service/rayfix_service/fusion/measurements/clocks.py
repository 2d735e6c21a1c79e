"""Times of arrival on clocks of unknown offset, and time differences turned into such times.

A set of time differences between stations is equivalent to times of arrival at these stations on a clock of its own.
Stations that differences connect, over however many steps, are on one clock: then it does not matter which station
is the reference of which, and the noise that two differences share through a station is correlated as it is.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rayfix_service.fusion.measurements.likelihood import ONE_GAUSSIAN, Spread, spreads
from rayfix_service.fusion.measurements.report import GAUSSIAN, ErrorModel
from rayfix_tables.errors import ReportError

ALONE = "a time of arrival from a single station does not constrain the position: the UE's clock is unknown"
FAR = "the time is farther from the others of its clock than any path is long"

_CONTRADICTION = 5.0
"""Differences that go round a loop add up to zero within this many of their standard deviations."""


@dataclass(frozen=True, kw_only=True)
class ClockReading:
    """A time of arrival as a length, m: path length + offset of a clock + noise.

    Attributes
    ----------
    clock : int
    offset : float, m
    variance : float, m2
    spreads : tuple of Spread
        Gaussians that the noise may be of.
    """

    clock: int
    offset: float
    variance: float
    spreads: tuple[Spread, ...] = ONE_GAUSSIAN


@dataclass(frozen=True, kw_only=True)
class Arrival:
    """A time of arrival on some clock.

    Attributes
    ----------
    index : int or None
        Index in the report; None for one that time differences are equivalent to.
    differences : tuple of int
        Indices of those differences.
    """

    station_id: str
    offset: float
    variance: float
    error_model: ErrorModel = GAUSSIAN
    index: int | None = None
    differences: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A time difference as a length, m: arrival at ``station_id`` minus arrival at ``reference_id``."""

    index: int
    station_id: str
    reference_id: str
    value: float
    variance: float
    error_model: ErrorModel


@dataclass(frozen=True, kw_only=True)
class Clocks:
    """Readings of all clocks that more than one station reads.

    Attributes
    ----------
    readings : tuple of (Arrival, ClockReading)
    num_clocks : int
    unused : mapping of int to str
        Why measurements could not be used, by their indices in the report.
    """

    readings: tuple[tuple[Arrival, ClockReading], ...]
    num_clocks: int
    unused: Mapping[int, str]


def read_clocks(clocks: Sequence[Sequence[Arrival]], max_path_length: float) -> Clocks:
    """Leave out arrivals that cannot be, and number the clocks of which more than one station is left.

    Parameters
    ----------
    max_path_length : float, m
        Longest path of the table.
    """
    readings: list[tuple[Arrival, ClockReading]] = []
    unused: dict[int, str] = {}
    num_clocks = 0
    for clock in clocks:
        near = _near_each_other(clock, max_path_length)
        if len({row.station_id for row in near}) < 2:
            near = []
        without_effect = _without_effect(clock, near)
        # A difference between two dropped arrivals may connect those that are left, all of which then depend on it.
        own = without_effect.union(*(row.differences for row in near))
        linking = tuple(sorted({index for row in clock for index in row.differences} - own))
        for row in near:
            reading = ClockReading(
                clock=num_clocks, offset=row.offset, variance=row.variance, spreads=spreads(row.error_model)
            )
            readings.append((replace(row, differences=(*row.differences, *linking)), reading))
        num_clocks += bool(near)
        reason = ALONE if len({row.station_id for row in clock}) == 1 else FAR
        unused.update(dict.fromkeys(without_effect, reason))
    return Clocks(readings=tuple(readings), num_clocks=num_clocks, unused=unused)


def _without_effect(clock: Sequence[Arrival], near: Sequence[Arrival]) -> set[int]:
    """Find the measurements of a clock that connect none of the arrivals near each other, by their indices."""
    kept = {(row.index, row.station_id) for row in near}
    removed = [row for row in clock if (row.index, row.station_id) not in kept]
    dropped = {row.index for row in removed if row.index is not None}
    if not near:
        return dropped.union(*(row.differences for row in clock))
    while True:
        # A dropped arrival may still connect two that are kept, unless only one of its differences is left.
        ends = [left for row in removed if len(left := set(row.differences) - dropped) == 1]
        if not ends:
            return dropped
        dropped.update(*ends)


def clocks_of_differences(differences: Sequence[Difference]) -> list[list[Arrival]]:
    """Turn time differences into times of arrival, one clock for each set of stations that they connect.

    The arrivals are the differences' least squares; their variances such that those of two stations add up to the
    variance of the difference between them, half of the smallest falling to either side. Where a loop of differences
    measures the distance of two arrivals more than once, only the least noisy differences that connect all stations
    determine the variances: further ones of the same arrivals are not independent.

    Raises
    ------
    ReportError
        When differences contradict each other.
    """
    tree, groups = _least_noisy_tree(differences)
    variances = _variances(tree)
    clocks = []
    for names in groups:
        mine = [d for d in differences if d.station_id in names]
        offsets = _least_squares(names, mine)
        clocks.append(
            [
                Arrival(
                    station_id=name,
                    offset=offsets[name],
                    variance=variances[name],
                    error_model=min(d.error_model for d in mine if name in (d.station_id, d.reference_id)),
                    differences=tuple(d.index for d in mine if name in (d.station_id, d.reference_id)),
                )
                for name in names
            ]
        )
    return clocks


def _least_noisy_tree(differences: Sequence[Difference]) -> tuple[list[Difference], list[list[str]]]:
    """Give the least noisy differences that connect what all of them connect (Kruskal), and the stations connected."""
    group: dict[str, list[str]] = {}
    tree = []
    # By name where the noise is the same, so that the order of the report does not matter.
    for d in sorted(differences, key=lambda d: (d.variance, *sorted((d.station_id, d.reference_id)))):
        first = group.setdefault(d.station_id, [d.station_id])
        second = group.setdefault(d.reference_id, [d.reference_id])
        if first is not second:
            first += second
            group.update(dict.fromkeys(second, first))
            tree.append(d)
    return tree, list({id(names): names for names in group.values()}.values())


def _variances(tree: Sequence[Difference]) -> dict[str, float]:
    """Variance of the arrival at each station, m2."""
    incident: defaultdict[str, list[Difference]] = defaultdict(list)
    for d in tree:
        incident[d.station_id].append(d)
        incident[d.reference_id].append(d)
    half = {name: 0.5 * min(d.variance for d in rows) for name, rows in incident.items()}
    variances = dict(half)
    for name, rows in incident.items():
        for d in rows:
            other = d.station_id if name == d.reference_id else d.reference_id
            left = d.variance - half[name] - half[other]
            # A difference noisier than its arrivals must be: a station that has no other difference takes all of that.
            if len(incident[name]) == 1:
                variances[name] = half[name] + left
            elif len(incident[other]) > 1:
                variances[name] = max(variances[name], half[name] + 0.5 * left)
    return variances


def _least_squares(names: Sequence[str], differences: Sequence[Difference]) -> dict[str, float]:
    """Arrivals, m, whose differences are nearest to those measured; that at the first station is zero."""
    index = {name: n for n, name in enumerate(names)}
    rows = np.zeros((len(differences), len(names)))
    for n, d in enumerate(differences):
        rows[n, index[d.station_id]], rows[n, index[d.reference_id]] = 1.0, -1.0
    value = np.array([d.value for d in differences])
    stdev = np.sqrt([d.variance for d in differences])
    arrivals = np.zeros(len(names))
    solution = np.linalg.lstsq(rows[:, 1:] / stdev[:, None], value / stdev, rcond=None)[0]
    arrivals[1:] = solution
    apart = np.abs(value - rows @ arrivals)
    allowed = _CONTRADICTION * stdev * [d.error_model.tail_scale for d in differences]
    # The rounding error of large numbers is no contradiction.
    worst = int(np.argmax(apart - allowed - 1e-9 * np.abs(value)))
    if apart[worst] > allowed[worst] + 1e-9 * abs(value[worst]):
        d = differences[worst]
        others = ", ".join(str(other.index) for other in differences if other is not d)
        raise ReportError(
            f"measurements[{d.index}], the time difference of '{d.station_id}' to '{d.reference_id}', contradicts the "
            f"other time differences (measurements {others}) by {apart[worst]:.3g} m; each is t(station) - t(reference "
            "station): check signs and pairs, or send one difference for each station but one",
            path=("measurements", d.index),
        )
    return dict(zip(names, arrivals.tolist(), strict=True))


def _near_each_other(clock: Sequence[Arrival], max_path_length: float) -> list[Arrival]:
    """Subtract the weighted median from times of arrival, and leave out those farther from it than paths can be long.

    The clock's offset is then no longer than a path, whatever the clock shows, and squares keep their precision.
    """
    if not clock:
        return []
    rows = sorted(clock, key=lambda row: row.offset)
    weight = np.cumsum([1.0 / row.variance for row in rows])
    middle = rows[int(np.searchsorted(weight, 0.5 * weight[-1]))]
    return [
        replace(row, offset=row.offset - middle.offset)
        for row in clock
        if abs(row.offset - middle.offset)
        <= 2.0 * max_path_length + 10.0 * (math.sqrt(row.variance) + math.sqrt(middle.variance))
    ]
