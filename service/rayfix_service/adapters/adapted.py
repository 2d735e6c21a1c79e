"""A foreign message as a report of this project, with the way back to its fields."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

from pydantic import ValidationError

from rayfix_service.fusion.measurements.report import (
    CONFIDENCE,
    Angle,
    Height,
    Measurement,
    Report,
    TimeOfArrival,
)
from rayfix_service.wire import MAX_MEASUREMENTS, FieldProblem, InvalidReportError
from rayfix_service.wire.documents import HeightDocument
from rayfix_service.wire.limits import USUAL_LIMITS, MessageLimits
from rayfix_tables.errors import ReportError
from rayfix_tables.validation.problems import Path, path_text


@dataclass(frozen=True, kw_only=True)
class Skipped:
    """A measurement of the message that the report does not hold.

    Attributes
    ----------
    path : tuple of (str or int)
        Where it stands in the message.
    reason : str
        Why it is left out.
    """

    path: Path
    reason: str


@dataclass(frozen=True, kw_only=True)
class Adapted:
    """A report made from a message of another format.

    Attributes
    ----------
    report : Report
    sources : tuple of tuple of (str or int)
        Where in the message each measurement of ``report`` comes from, in its order.
    skipped : tuple of Skipped
        Measurements of the message that are not in ``report``.
    """

    report: Report
    sources: tuple[Path, ...]
    skipped: tuple[Skipped, ...] = ()


def adapted_report(
    measurements: list[tuple[Path, Measurement]],
    skipped: list[Skipped],
    *,
    target_id: str | None,
    timestamp: str | None,
    height: Height | None = None,
    confidence: float = CONFIDENCE,
    limits: MessageLimits = USUAL_LIMITS,
) -> Adapted:
    """Combine measurements and what was left out.

    Quantised as other systems' are, an angle or an arrival may well come twice; it is then counted once.

    Raises
    ------
    InvalidReportError
        When no measurement is left, with the reasons, or when there are too many.
    """
    if not measurements:
        problems = tuple(
            FieldProblem(path=skip.path, message=f"{path_text(skip.path)} is not used: {skip.reason}")
            for skip in skipped[: limits.listed_problems]
        )
        empty = FieldProblem(path=(), message="the message has no measurements; give at least one")
        raise InvalidReportError(problems or (empty,), len(skipped) - len(problems))
    if len(measurements) > MAX_MEASUREMENTS:
        text = f"the message has {len(measurements)} measurements; give at most {MAX_MEASUREMENTS} at once"
        raise InvalidReportError((FieldProblem(path=(), message=text),))
    first: dict[Measurement, Path] = {}
    kept: list[tuple[Path, Measurement]] = []
    repeated: list[Skipped] = []
    for path, measurement in measurements:
        if isinstance(measurement, Angle | TimeOfArrival) and measurement in first:
            repeated.append(Skipped(path=path, reason=f"repeats {path_text(first[measurement])}"))
            continue
        first.setdefault(measurement, path)
        kept.append((path, measurement))
    return Adapted(
        report=Report(
            measurements=tuple(m for _, m in kept),
            height=height,
            confidence=confidence,
            target_id=target_id,
            timestamp=timestamp,
        ),
        sources=tuple(path for path, _ in kept),
        skipped=(*skipped, *repeated),
    )


def station_of(name: str, *maps: Mapping[str, str] | None) -> str:
    """Return the station that another system calls `name`: by the first map that has it, else the name itself."""
    return next((stations[name] for stations in maps if stations and name in stations), name)


def with_height(adapted: Adapted, height: Height | None) -> Adapted:
    """Add the known height of the target to a report without one."""
    if height is None or adapted.report.height is not None:
        return adapted
    return replace(adapted, report=replace(adapted.report, height=height))


def with_confidence(adapted: Adapted, confidence: float | None) -> Adapted:
    """Ask for another probability with which accuracies are to hold; None leaves it to the report.

    Raises
    ------
    ReportError
        When it is out of range.
    """
    if confidence is None:
        return adapted
    if not 0.01 <= confidence <= 0.99:
        raise ReportError(f"confidence is {confidence:g}; give a probability from 0.01 to 0.99", path=("confidence",))
    return replace(adapted, report=replace(adapted.report, confidence=confidence))


def error_in_message(error: ReportError, adapted: Adapted) -> InvalidReportError:
    """Name in an error of the report the field of the message that it comes from."""
    source: Path = ()
    if len(error.path) > 1 and error.path[0] == "measurements" and isinstance(error.path[1], int):
        source = adapted.sources[error.path[1]]
    unknown = bool(error.path) and error.path[-1] in ("station_id", "reference_station_id")
    remedy = "; give the station in the map stations" if unknown else ""
    text = f"{path_text(source)}: {error}{remedy}" if source else str(error)
    return InvalidReportError((FieldProblem(path=source, message=text),))


def station_map(pairs: Iterable[str]) -> dict[str, str]:
    """Read ``NAME=STATION`` pairs of the command line or of a query.

    Raises
    ------
    ReportError
        For a pair that is none.
    """
    stations = {}
    for pair in pairs:
        name, equals, station = pair.rpartition("=")
        if not (name and equals and station):
            raise ReportError(
                f"station {pair!r} is no pair; give NAME=STATION, e.g. CD84C98B935D=bs1", path=("station",)
            )
        stations[name] = station
    return stations


def check_stations(stations: Mapping[str, str], known: Collection[str]) -> None:
    """Refuse a map to stations that a table does not have: else only the first message would show the mistake.

    Raises
    ------
    ReportError
    """
    for name, station in stations.items():
        if station not in known:
            raise ReportError(
                f"{name} is to be station '{station}', which is not in the table; it has {', '.join(known)}",
                path=("station",),
            )


def known_height(z: float | None, stdev: float | None) -> Height | None:
    """Read the height and its standard deviation, m, of the command line or of a query, where they are given.

    Raises
    ------
    ReportError
        When a number is out of range.
    """
    if z is None and stdev is None:
        return None
    try:
        return HeightDocument.model_validate({"z_m": z, "stdev_m": stdev}).height()
    except ValidationError:
        text = (
            f"height is {z} m with a standard deviation of {stdev} m; give both numbers, 0.001 or more for the second"
        )
        raise ReportError(text, path=("height",)) from None
