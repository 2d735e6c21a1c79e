"""Find a constant turn of azimuths that makes the measurements of an inconsistent report agree.

Stations that are mounted otherwise than the site file says, a wrong north and azimuths that another system counts from
elsewhere turn angles about the vertical by a constant. Two hypotheses are tested: one station is turned, or all are by
the same angle. Each is proposed by geometry and must then make the report "ok" in a fix of its own.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rayfix_service.fusion.diagnosis.common_turn import ProposedTurn, common_turns
from rayfix_service.fusion.measurements.directions import to_scene, without_bias
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_tables.geometry.angles import angles_of, wrap_one
from rayfix_tables.site import SiteInfo, Station

Relocate = Callable[[Report, Mapping[str, float]], Fix]
"""Locates a report with the angles of some stations turned about the vertical, rad counter-clockwise, by station."""

_MOST_COMMON = 3
"""Common turns that geometry may propose."""

_LEAST_GAIN = 6.0
"""nats; log evidence that a turn must bring. A turn that is known to 1 deg of 360 is itself worth about this."""

_MOST_OUTLIER = 0.2
"""Probability that a measurement may still be an outlier after the turn."""

_MARGIN = 3.0
"""nats; turns whose evidence is this near to the best one's are stated as well."""

_MOST_DEVIATIONS = 3.0
"""Standard deviations by which what is measured may differ from the straight path."""

_LEAST_TURN = 2.0
"""Standard deviations of the azimuth; less is no turn."""


class Turn(NamedTuple):
    """A turn that makes a report agree.

    Attributes
    ----------
    station_id : str or None
        None where it is of all stations.
    angle : float, rad
        Counter-clockwise from above, to be added to the reported azimuths.
    stdev : float, rad
        Its standard deviation.
    log_evidence : float
        Of the report after the turn.
    """

    station_id: str | None
    angle: float
    stdev: float
    log_evidence: float


