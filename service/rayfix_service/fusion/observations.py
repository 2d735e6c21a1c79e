"""Sort a report's measurements by the path they are about."""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rayfix_service.fusion.lookup import NO_DIRECTION, Direction
from rayfix_service.fusion.report import Angle, Range, Report, TimeDifference, TimeOfArrival
from rayfix_tables.angles import angles_of, direction, local_to_scene
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station

_ALONE = "a time of arrival from one station only says nothing: the UE's clock is unknown"
_FAR = "the time is farther from the others of its clock than any path is long"


@dataclass(frozen=True, kw_only=True)
class ClockReading:
    """A time of arrival as a length, m: path length + offset of a clock + noise."""

    clock: int
    offset: float
    variance: float


@dataclass(frozen=True, kw_only=True)
class Observation:
    """All that a report says of one path to one station.

    Attributes
    ----------
    lengths : tuple of (float, float)
        Measured path lengths [m] and their variances [m2].
    readings : tuple of ClockReading
    angle_index : int or None
        Place of the angle in the report.
    timing_indices : tuple of int
        Places of the measurements of time in the report.
    reference_of : tuple of int
        Places of the time differences of which the path is the reference.
    """

    station_id: str
    direction: Direction = NO_DIRECTION
    lengths: tuple[tuple[float, float], ...] = ()
    readings: tuple[ClockReading, ...] = ()
    angle_index: int | None = None
    timing_indices: tuple[int, ...] = ()
    reference_of: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class SortedReport:
    """Observations, the number of unknown clocks, and what could not be used, with the reason, by place."""

    observations: tuple[Observation, ...]
    num_clocks: int
    unused: Mapping[int, str]


@dataclass
class _Draft:
    """A station's observations in the making; a direction that cannot be used is None, and keeps its place."""

    directions: list[tuple[int, Direction] | None] = field(default_factory=list)
    lengths: list[tuple[int, float, float]] = field(default_factory=list)
    readings: list[tuple[int | None, ClockReading]] = field(default_factory=list)
    reference_of: list[int] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class _Arrival:
    """A time of arrival on some clock; ``index`` is None for the reference of time differences."""

    index: int | None
    station_id: str
    offset: float
    variance: float


def sort_report(report: Report, site: SiteInfo) -> SortedReport:
    """Group measurements by station and path.

    The k-th angle and the k-th propagation time of a station belong to one path; further propagation times, times of
    arrival and time differences belong to its first path. A set of time differences with one reference is a set of
    times of arrival on a clock of its own, of which the reference's reads zero: half of the smallest variance is then
    the reference's share, common to all, so that their noise is correlated as it is.

    Raises
    ------
    ReportError
        For a station that the table does not have.
    """
    stations = {station.id: station for station in site.stations}
    drafts: defaultdict[str, _Draft] = defaultdict(_Draft)
    arrivals: list[_Arrival] = []
    differences: defaultdict[str, list[_Arrival]] = defaultdict(list)
    unused: dict[int, str] = {}
    for index, measurement in enumerate(report.measurements):
        station = _station(stations, measurement.station_id, index, "station_id")
        match measurement:
            case Angle():
                measured = to_scene(measurement, station, site.north)
                inside = in_field_of_view(station, measured)
                drafts[station.id].directions.append((index, measured) if inside else None)
                if not inside:
                    unused[index] = f"the angle lies outside the field of view of station '{station.id}'"
            case Range():
                drafts[station.id].lengths.append((index, measurement.path_length, measurement.stdev**2))
            case TimeOfArrival(path_length=offset):
                arrivals.append(
                    _Arrival(index=index, station_id=station.id, offset=offset, variance=measurement.stdev**2)
                )
            case TimeDifference(reference_station_id=reference, length_difference=offset):
                _station(stations, reference, index, "reference_station_id")
                differences[reference].append(
                    _Arrival(index=index, station_id=station.id, offset=offset, variance=measurement.stdev**2)
                )
    clocks = [arrivals, *(_on_one_clock(reference, rows) for reference, rows in differences.items())]
    num_clocks = _read_clocks(clocks, site.max_path_length, drafts, unused)
    observations = [
        observation for station_id, draft in drafts.items() for observation in _observations(station_id, draft)
    ]
    return SortedReport(observations=tuple(observations), num_clocks=num_clocks, unused=unused)


def _read_clocks(
    clocks: list[list[_Arrival]], max_path_length: float, drafts: defaultdict[str, _Draft], unused: dict[int, str]
) -> int:
    """Give stations their readings of clocks; returns the number of clocks that more than one station reads."""
    num_clocks = 0
    for clock in clocks:
        near = _near_each_other(clock, max_path_length)
        if len({row.station_id for row in near}) > 1:
            near_indices = [row.index for row in near if row.index is not None]
            for row in near:
                reading = ClockReading(clock=num_clocks, offset=row.offset, variance=row.variance)
                drafts[row.station_id].readings.append((row.index, reading))
                if row.index is None:
                    drafts[row.station_id].reference_of += near_indices
            num_clocks += 1
            left_out = {row.index for row in clock if row.index is not None}.difference(near_indices)
            unused.update(dict.fromkeys(left_out, _FAR))
        else:
            alone = len({row.station_id for row in clock}) == 1
            unused.update({row.index: _ALONE if alone else _FAR for row in clock if row.index is not None})
    return num_clocks


