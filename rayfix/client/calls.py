"""Requests and answers as generators without I/O, which both clients drive.

A flow is a generator. It yields a :class:`Call`, for which the client sends it a :class:`Reply` or a :class:`NoReply`,
or it yields a :class:`Pause`. It returns the result of the method.
"""

import json
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from random import Random
from typing import Any, TypeVar
from urllib.parse import urlencode

from rayfix.client.models import FixAnswer, fix_answer
from rayfix.client.retries import RetryPolicy, is_temporary
from rayfix.errors import (
    AnswerError,
    ClientError,
    ProblemError,
    ProblemField,
    RefusedReportError,
    ReportError,
    UnreachableError,
)

T = TypeVar("T")

BATCH_REPORTS = 1000
"""Largest number of reports of a batch; the service accepts no more."""

BATCH_BYTES = 8 << 20
"""Largest size of a batch, bytes; the service accepts twice as many."""

MESSAGE_FORMATS = ("nrppa", "silabs")
"""Formats of other systems' messages that are JSON."""

_REPORT_PROBLEMS = frozenset({"urn:rayfix:problem:invalid-report", "urn:rayfix:problem:malformed-json"})
_JSON = {"content-type": "application/json"}


@dataclass(frozen=True, kw_only=True)
class Call:
    """One request."""

    method: str
    path: str
    query: Mapping[str, str] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes | None = None


@dataclass(frozen=True, kw_only=True)
class Reply:
    """An answer; names of headers are in lower case."""

    status: int
    headers: Mapping[str, str]
    body: bytes


@dataclass(frozen=True, kw_only=True)
class NoReply:
    """There was no answer, for the given reason."""

    reason: str


@dataclass(frozen=True, kw_only=True)
class Pause:
    """Time to wait, s."""

    seconds: float


Flow = Generator[Call | Pause, Reply | NoReply | None, T]


def request(call: Call, parse: Callable[[Any], T], policy: RetryPolicy, random: Random) -> Flow[T]:
    """Send a request, retry it if that may help, and read its answer.

    Raises
    ------
    ClientError
    """
    attempt = 0
    while True:
        attempt += 1
        reply = yield call
        assert reply is not None
        if isinstance(reply, Reply) and not is_temporary(reply.status):
            return read(reply, parse)
        wanted = reply.headers.get("retry-after") if isinstance(reply, Reply) else None
        pause = policy.pause(attempt, random, wanted)
        if pause is None:
            if isinstance(reply, NoReply):
                tries = "" if attempt == 1 else f" after {attempt} attempts"
                raise UnreachableError(f"the service does not answer{tries} ({reply.reason}); check its address")
            return read(reply, parse)
        yield Pause(seconds=pause)


def read(reply: Reply, parse: Callable[[Any], T]) -> T:
    """Read an answer.

    Raises
    ------
    ProblemError
        For a problem document.
    AnswerError
        For an answer that this service does not give.
    """
    try:
        document = json.loads(reply.body)
    except ValueError:
        document = None
    if 200 <= reply.status < 300:
        try:
            return parse(document)
        except (KeyError, TypeError, ValueError, AttributeError):
            text = "is not that of a rayfix service of this version; check the address"
            raise AnswerError(f"the answer (status {reply.status}) {text}") from None
    raise problem(document, reply.status)


def problem(document: Any, status: int) -> ProblemError | AnswerError:
    """Convert a problem document into an error."""
    try:
        errors = tuple(ProblemField(path=one["path"], message=one["message"]) for one in document["errors"])
        kind, detail = document["type"], document["detail"]
    except (KeyError, TypeError):
        return AnswerError(f"the answer has the status {status} and no problem document; check the address")
    error = RefusedReportError if kind in _REPORT_PROBLEMS else ProblemError
    return error(detail, kind=kind, status=status, errors=errors)


def stream_answer(message: str | bytes) -> FixAnswer | ProblemError:
    """Read the answer to a report on a stream.

    Raises
    ------
    AnswerError
        When it is neither a fix nor a problem.
    """
    try:
        return batch_answers({"results": [json.loads(message)]}, 1)[0]
    except (KeyError, TypeError, ValueError, AttributeError):
        raise AnswerError("an answer of the stream is not a fix; check the address") from None


def reason_of(error: Exception) -> str:
    """Return the reason why there is no answer."""
    return str(error) or type(error).__name__