def find_turns(report: Report, fix: Fix, site: SiteInfo, relocate: Relocate, *, most_fixes: int) -> tuple[Turn, ...]:
    """Find the turns that make an inconsistent report agree, the best first.

    Parameters
    ----------
    report : Report
    fix : Fix
        Of that report.
    site : SiteInfo
    relocate : callable
        See :data:`Relocate`.
    most_fixes : int
        Times that it may be called.
    """
    found: list[Turn] = []
    stations = list(dict.fromkeys(m.station_id for m in report.measurements if isinstance(m, Angle)))
    common = common_turns(report, site, most=min(_MOST_COMMON, most_fixes)) if len(stations) > 1 else []
    for turn in common:
        turned = relocate(report, dict.fromkeys(stations, turn.angle))
        if _agrees(turned, fix):
            found.append(Turn(None, *turn, turned.log_evidence))
    left = most_fixes - len(common)
    for station_id in sorted(stations, key=lambda name: -_worst(report, fix, name))[: left // 2]:
        if (single := _single_turn(report, site, station_id, relocate)) is not None:
            turned = relocate(report, {station_id: single.angle})
            if _agrees(turned, fix):
                found.append(Turn(station_id, *single, turned.log_evidence))
    found.sort(key=lambda turn: -turn.log_evidence)
    rivals = tuple(turn for turn in found if turn.log_evidence >= found[0].log_evidence - _MARGIN)
    return rivals if len({turn.station_id for turn in rivals}) == len(rivals) else ()  # two turns of one: it is open


def turn_warning(turns: tuple[Turn, ...]) -> str:
    """Say which turns make a report agree, and what to check.

    Parameters
    ----------
    turns : tuple of Turn
        At least one.
    """
    whose = ["all stations" if turn.station_id is None else f"station '{turn.station_id}'" for turn in turns]
    named = [
        f"the angles of {who} by {np.rad2deg(turn.angle):+.0f} +- {max(np.rad2deg(turn.stdev), 1.0):.0f} deg"
        for who, turn in zip(whose, turns, strict=True)
    ]
    check = "the site file's boresight_azimuth_deg or orientation_deg"
    if any(turn.station_id is None for turn in turns):
        check += ", north_deg, and from where and which way azimuths are counted"
    return (
        "the measurements would agree if one turned, counter-clockwise seen from above, "
        f"{', or '.join(named)}; check {check}"
    )


def turned_report(report: Report, site: SiteInfo, turns: Mapping[str, float]) -> tuple[Report, SiteInfo]:
    """Turn the angles of some stations about the vertical.

    Parameters
    ----------
    turns : Mapping of str to float, rad
        Counter-clockwise, by station.

    Returns
    -------
    report : Report
        With turned azimuths of the frames "scene" and "north".
    site : SiteInfo
        With turned stations, for the frame "lcs".
    """
    measurements = tuple(
        replace(m, azimuth=wrap_one(m.azimuth + turns[m.station_id]))
        if isinstance(m, Angle) and m.frame != "lcs" and m.station_id in turns
        else m
        for m in report.measurements
    )
    stations = tuple(_turned_station(s, turns[s.id]) if s.id in turns else s for s in site.stations)
    return replace(report, measurements=measurements), replace(site, stations=stations)


def _turned_station(station: Station, angle: float) -> Station:
    bearing, downtilt, slant = station.orientation
    return replace(station, orientation=(bearing + angle, downtilt, slant))


def _single_turn(report: Report, site: SiteInfo, station_id: str, relocate: Relocate) -> ProposedTurn | None:
    """Turn that points a station's first angle at the fix of all else; None where there is none, or nothing to test."""
    mine = [m for m in report.measurements if m.station_id == station_id]
    first = next(m for m in mine if isinstance(m, Angle))
    # A turn fits any azimuth. Something else of the station must agree as well, or it says nothing.
    if first.zenith is None and len(mine) == 1:
        return None
    rest = tuple(m for m in report.measurements if not (isinstance(m, Angle) and m.station_id == station_id))
    if not any(m.station_id != station_id for m in rest):
        return None
    others = relocate(replace(report, measurements=rest), {})
    if others.status != "ok" or others.position is None:
        return None
    station = site.station_by_id[station_id]
    measured = to_scene(without_bias(first, station), station, site.north)
    if measured.azimuth is None or (measured.zenith is None and measured.local is not None):
        return None
    apart = others.position - np.array(station.position)
    azimuth, zenith = angles_of(apart)
    angle = wrap_one(float(azimuth) - measured.azimuth)
    if abs(angle) <= _LEAST_TURN * first.azimuth_stdev:
        return None
    # Behind reflections too many turns would agree: so the path must be the straight one by all else that is measured.
    distance = float(np.linalg.norm(apart))
    spread = float(np.sqrt(np.linalg.eigvalsh(others.candidates[0].covariance)[-1]))
    if measured.zenith is not None:
        allowed = _MOST_DEVIATIONS * float(np.hypot(np.sqrt(measured.cov[1, 1]), spread / distance))
        if abs(measured.zenith - float(zenith)) > allowed:
            return None
    for one in mine:
        if isinstance(one, Range):
            late = one.path_length - station.bias.range - distance
            if abs(late) > _MOST_DEVIATIONS * float(np.hypot(one.stdev, spread)):
                return None
    return ProposedTurn(angle, math.hypot(first.azimuth_stdev, spread / (distance * max(math.sin(zenith), 0.1))))


def _agrees(turned: Fix, fix: Fix) -> bool:
    """Whether a report agrees after a turn, every measurement of it, and is far more probable than before."""
    agree = all((outcome.outlier_probability or 0.0) < _MOST_OUTLIER for outcome in turned.outcomes)
    return agree and turned.status == "ok" and turned.log_evidence > fix.log_evidence + _LEAST_GAIN


def _worst(report: Report, fix: Fix, station_id: str) -> float:
    """How probable it is that an angle of a station is an outlier."""
    return max(
        outcome.outlier_probability or 0.0
        for measurement, outcome in zip(report.measurements, fix.outcomes, strict=True)
        if isinstance(measurement, Angle) and measurement.station_id == station_id
    )
