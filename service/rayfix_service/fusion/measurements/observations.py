"""Sort a report's measurements by the path they are about."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from rayfix_service.fusion.measurements.clocks import (
    Arrival,
    ClockReading,
    Difference,
    clocks_of_differences,
    read_clocks,
)
from rayfix_service.fusion.measurements.directions import (
    NO_DIRECTION,
    Direction,
    in_field_of_view,
    to_scene,
    without_bias,
)
from rayfix_service.fusion.measurements.likelihood import (
    ONE_GAUSSIAN,
    Spread,
    Term,
    gaussian_terms,
    log_normal_terms,
    spreads,
)
from rayfix_service.fusion.measurements.line_of_sight import los_probability
from rayfix_service.fusion.measurements.report import (
    Angle,
    LogRange,
    MeasuredPath,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_tables.errors import ReportError
from rayfix_tables.site import NO_BIAS, SiteInfo, Station

MOST_COMBINATIONS = 256
"""Combinations of Gaussians that the measurements of one path may be of: eight of heavy tails, or two powers."""


class Observation(NamedTuple):
    """All measurements of one path to one station.

    Attributes
    ----------
    angle_spreads : tuple of Spread
        Gaussians that the error of the direction may be of.
    lengths : tuple of tuple of Term
        Likelihood of each measured path length.
    length_bias_variance : float, m2
        Of the part of their errors that the lengths have in common.
    readings : tuple of ClockReading
    angle_index : int or None
        Index of the angle in the report.
    timing_indices : tuple of int
        Indices of the other measurements in the report.
    differences : tuple of int
        Indices of the time differences to which the path's arrival belongs; each belongs to two.
    los_probability : float or None
        Probability that the path is direct, as the receiver indicates it.
    """

    station_id: str
    direction: Direction = NO_DIRECTION
    angle_spreads: tuple[Spread, ...] = ONE_GAUSSIAN
    lengths: tuple[tuple[Term, ...], ...] = ()
    length_bias_variance: float = 0.0
    readings: tuple[ClockReading, ...] = ()
    angle_index: int | None = None
    timing_indices: tuple[int, ...] = ()
    differences: tuple[int, ...] = ()
    los_probability: float | None = None


class SortedReport(NamedTuple):
    """Observations, the number of unknown clocks, and why measurements could not be used, by their indices."""

    observations: tuple[Observation, ...]
    num_clocks: int
    unused: Mapping[int, str]


class _Seen(NamedTuple):
    """A direction and its index in the report."""

    angle_index: int
    direction: Direction
    spreads: tuple[Spread, ...]


@dataclass
class _Draft:
    """A station's observations in the making; a direction that cannot be used is None, which keeps the order."""

    station: Station
    directions: list[_Seen | None] = field(default_factory=list)
    lengths: list[tuple[int, tuple[Term, ...]]] = field(default_factory=list)
    readings: list[tuple[Arrival, ClockReading]] = field(default_factory=list)


def sort_report(report: Report, site: SiteInfo) -> SortedReport:
    """Group measurements by station and path, without the biases of the stations.

    The k-th angle and the k-th propagation time (or signal strength) of a station belong to one path; further
    propagation times, times of arrival and time differences belong to its first path.

    Raises
    ------
    ReportError
        For a station that the table does not have, a measurement sent twice, time differences that contradict each
        other, or too many measurements of one path whose errors are not Gaussian.
    """
    stations = site.station_by_id
    drafts: dict[str, _Draft] = {}
    arrivals: list[Arrival] = []
    differences: list[Difference] = []
    unused: dict[int, str] = {}
    for index, measurement in enumerate(report.measurements):
        station = _station(stations, measurement.station_id, index, "station_id")
        draft = drafts.get(station.id)
        if draft is None:
            draft = drafts[station.id] = _Draft(station=station)
        bias = station.bias
        match measurement:
            case MeasuredPath():
                pass  # the paths of a station are a set: see rayfix_service.fusion.quadrature.sets
            case Angle(error_model=model):
                measured = to_scene(without_bias(measurement, station), station, site.north)
                inside = in_field_of_view(station, measured)
                draft.directions.append(_Seen(index, measured, spreads(model)) if inside else None)
                if not inside:
                    unused[index] = f"the angle lies outside the field of view of station '{station.id}'"
            case Range(path_length=length, error_model=model):
                draft.lengths.append((index, gaussian_terms(length - bias.range, measurement.stdev, model)))
            case LogRange():
                # A signal strength involves no clock, so that the bias of ranges does not apply.
                draft.lengths.append((index, log_normal_terms(measurement.path_length, measurement.log_stdev)))
            case TimeOfArrival(path_length=offset, error_model=model):
                arrivals.append(
                    Arrival(
                        index=index,
                        station_id=station.id,
                        offset=offset,
                        variance=measurement.stdev**2,
                        error_model=model,
                    )
                )
            case TimeDifference(reference_station_id=reference, error_model=model):
                _station(stations, reference, index, "reference_station_id")
                drafts.setdefault(reference, _Draft(station=stations[reference]))
                differences.append(
                    Difference(
                        index=index,
                        station_id=station.id,
                        reference_id=reference,
                        value=measurement.length_difference,
                        variance=measurement.stdev**2,
                        error_model=model,
                    )
                )
    _refuse_repetitions(report)
    clocks = [arrivals] if arrivals else []
    if differences:
        clocks += clocks_of_differences(differences)
    num_clocks = 0
    if clocks:
        unbiased = [[_unbiased(arrival, stations[arrival.station_id]) for arrival in clock] for clock in clocks]
        read = read_clocks(unbiased, site.max_path_length)
        for arrival, reading in read.readings:
            drafts[arrival.station_id].readings.append((arrival, reading))
        unused |= read.unused
        num_clocks = read.num_clocks
    observations = [observation for draft in drafts.values() for observation in _observations(draft)]
    if los_probability(report.measurements) is not None:
        observations = [_with_line_of_sight(observation, report) for observation in observations]
    return SortedReport(tuple(observations), num_clocks, unused)


