"""A report made from another system's message, and the field of the message that each measurement comes from."""

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
        Its path in the message.
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
        Path in the message of each measurement of ``report``, in the same order.
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
    """Make a report of converted measurements, and list those that were left out.

    Measurements of other systems are quantised, and two can be equal. Of equal angles or times of arrival, one is used.

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
    """Return the station of another system's `name`: that of the first map with this name, else the name itself."""
    return next((stations[name] for stations in maps if stations and name in stations), name)


def with_height(adapted: Adapted, height: Height | None) -> Adapted:
    """Add the known height of the target to a report without one."""
    if height is None or adapted.report.height is not None:
        return adapted
    return replace(adapted, report=replace(adapted.report, height=height))


def with_confidence(adapted: Adapted, confidence: float | None) -> Adapted:
    """Replace the report's probability that the stated accuracies hold; None keeps it.

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
    """Convert an error of the report: it then names the field of the original message."""
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
        When a pair has another form.
    """
    stations = {}
    for pair in pairs:
        name, equals, station = pair.rpartition("=")
        if not (name and equals and station):
            raise ReportError(
                f"station {pair!r} is not a pair; give NAME=STATION, e.g. CD84C98B935D=bs1", path=("station",)
            )
        stations[name] = station
    return stations


def check_stations(stations: Mapping[str, str], known: Collection[str]) -> None:
    """Check that all mapped stations are in the table; otherwise the mistake would only show with the first message.

    Raises
    ------
    ReportError
    """
    for name, station in stations.items():
        if station not in known:
            raise ReportError(
                f"{name} is mapped to station '{station}', which is not in the table; it has {', '.join(known)}",
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
