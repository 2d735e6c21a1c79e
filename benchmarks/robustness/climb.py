"""A search for messages that block a service: a hill climb over the structure of messages towards the highest cost.

    python -m benchmarks.robustness.climb [--table hall.h5] [--minutes 60]

In turns it changes a report (more measurements, heavier tails, wider deviations, other stations), a batch of such
reports, and the document of a message of another format, and keeps a change that blocks the event loop longer, or takes
longer in total at the same blocking time. Meanwhile another thread requests `/livez`.

Bounds: no callback of the loop takes more than `--held` seconds of processor time of the loop's thread; an answer, or
503 or 504, comes within the limit of a fix and `--slack` seconds; `/livez` answers within `--livez` seconds except in a
fraction `--late-share` of the requests, because other work on the machine delays any process: the delay of a thread
that only sleeps is printed for comparison. For the same reason, the loop's longest callback by wall time is printed but
not bounded.
"""

import http.client
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.costly_reports import changed_report, random_report
from benchmarks.common.example_table import open_or_build, table_parser
from benchmarks.common.livez import Livez, Waits
from benchmarks.common.malformed import changed_message, random_message
from benchmarks.common.running_service import running, serve_command
from benchmarks.common.watched_loop import LoopTimes
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.http.settings import BodyLimits, ServiceSettings
from rayfix_service.locator import Locator
from rayfix_service.wire import InvalidReportError, report_to_document

RESTART = 30
"""Steps after which each search begins anew."""

_BATCH = 1000
_BATCH_SECONDS = 2.0


@dataclass(frozen=True, kw_only=True)
class Message:
    """What is posted."""

    path: str
    body: bytes
    source: Any


@dataclass(frozen=True, kw_only=True)
class Answered:
    """What came of it: the status, the time for it, and the longest callback by processor time and by the clock, s."""

    status: int
    seconds: float
    processor: float
    wall: float


@dataclass(kw_only=True)
class Found:
    """The worst so far, and what did not hold."""

    statuses: Counter[int] = field(default_factory=Counter)
    processor: list[tuple[float, str]] = field(default_factory=list)
    wall: float = 0.0
    seconds: list[tuple[float, str]] = field(default_factory=list)
    waits: list[tuple[float, str]] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


class ReportSearch:
    """Reports, each changed from the costliest before."""

    def __init__(self, stations: list[str], rng: np.random.Generator) -> None:
        self._stations, self._rng = stations, rng

    def begin(self) -> Message:
        """Draw a report."""
        return self._message(random_report(self._rng, self._stations)) or self.begin()

    def change(self, message: Message) -> Message:
        """Change a report."""
        return self._message(changed_report(message.source, self._rng, self._stations)) or self.begin()

    def _message(self, report: Report) -> Message | None:
        try:
            body = json.dumps(report_to_document(report)).encode()
        except InvalidReportError:
            return None
        return Message(path="/v1/positions", body=body, source=report)


