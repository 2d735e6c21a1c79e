"""Playing a log to a service, and recording what a service is asked."""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from rayfix.client import Client
from rayfix.errors import ProblemError
from rayfix.logs.entries import Problem
from rayfix.logs.reading import Reading, read_logs
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.measuring.timestamps import utc_moment
from rayfix_service.wire import parse_report, report_to_document
from rayfix_tables.errors import ReportError

_TOGETHER = 0.02
"""Seconds within which reports that are due are sent in one request."""

_MOST_TOGETHER = 200


@dataclass
class Replay:
    """What became of a log's reports.

    Attributes
    ----------
    sent, fixes, refused, problems : int
        Reports sent; fixes that came back; reports that the service refused; entries that are no reports.
    latest : float, s
        Longest delay of a request behind the log's own time.
    """

    sent: int = 0
    fixes: int = 0
    refused: int = 0
    problems: int = 0
    latest: float = 0.0


def replay_logs(
    logs: Sequence[Path],
    client: Client,
    *,
    reading: Reading,
    speed: float = 1.0,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Replay:
    """Send the reports of logs to a service, as far apart as they were recorded.

    Reports without a time are sent at once, with those before them.

    Parameters
    ----------
    logs : sequence of pathlib.Path
    client : Client
    reading : Reading
    speed : float
        How many times faster than recorded; inf for as fast as the service answers.
    clock, sleep : callable

    Raises
    ------
    ReportError
        When a log cannot be read.
    ClientError
        When the service cannot be reached.
    """
    found = Replay()
    begin = clock()
    first: float | None = None
    waiting: list[Report] = []
    send_at = 0.0

    def send() -> None:
        nonlocal waiting
        if not waiting:
            return
        pause = send_at - (clock() - begin)
        if pause > 0.0:
            sleep(pause)
        else:
            found.latest = max(found.latest, -pause if speed < float("inf") else 0.0)
        answers = client.locate_batch([report_to_document(report) for report in waiting])
        found.sent += len(answers)
        found.refused += sum(isinstance(answer, ProblemError) for answer in answers)
        waiting = []

    for entry in read_logs(logs, reading):
        try:
            if isinstance(entry, Problem):
                raise ReportError(entry.text)
            report = parse_report(entry.report) if isinstance(entry.report, bytes) else entry.report
        except ReportError:
            found.problems += 1
            continue
        due = send_at
        if report.timestamp is not None:
            seconds = utc_moment(report.timestamp).timestamp()
            first = seconds if first is None else first
            due = max((seconds - first) / speed, 0.0)
        if waiting and (due > send_at + _TOGETHER or len(waiting) >= _MOST_TOGETHER):
            send()
        if not waiting:
            send_at = due
        waiting.append(report)
    send()
    found.fixes = found.sent - found.refused
    return found


def record_reports(events: Iterator[Any], file: BinaryIO, *, most: int | None = None) -> int:
    """Write the reports of a service's feed as JSON lines; returns how many.

    Parameters
    ----------
    events : iterator of FixEvent
    file : BinaryIO
    most : int, optional
        Reports after which to end.
    """
    count = 0
    if most == 0:
        return 0
    for event in events:
        file.write(json.dumps(event.report, separators=(",", ":")).encode() + b"\n")
        file.flush()
        count += 1
        if count == most:
            break
    return count
