"""Conversion from and to formats by name, for the command line and the HTTP interface."""

from collections.abc import Mapping
from datetime import datetime
from typing import Any, Literal

from rayfix_service.adapters.adapted import Adapted, with_confidence, with_height
from rayfix_service.adapters.nrppa import parse_nrppa
from rayfix_service.adapters.omlox import fix_to_omlox
from rayfix_service.adapters.silabs import parse_silabs
from rayfix_service.adapters.threegpp import fix_to_3gpp
from rayfix_service.adapters.ublox import USUAL_ERRORS, AngleErrors, parse_ublox
from rayfix_service.fusion.measurements.report import Height
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.tracking.track import TrackedPosition
from rayfix_service.wire import fix_to_document, parse_report
from rayfix_tables.site import SiteInfo
from rayfix_tables.validation.problems import path_text

InputFormat = Literal["native", "nrppa", "silabs", "ublox"]
OutputFormat = Literal["native", "3gpp", "omlox"]


def parse(
    body: bytes,
    input_format: InputFormat,
    *,
    stations: Mapping[str, str] | None = None,
    height: Height | None = None,
    confidence: float | None = None,
    errors: AngleErrors = USUAL_ERRORS,
    received: datetime | None = None,
) -> tuple[Adapted, ...]:
    """Convert a message into reports: a single one, or one for each transmission of u-blox lines.

    Parameters
    ----------
    body : bytes
        The message.
    input_format : {"native", "nrppa", "silabs", "ublox"}
    stations : Mapping, optional
        Stations by their names in the message; the native format uses the stations' identifiers.
    height : Height, optional
        Known height of the target, for messages without one.
    confidence : float, optional
        Probability that the stated accuracies hold, instead of that of the message.
    errors : AngleErrors, optional
        Errors of the angles of u-blox lines, which do not state them.
    received : datetime, optional
        When the message was received; u-blox lines without a time are dated from it.

    Raises
    ------
    MalformedJsonError
        For bytes that are not JSON, when the format is JSON.
    InvalidReportError
        For a message that is not valid.
    ReportError
        For a confidence that is out of range.
    """
    if input_format == "ublox":
        found = parse_ublox(body, stations=stations, errors=errors, received=received)
    else:
        found = (_parse_one(body, input_format, stations),)
    return tuple(with_confidence(with_height(adapted, height), confidence) for adapted in found)


def _parse_one(
    body: bytes, input_format: Literal["native", "nrppa", "silabs"], stations: Mapping[str, str] | None
) -> Adapted:
    match input_format:
        case "native":
            report = parse_report(body)
            places = tuple(("measurements", n) for n in range(len(report.measurements)))
            return Adapted(report=report, sources=places)
        case "nrppa":
            return parse_nrppa(body, stations=stations)
        case "silabs":
            return parse_silabs(body, stations=stations)


def write(
    fix: Fix,
    output_format: OutputFormat,
    site: SiteInfo,
    *,
    compute_seconds: float,
    adapted: Adapted | None = None,
    track: TrackedPosition | None = None,
) -> dict[str, Any]:
    """Turn a fix into JSON-compatible data.

    Parameters
    ----------
    fix : Fix
    output_format : {"native", "3gpp", "omlox"}
    site : SiteInfo
        Site of the fix.
    compute_seconds : float
        Computing time of the fix, s.
    adapted : Adapted, optional
        The converted report, if it came in another format. The native answer then has the ``source`` of each
        measurement and the measurements that were ``skipped``.
    track : TrackedPosition, optional
        The target's track after the report. The native answer has both fix and track, other formats only the track.

    Raises
    ------
    ReportError
        When the fix has no position and the format needs one.
    """
    match output_format:
        case "3gpp":
            return fix_to_3gpp(fix, site, track)
        case "omlox":
            return fix_to_omlox(fix, site, track)
        case "native":
            document = fix_to_document(fix, compute_seconds, track)
            if adapted is not None:
                for outcome, source in zip(document["measurements"], adapted.sources, strict=True):
                    outcome["source"] = path_text(source)
                document["skipped"] = [
                    {"source": path_text(skip.path), "reason": skip.reason} for skip in adapted.skipped
                ]
            return document