def report_bytes(report: Any) -> bytes:
    """Write a report: a mapping of the JSON that ``POST /v1/positions`` takes, or a ``rayfix.Report``.

    Raises
    ------
    ReportError
        When a number of a ``rayfix.Report`` is out of its range. Once it is JSON, radians are degrees, and degrees that
        were given for radians would pass for an angle.
    """
    if not isinstance(report, Mapping):
        # A caller with such a report has this package.
        from rayfix_service.fusion.measurements.checks import check_report
        from rayfix_service.wire import report_to_document

        report = report_to_document(check_report(report))
    return json.dumps(report, separators=(",", ":")).encode()


def position_call(report: Any, query: Mapping[str, str]) -> Call:
    """Make the call for one report; a header names its target for proxies that route by target."""
    target = report.get("target_id") if isinstance(report, Mapping) else getattr(report, "target_id", None)
    headers = dict(_JSON)
    if isinstance(target, str) and target.isascii() and target.isprintable():
        headers["x-target-id"] = target.strip()
    return Call(method="POST", path="/v1/positions", query=query, headers=headers, body=report_bytes(report))


def batch_calls(
    reports: Iterable[Any], query: Mapping[str, str], message_format: str | None = None
) -> Iterator[tuple[int, Call]]:
    """Split reports or messages into batches that the service accepts; yields calls and numbers of reports.

    Raises
    ------
    ReportError
        As :func:`report_bytes`; the message says which report it is.
    """
    path = "/v1/positions/batch" if message_format is None else f"/v1/positions/{_named(message_format)}/batch"
    batch: list[bytes] = []
    size = 0
    for number, report in enumerate(reports):
        try:
            text = report_bytes(report)
        except ReportError as error:
            raise ReportError(f"reports[{number}]: {error}", path=("reports", number, *error.path)) from None
        if batch and (len(batch) == BATCH_REPORTS or size + len(text) > BATCH_BYTES):
            yield len(batch), _batch_call(path, batch, query)
            batch, size = [], 0
        batch.append(text)
        size += len(text) + 1
    if batch:
        yield len(batch), _batch_call(path, batch, query)


def message_call(message: Mapping[str, Any], message_format: str, query: Mapping[str, str]) -> Call:
    """Make the call for a JSON message of another system."""
    path = f"/v1/positions/{_named(message_format)}"
    return Call(method="POST", path=path, query=query, headers=_JSON, body=report_bytes(message))


def lines_call(
    lines: str,
    query: Mapping[str, str],
    *,
    stations: Mapping[str, str] | None,
    height: tuple[float, float] | None,
    confidence: float | None,
    stdev_deg: float | None = None,
    tails: tuple[float, float] | None = None,
) -> Call:
    """Make the call for u-blox lines; a height is z and its standard deviation, m."""
    pairs = [(key, value) for key, value in query.items()]
    pairs += [("station", f"{anchor}={station}") for anchor, station in (stations or {}).items()]
    if height is not None:
        pairs += [("height_m", repr(height[0])), ("height_stdev_m", repr(height[1]))]
    if confidence is not None:
        pairs.append(("confidence", repr(confidence)))
    if stdev_deg is not None:
        pairs.append(("stdev_deg", repr(stdev_deg)))
    if tails is not None:
        pairs += [("tail_share", repr(tails[0])), ("tail_scale", repr(tails[1]))]
    path = f"/v1/positions/ublox?{urlencode(pairs)}" if pairs else "/v1/positions/ublox"
    return Call(method="POST", path=path, headers={"content-type": "text/plain"}, body=lines.encode())


def lines_answers(document: Any) -> list[FixAnswer | ProblemError]:
    """Read the answers to lines, of any number."""
    return list(batch_answers(document, len(document["results"])))


def _named(message_format: str) -> str:
    if message_format not in MESSAGE_FORMATS:
        raise ClientError(
            f"format {message_format!r} is none of {', '.join(MESSAGE_FORMATS)}; use locate_lines for u-blox"
        )
    return message_format


def batch_answers(document: Any, count: int) -> tuple[FixAnswer | ProblemError, ...]:
    """Read the answers to a batch; ValueError when they are not ``count`` fixes and problems."""
    answers: list[FixAnswer | ProblemError] = []
    for one in document["results"]:
        if "errors" in one:
            error = problem(one, one["status"] if isinstance(one["status"], int) else 0)
            if isinstance(error, AnswerError):
                raise ValueError(str(error))
            answers.append(error)
        else:
            answers.append(fix_answer(one))
    if len(answers) != count:
        raise ValueError(f"{len(answers)} answers to {count} reports")
    return tuple(answers)


def _batch_call(path: str, batch: list[bytes], query: Mapping[str, str]) -> Call:
    body = b'{"reports":[' + b",".join(batch) + b"]}"
    return Call(method="POST", path=path, query=query, headers=_JSON, body=body)
