"""Options of a request for its answers: format, by query or Accept header, and whether targets are followed."""

from dataclasses import dataclass
from functools import cache

from starlette.types import Scope

from rayfix_service.adapters.formats import OutputFormat
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.http.headers import header
from rayfix_service.http.problems import INVALID_PARAMETER, ProblemError
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.wire import FieldProblem

JSON = "application/json"

MEDIA_TYPES: dict[str, OutputFormat] = {
    "application/vnd.rayfix+json": "native",
    "application/vnd.rayfix.3gpp+json": "3gpp",
    "application/vnd.rayfix.omlox+json": "omlox",
}
"""Media types by which an Accept header names a format."""


NO_TRACKS = (
    "track is true and this service has several workers, among which a target's reports would be split; serve with one "
    "worker, or one on each of several ports, balanced by target_id"
)


@dataclass(frozen=True, kw_only=True)
class ResponseOptions:
    """Options of a request.

    Attributes
    ----------
    output : {"native", "3gpp", "omlox"}
    media_type : str
        Of the answer.
    track : bool
        Whether targets are followed.
    must_track : bool
        Whether the request itself asks for it: a report that cannot be followed is then refused.
    with_report : bool
        Whether a native answer to another system's message has the report that it was turned into.
    """

    output: OutputFormat = "native"
    media_type: str = JSON
    track: bool = False
    must_track: bool = False
    with_report: bool = False

    def follows(self, report: Report) -> bool:
        """Whether a report is to be followed."""
        return self.track and (self.must_track or None not in (report.target_id, report.timestamp))


def response_options_of(
    scope: Scope, settings: ServiceSettings, output: OutputFormat | None = None, track: bool | None = None
) -> ResponseOptions:
    """Read the options of a request from its query, else from its Accept header and the service's settings.

    Raises
    ------
    ProblemError
        When targets are to be followed by one of several workers, each of which would have tracks of its own.
    """
    if track and settings.has_several_workers:
        raise ProblemError(INVALID_PARAMETER, NO_TRACKS, errors=(FieldProblem(path=("track",), message=NO_TRACKS),))
    media_type = JSON
    if output is None:
        media_type, output = _accepted(header(scope, b"accept"))
    return _wanted(output, media_type, settings.track if track is None else track, bool(track))


@cache
def _wanted(output: OutputFormat, media_type: str, track: bool, must_track: bool) -> ResponseOptions:
    return ResponseOptions(output=output, media_type=media_type, track=track, must_track=must_track)


def _accepted(accept: str | None) -> tuple[str, OutputFormat]:
    """Return the first format of the greatest weight that an Accept header names (RFC 9110, 12.5.1), or the native."""
    if accept is None or "rayfix" not in accept.lower():
        return JSON, "native"
    best, most = (JSON, MEDIA_TYPES["application/vnd.rayfix+json"]), 0.0
    for item in accept.lower().split(","):
        name, *parameters = (part.strip() for part in item.split(";"))
        if name == JSON:
            found: tuple[str, OutputFormat] = (JSON, "native")
        elif name in MEDIA_TYPES:
            found = (name, MEDIA_TYPES[name])
        else:
            continue
        weight = next((_weight(text[2:]) for text in parameters if text.startswith("q=")), 1.0)
        if weight > most:
            best, most = found, weight
    return best


def _weight(text: str) -> float:
    """Read a weight; 0 for a text that is none."""
    try:
        weight = float(text)
    except ValueError:
        return 0.0
    return weight if 0.0 <= weight <= 1.0 else 0.0