def _with_line_of_sight(observation: Observation, report: Report) -> Observation:
    indices = (observation.angle_index, *observation.timing_indices)
    indicated = los_probability(report.measurements[index] for index in indices if index is not None)
    return observation._replace(los_probability=indicated)


def _unbiased(arrival: Arrival, station: Station) -> Arrival:
    bias = station.bias
    if bias == NO_BIAS:
        return arrival
    return replace(arrival, offset=arrival.offset - bias.range, variance=arrival.variance + bias.range_stdev**2)


def _refuse_repetitions(report: Report) -> None:
    """Refuse a measurement that is sent twice: counted twice it would make the fix overconfident.

    Two paths of a station may well be of one length, so a length may be repeated once for each of its angles. Time
    differences may be repeated: they are of the same arrivals.
    """
    kinds = {(type(measurement), measurement.station_id) for measurement in report.measurements}
    if len(kinds) == len(report.measurements) or len(set(report.measurements)) == len(report.measurements):
        return
    paths: defaultdict[str, int] = defaultdict(int)
    for measurement in report.measurements:
        paths[measurement.station_id] += isinstance(measurement, Angle)
    indices_of: defaultdict[Measurement, list[int]] = defaultdict(list)
    for index, measurement in enumerate(report.measurements):
        if not isinstance(measurement, TimeDifference):
            indices_of[measurement].append(index)
    for measurement, indices in indices_of.items():
        allowed = paths[measurement.station_id] if isinstance(measurement, Range | LogRange) else 1
        if len(indices) > max(allowed, 1):
            raise ReportError(
                f"measurements[{indices[-1]}] repeats measurements[{indices[0]}]; send each measurement once",
                path=("measurements", indices[-1]),
            )


def _observations(draft: _Draft) -> list[Observation]:
    count = max(len(draft.directions), 1)
    observations = []
    for k in range(count):
        angle = draft.directions[k] if k < len(draft.directions) else None
        lengths = draft.lengths[k : k + 1] + (draft.lengths[count:] if k == 0 else [])
        readings = draft.readings if k == 0 else []
        if angle is None and not lengths and not readings:
            continue
        timing_indices = [index for index, _ in lengths]
        timing_indices += [arrival.index for arrival, _ in readings if arrival.index is not None]
        observation = Observation(
            station_id=draft.station.id,
            direction=angle.direction if angle else NO_DIRECTION,
            angle_spreads=angle.spreads if angle else ONE_GAUSSIAN,
            lengths=tuple([terms for _, terms in lengths]),
            length_bias_variance=draft.station.bias.range_stdev**2,
            readings=tuple([reading for _, reading in readings]),
            angle_index=angle.angle_index if angle else None,
            timing_indices=tuple(timing_indices),
            differences=tuple([index for arrival, _ in readings for index in arrival.differences]),
        )
        _refuse_too_many(observation)
        observations.append(observation)
    return observations


def _refuse_too_many(observation: Observation) -> None:
    combinations = len(observation.angle_spreads)
    for terms in observation.lengths:
        combinations *= len(terms)
    for reading in observation.readings:
        combinations *= len(reading.spreads)
    if combinations > MOST_COMBINATIONS:
        index = max((*observation.timing_indices, *observation.differences))
        raise ReportError(
            f"measurements[{index}] is one of too many measurements of one path to station '{observation.station_id}' "
            "whose errors are heavy-tailed or log-normal; leave some out, or take their mean",
            path=("measurements", index),
        )


def _station(stations: Mapping[str, Station], station_id: str, index: int, name: str) -> Station:
    if station_id not in stations:
        known = ", ".join(list(stations)[:10]) + (", ..." if len(stations) > 10 else "")
        raise ReportError(
            f"station '{station_id}' is not in the table; it has {known}", path=("measurements", index, name)
        )
    return stations[station_id]
