"""Measurements of known positions beside the paths that the twin has there."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.truth.forward import ForwardSolver, Paths, StationSolver
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_tables.geometry.angles import angles_of, direction, local_to_scene
from rayfix_tables.site import SiteInfo, Station

__all__ = ["AngleErrors", "KnownReport", "RangeErrors", "StationErrors", "errors_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class KnownReport:
    """A report of a known position.

    Attributes
    ----------
    position : tuple of 3 floats, m
    seconds : float, s
        Time of the report.
    place : int
        Number of the place, or of the stretch of a path; reports of one place are left out together.
    """

    report: Report
    position: tuple[float, float, float]
    seconds: float
    place: int


@dataclass(frozen=True, kw_only=True, eq=False)
class AngleErrors:
    """Angles of one station in one frame, beside the path that each is most probably of; n of them.

    Attributes
    ----------
    local : bool
        Whether they are of the station's own frame, so that a turn of the station shows in them.
    true : ndarray of shape (n, 2), deg
        Azimuth and zenith of the path, in the frame of the reports.
    error : ndarray of shape (n, 2), deg
        Measured minus that; NaN for a zenith that was not measured.
    stated : ndarray of shape (n, 2), deg
        Deviations that the reports state.
    seconds : ndarray of shape (n,), s
    place : ndarray of int of shape (n,)
    """

    local: bool
    true: Array
    error: Array
    stated: Array
    seconds: Array
    place: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeErrors:
    """Propagation times of one station as lengths, beside the path that each is most probably of; n of them.

    Attributes
    ----------
    true, error, stated : ndarray of shape (n,), m
    seconds : ndarray of shape (n,), s
    place : ndarray of int of shape (n,)
    """

    true: Array
    error: Array
    stated: Array
    seconds: Array
    place: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class StationErrors:
    """All that a log of known positions says of one station; None where it measured nothing of the kind.

    Attributes
    ----------
    without_path : int
        Measurements at places to which the twin has no path.
    """

    station: Station
    angles: AngleErrors | None
    ranges: RangeErrors | None
    without_path: int


@dataclass
class _Rows:
    angles: list[tuple[float, ...]] = field(default_factory=list)
    frames: set[str] = field(default_factory=set)
    ranges: list[tuple[float, ...]] = field(default_factory=list)
    without_path: int = 0


def errors_of(reports: Iterable[KnownReport], site: SiteInfo, solver: ForwardSolver) -> dict[str, StationErrors]:
    """Compare the measurements of known positions with the paths of the twin.

    Each angle and time is compared with the path that it is most probably of, given its stated deviation and the
    path-selection prior of the site. The deviation counts more than twice, since systematic errors come on top.

    Parameters
    ----------
    reports : iterable of KnownReport
    site : SiteInfo
        As it is; its biases are not taken off.
    solver : ForwardSolver
        Of the site's scene.

    Returns
    -------
    dict of StationErrors
        By station, those that measured something.
    """
    exponent = _exponent(site)
    solvers = {station.id: solver.station(station.position) for station in site.stations}
    paths_at: dict[tuple[str, tuple[float, float, float]], Paths] = {}
    rows = {station.id: _Rows() for station in site.stations}
    for known in reports:
        for measurement in known.report.measurements:
            if not isinstance(measurement, Angle | Range) or measurement.station_id not in rows:
                continue
            station = site.station_by_id[measurement.station_id]
            mine = rows[station.id]
            paths = _paths(paths_at, solvers[station.id], station.id, known.position)
            if not len(paths):
                mine.without_path += 1
                continue
            prior = exponent * paths.gain_db * (math.log(10.0) / 10.0)
            when = (known.seconds, float(known.place))
            if isinstance(measurement, Range):
                apart = measurement.path_length - paths.path_length
                n = int(np.argmax(prior - 0.5 * np.square(apart / (2.0 * measurement.stdev + 0.3))))
                mine.ranges.append((float(paths.path_length[n]), float(apart[n]), measurement.stdev, *when))
                continue
            mine.frames.add(measurement.frame)
            mine.angles.append((*_angle_row(measurement, station, site.north, paths, prior), *when))
    return {
        station.id: StationErrors(
            station=station,
            angles=_angles(rows[station.id]),
            ranges=_ranges(rows[station.id].ranges),
            without_path=rows[station.id].without_path,
        )
        for station in site.stations
        if rows[station.id].angles or rows[station.id].ranges or rows[station.id].without_path
    }


def turn_derivatives(true_deg: Array) -> Array:
    """Change of local azimuth and zenith with a small turn of the station about its own axes.

    Parameters
    ----------
    true_deg : ndarray of shape (n, 2), deg
        Local azimuth and zenith.

    Returns
    -------
    ndarray of shape (2, n, 3)
        Of azimuth and zenith, deg for a turn of one deg about x, y and z. A turned station sees a still target move
        the other way.
    """
    azimuth, zenith = np.deg2rad(true_deg).T
    sine, cosine = np.sin(azimuth), np.cos(azimuth)
    tangent = np.maximum(np.tan(np.clip(zenith, 0.05, np.pi - 0.05) - 0.5 * np.pi), -20.0)
    # d = (cos a sin z, sin a sin z, cos z); dd = -w x d.
    of_azimuth = np.stack([-cosine * tangent, -sine * tangent, -np.ones_like(azimuth)], axis=-1)
    of_zenith = np.stack([sine, -cosine, np.zeros_like(azimuth)], axis=-1)
    return np.stack([of_azimuth, of_zenith])


def _exponent(site: SiteInfo) -> float:
    propagation = site.document.get("propagation", {})
    return float(propagation.get("path_prior_exponent", 2.0)) if propagation.get("path_prior") == "power" else 0.0


def _paths(
    known: dict[tuple[str, tuple[float, float, float]], Paths],
    solver: StationSolver,
    station_id: str,
    position: tuple[float, float, float],
) -> Paths:
    key = station_id, position
    if key not in known:
        if len(known) > 20_000:
            known.clear()
        known[key] = solver.paths(position)
    return known[key]


def _angle_row(
    angle: Angle, station: Station, north: float, paths: Paths, prior: Array
) -> tuple[float, float, float, float, float, float]:
    """Return true direction, error and stated deviation of an angle, deg, by its most probable path."""
    azimuth, zenith = paths.azimuth, paths.zenith
    if angle.frame == "lcs":
        azimuth, zenith = angles_of(direction(azimuth, zenith) @ local_to_scene(station.orientation))
    elif angle.frame == "north":
        azimuth = azimuth - north
    off = (angle.azimuth - azimuth + np.pi) % (2.0 * np.pi) - np.pi
    cost = np.square(off * np.sin(zenith) / (2.0 * angle.azimuth_stdev + 0.05))
    up, stated_up = np.full(len(off), np.nan), np.nan
    if angle.zenith is not None and angle.zenith_stdev is not None:
        up, stated_up = angle.zenith - zenith, angle.zenith_stdev
        cost = cost + np.square(up / (2.0 * stated_up + 0.05))
    n = int(np.argmax(prior - 0.5 * cost))
    wrapped = (azimuth[n] + np.pi) % (2.0 * np.pi) - np.pi
    values = np.rad2deg([wrapped, zenith[n], off[n], up[n], angle.azimuth_stdev, stated_up])
    a, b, c, d, e, f = (float(v) for v in values)
    return a, b, c, d, e, f


def _angles(rows: _Rows) -> AngleErrors | None:
    if not rows.angles:
        return None
    table = np.array(rows.angles)
    return AngleErrors(
        local=rows.frames == {"lcs"},
        true=table[:, 0:2],
        error=table[:, 2:4],
        stated=table[:, 4:6],
        seconds=table[:, 6],
        place=table[:, 7].astype(np.int64),
    )


def _ranges(rows: list[tuple[float, ...]]) -> RangeErrors | None:
    if not rows:
        return None
    table = np.array(rows)
    return RangeErrors(
        true=table[:, 0],
        error=table[:, 1],
        stated=table[:, 2],
        seconds=table[:, 3],
        place=table[:, 4].astype(np.int64),
    )