class BatchSearch:
    """Batches of many times the same few reports, as many as take some seconds by their estimate."""

    def __init__(self, reports: ReportSearch, locator: Locator, rng: np.random.Generator) -> None:
        self._reports, self._locator, self._rng = reports, locator, rng

    def begin(self) -> Message:
        """Draw some reports."""
        return self._message([self._reports.begin() for _ in range(int(self._rng.integers(1, 4)))])

    def change(self, message: Message) -> Message:
        """Change one report, or add or take one out."""
        parts = list(message.source)
        place = int(self._rng.integers(len(parts)))
        match int(self._rng.integers(4)):
            case 0:
                parts.append(self._reports.begin())
            case 1 if len(parts) > 1:
                del parts[place]
            case _:
                parts[place] = self._reports.change(parts[place])
        return self._message(parts)

    def _message(self, parts: list[Message]) -> Message:
        longest = max(len(part.body) for part in parts) + 1
        seconds = sum(self._locator.seconds(part.source) for part in parts) / len(parts)
        count = max(min(_BATCH, (BodyLimits.batch - 100) // longest, int(_BATCH_SECONDS / seconds)), 1)
        bodies = b",".join(parts[n % len(parts)].body for n in range(count))
        return Message(path="/v1/positions/batch", body=b'{"reports":[' + bodies + b"]}", source=parts)


class MessageSearch:
    """Documents of all formats, valid or not."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def begin(self) -> Message:
        """Draw an example."""
        path, source = random_message(self._rng)
        return self._message(path, source)

    def change(self, message: Message) -> Message:
        """Change it, within the length that a body may have."""
        changed = self._message(message.path, changed_message(message.source, self._rng))
        limit = BodyLimits.batch if message.path.endswith("batch") else BodyLimits.report
        return changed if len(changed.body) <= limit else message

    @staticmethod
    def _message(path: str, source: Any) -> Message:
        body = source.encode() if isinstance(source, str) else json.dumps(source).encode()
        return Message(path=path, body=body, source=source)


Search = ReportSearch | BatchSearch | MessageSearch


def post(port: int, message: Message, times: LoopTimes) -> Answered:
    """Post a message and see what the loop did meanwhile."""
    kind = "text/plain" if message.path.endswith("ublox") else "application/json"
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    times.take()
    begin = time.perf_counter()
    try:
        connection.request("POST", message.path, message.body, {"Content-Type": kind})
        response = connection.getresponse()
        response.read()
        status = response.status
    except (OSError, http.client.HTTPException):
        status = 0
    finally:
        connection.close()
    seconds = time.perf_counter() - begin
    processor, wall = times.take()
    return Answered(status=status, seconds=seconds, processor=processor, wall=wall)


def climb(send: Callable[[Message], Answered], searches: list[Search], *, goes_on: Callable[[], bool]) -> None:
    """Take turns of the searches, each from its costliest message since its last new beginning."""
    best: dict[int, tuple[Message, tuple[float, float]]] = {}
    step = 0
    while goes_on():
        for number, search in enumerate(searches):
            new = step % RESTART == 0
            message = search.begin() if new else search.change(best[number][0])
            answer = send(message)
            cost = (round(answer.processor, 4), answer.seconds)
            if new or cost >= best[number][1]:
                best[number] = message, cost
        step += 1


def all_searches(locator: Locator, seed: int) -> list[Search]:
    """Return the searches in the order of their turns."""
    rng = np.random.default_rng(seed)
    reports = ReportSearch([station.id for station in locator.table.site.stations], rng)
    return [reports, MessageSearch(rng), BatchSearch(reports, locator, rng), MessageSearch(rng)]


def fault_of(message: Message, answer: Answered, slack: float) -> str | None:
    """Return what is wrong with an answer."""
    what = f"{message.path} {answer.status}, {len(message.body)} bytes: {message.body[:120]!r}"
    if message.path == "/v1/positions" and answer.seconds > ServiceSettings.fix_seconds + slack:
        return f"{answer.seconds:.1f} s for {what}"
    if not (200 <= answer.status < 500 or answer.status in (503, 504)):
        return f"answered {answer.status}: {what}"
    return None


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--held", type=float, default=0.02, help="processor time of a callback, s; default 0.02")
    parser.add_argument("--slack", type=float, default=2.0, help="s after the time limit of a fix; default 2")
    parser.add_argument("--livez", type=float, default=0.1, help="s; default 0.1")
    parser.add_argument("--late-share", type=float, default=0.001, help="default 0.001")
    parser.add_argument("--stacks", metavar="FILE")
    options = parser.parse_args()
    with open_or_build(options.table) as table, tempfile.TemporaryDirectory() as folder:
        found, waits = attack(Locator(table), Path(folder), options)
    for status, count in sorted(found.statuses.items()):
        print(f"{status or 'no answer':>9} {count:8}")
    print("callbacks of the loop, processor time:")
    for seconds, what in sorted(found.processor, reverse=True)[:8]:
        print(f"  {1e3 * seconds:7.1f} ms  {what}")
    print("/livez meanwhile:")
    for seconds, what in found.waits[:8]:
        print(f"  {1e3 * seconds:7.1f} ms  {what}")
    print("time for an answer by the clock:")
    for seconds, what in found.seconds[:5]:
        print(f"  {seconds:7.1f} s   {what}")
    print(f"longest callback by the clock {1e3 * found.wall:.0f} ms\n/livez:")
    print("\n".join(waits.lines(options.livez)))
    share = waits.own_share(options.livez)
    print(f"  the service's own share above {1e3 * options.livez:.0f} ms is {share:.4%}")
    held = max((seconds for seconds, _ in found.processor), default=0.0)
    if held > options.held:
        found.faults.append(f"the loop was held for {1e3 * held:.1f} ms")
    if share > options.late_share:
        found.faults.append("/livez was late")
    if found.faults:
        sys.exit("a bound does not hold: " + "; ".join(found.faults[:10]))


def attack(locator: Locator, folder: Path, options: Any) -> tuple[Found, Waits]:
    """Search for as long as is wanted."""
    table, times = locator.table.path, LoopTimes(folder / "times")
    command = [
        "-m",
        "benchmarks.common.watched_loop",
        str(table),
        str(folder / "times"),
        *filter(None, [options.stacks]),
    ]
    with running(command) as service, running(serve_command(table)) as idle:
        found, livez = Found(), Livez(folder / "longest", service.port, idle.port)

        def send(message: Message) -> Answered:
            answer = post(service.port, message, times)
            found.statuses[answer.status] += 1
            found.wall = max(found.wall, answer.wall)
            what = f"{message.path} {answer.status}, {len(message.body)} bytes: {message.body[:120]!r}"
            found.processor = sorted([*found.processor, (answer.processor, what)], reverse=True)[:20]
            found.waits = sorted([*found.waits, (livez.take(), what)], reverse=True)[:20]
            found.seconds = sorted([*found.seconds, (answer.seconds, what)], reverse=True)[:20]
            if (fault := fault_of(message, answer, options.slack)) is not None:
                found.faults.append(fault)
            return answer

        until = time.monotonic() + 60.0 * options.minutes
        try:
            climb(send, all_searches(locator, options.seed), goes_on=lambda: time.monotonic() < until)
        finally:
            waits = livez.close()
    return found, waits


if __name__ == "__main__":
    main()