def _on_one_clock(reference: str, differences: list[_Arrival]) -> list[_Arrival]:
    """Turn differences to one reference into times of arrival."""
    shared = 0.5 * min(row.variance for row in differences)
    return [
        _Arrival(index=None, station_id=reference, offset=0.0, variance=shared),
        *(replace(row, variance=row.variance - shared) for row in differences),
    ]


def _near_each_other(clock: list[_Arrival], max_path_length: float) -> list[_Arrival]:
    """Count times of arrival from their middle and leave out those farther from it than paths can make them.

    Counted so, the clock's offset is a mere path length whatever the clock shows, and squares keep their precision.
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


def to_scene(angle: Angle, station: Station, north: float) -> Direction:
    """Turn a measured angle into the scene frame, its covariance included.

    Parameters
    ----------
    north : float, rad
        Azimuth of geographic north in the scene frame; in the frame "north" azimuths count from there.
    """
    azimuth_variance = angle.azimuth_stdev**2
    if angle.zenith is None or angle.zenith_stdev is None:
        turn = {"scene": 0.0, "north": north, "lcs": station.orientation[0]}[angle.frame]
        return Direction(azimuth=angle.azimuth + turn, zenith=None, cov=np.diag([azimuth_variance, np.inf]))
    cov = np.diag([azimuth_variance, angle.zenith_stdev**2])
    if angle.frame == "scene":
        return Direction(azimuth=angle.azimuth, zenith=angle.zenith, cov=cov)
    if angle.frame == "north":
        return Direction(azimuth=angle.azimuth + north, zenith=angle.zenith, cov=cov)
    rotation = local_to_scene(station.orientation)
    azimuth, zenith = (float(v) for v in angles_of(rotation @ direction(angle.azimuth, angle.zenith)))
    turned = _basis(azimuth, zenith).T @ rotation @ _basis(angle.azimuth, angle.zenith)
    local_sine, sine = np.sin(angle.zenith), max(np.sin(zenith), 1e-9)
    jacobian = np.diag([1.0 / sine, 1.0]) @ turned @ np.diag([local_sine, 1.0])
    return Direction(azimuth=azimuth, zenith=zenith, cov=jacobian @ cov @ jacobian.T)


def in_field_of_view(station: Station, measured: Direction) -> bool:
    """Whether a direction lies within the station's cone; one without zenith always counts as inside."""
    if station.field_of_view >= 2.0 * np.pi or measured.azimuth is None or measured.zenith is None:
        return True
    axis = local_to_scene(station.orientation)[:, 0]
    cosine = float(axis @ direction(measured.azimuth, measured.zenith))
    return bool(np.arccos(np.clip(cosine, -1.0, 1.0)) <= 0.5 * station.field_of_view)


def _basis(azimuth: float, zenith: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Give the unit vectors of growing azimuth and zenith, as columns, shape (3, 2)."""
    return np.array(
        [
            [-np.sin(azimuth), np.cos(zenith) * np.cos(azimuth)],
            [np.cos(azimuth), np.cos(zenith) * np.sin(azimuth)],
            [0.0, -np.sin(zenith)],
        ]
    )


def _observations(station_id: str, draft: _Draft) -> list[Observation]:
    count = max(len(draft.directions), 1)
    observations = []
    for k in range(count):
        angle = draft.directions[k] if k < len(draft.directions) else None
        lengths = draft.lengths[k : k + 1] + (draft.lengths[count:] if k == 0 else [])
        readings = draft.readings if k == 0 else []
        if angle is None and not lengths and not readings:
            continue
        observations.append(
            Observation(
                station_id=station_id,
                direction=angle[1] if angle else NO_DIRECTION,
                lengths=tuple((length, variance) for _, length, variance in lengths),
                readings=tuple(reading for _, reading in readings),
                angle_index=angle[0] if angle else None,
                timing_indices=(
                    *(i for i, *_ in lengths),
                    *(i for i, _ in readings if i is not None),
                ),
                reference_of=tuple(draft.reference_of) if k == 0 else (),
            )
        )
    return observations


def _station(stations: Mapping[str, Station], station_id: str, index: int, name: str) -> Station:
    if station_id not in stations:
        known = ", ".join(list(stations)[:10]) + (", ..." if len(stations) > 10 else "")
        raise ReportError(
            f"station '{station_id}' is not in the table; it has {known}", path=("measurements", index, name)
        )
    return stations[station_id]
