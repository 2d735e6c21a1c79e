"""Where targets really were: places with times, or way-points between which they moved evenly."""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix_service.measuring.timestamps import utc_moment
from rayfix_tables.errors import ReportError

__all__ = ["Stay", "Truth", "read_truth"]

_UNITS = {"": None, "_s": 1, "_ms": 1_000, "_us": 1_000_000, "_ns": 1_000_000_000}

LONGEST_GAP = 2.0
"""Seconds between two points of a path, up to which the target is taken to have moved evenly from one to the other."""


SAME_PLACE = 0.25
"""Metres up to which points that follow each other are of one place: a target at rest, in several rows."""


@dataclass(frozen=True, kw_only=True)
class Stay:
    """A target at rest.

    Attributes
    ----------
    begin, end : float, s
        Since 1970.
    """

    begin: float
    end: float
    position: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Track:
    """Stays, ascending and apart from each other, and points of a path with the number of the place of each."""

    stays: tuple[Stay, ...]
    times: NDArray[np.float64]
    points: NDArray[np.float64]
    places: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """True positions of targets.

    Attributes
    ----------
    tracks : Mapping
        By target; that of None is for targets that have no own.
    longest_gap : float, s
        Between points of a path.
    unread : tuple of str
        Columns that were not read.
    """

    tracks: Mapping[str | None, _Track]
    longest_gap: float = LONGEST_GAP
    unread: tuple[str, ...] = ()

    def at(self, target_id: str | None, seconds: float) -> tuple[NDArray[np.float64], int] | None:
        """Position of a target at a time, shape (3,), m, and the number of the place; None where unknown.

        A place is a stay, or the points of a path that follow each other within ``SAME_PLACE``.
        """
        track = self.tracks.get(target_id) or self.tracks.get(None)
        if track is None:
            return None
        for number, stay in enumerate(track.stays):
            if stay.begin <= seconds <= stay.end:
                return np.array(stay.position), number
        n = int(np.searchsorted(track.times, seconds, side="right")) - 1
        if n < 0 or (n == len(track.times) - 1 and seconds > track.times[n]):
            return None
        if seconds == track.times[n]:
            return track.points[n].copy(), int(track.places[n])
        gap = float(track.times[n + 1] - track.times[n])
        if gap > self.longest_gap:
            return None
        share = (seconds - float(track.times[n])) / gap
        return track.points[n] + share * (track.points[n + 1] - track.points[n]), int(track.places[n])


def read_truth(path: Path, *, longest_gap: float = LONGEST_GAP) -> Truth:
    """Read the truth from a CSV file.

    Columns are x_m, y_m, z_m, optionally target_id, and either ``timestamp`` or ``start`` and ``end``. Times are RFC
    3339, or since 1970 where the name ends in the unit: ``timestamp_ms``, ``start_s``.

    Parameters
    ----------
    path : pathlib.Path
    longest_gap : float, s
        Between points, up to which the target is taken to have moved evenly; inf for way-points.

    Raises
    ------
    ReportError
        When the file cannot be read or a row is none.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8"
        raise ReportError(f"{path} cannot be read ({reason}); give a CSV file with true positions") from error
    rows = list(csv.DictReader(text.splitlines()))
    header = list(rows[0]) if rows else []
    time, begin, end = (_column(header, name) for name in ("timestamp", "start", "end"))
    missing = [name for name in ("x_m", "y_m", "z_m") if name not in header]
    if missing or not (time or (begin and end)):
        wanted = ", ".join(missing) or "timestamp, or start and end"
        raise ReportError(f"{path} has no {wanted}; give columns x_m, y_m, z_m and timestamp, or start and end")
    stays: dict[str | None, list[Stay]] = {}
    points: dict[str | None, list[tuple[float, ...]]] = {}
    for number, row in enumerate(rows, 2):
        try:
            target = row.get("target_id") or None
            position = tuple(_finite(row[name]) for name in ("x_m", "y_m", "z_m"))
            if begin and end:
                stay = Stay(begin=_time(begin, row), end=_time(end, row), position=position)  # type: ignore[arg-type]
                if stay.end < stay.begin:
                    raise ValueError("ends before it begins")
                stays.setdefault(target, []).append(stay)
            elif time:
                points.setdefault(target, []).append((_time(time, row), *position))
        except (ValueError, TypeError, OverflowError) as error:
            raise ReportError(
                f"{path}, line {number} is no place with a time ({error}); correct or remove it"
            ) from None
    tracks = {target: _track(stays.get(target, []), points.get(target, [])) for target in {**stays, **points}}
    read = {"x_m", "y_m", "z_m", "target_id", *((begin, end) if begin and end else (time,))}
    return Truth(tracks=tracks, longest_gap=longest_gap, unread=tuple(name for name in header if name not in read))


def _column(header: list[str], name: str) -> str | None:
    return next((name + unit for unit in _UNITS if name + unit in header), None)


def _time(column: str, row: Mapping[str, str]) -> float:
    """Read a time, s since 1970."""
    unit = next((per for suffix, per in _UNITS.items() if suffix and column.endswith(suffix)), None)
    text = row[column].strip()
    if unit is not None:
        return float(Fraction(text) / unit)
    has_zone = text[-1:] in "Zz" or text[-6:-5] in ("+", "-")
    return utc_moment(text if has_zone else f"{text}Z").timestamp()


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not a coordinate")
    return value


def _track(stays: list[Stay], points: list[tuple[float, ...]]) -> _Track:
    table = np.array(sorted(points)).reshape(-1, 4)
    keep = np.append(np.diff(table[:, 0]) > 0.0, True) if len(table) else np.zeros(0, bool)
    table = table[keep]
    ordered = tuple(sorted(stays, key=lambda stay: stay.begin))
    places = len(ordered) + _places(table[:, 1:])
    return _Track(stays=ordered, times=table[:, 0], points=table[:, 1:], places=places)


def _places(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Count places: a new one begins farther than ``SAME_PLACE`` from the first point of the last."""
    numbers = np.zeros(len(points), np.int64)
    first = 0
    for n in range(1, len(points)):
        apart = math.dist(points[n], points[first]) > SAME_PLACE
        first = n if apart else first
        numbers[n] = numbers[n - 1] + apart
    return numbers
