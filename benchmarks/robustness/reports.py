"""Random valid reports of all kinds and malformed messages, mixed, against one process that serves a table.

    python -m benchmarks.robustness.reports [--table hall.h5] [--valid 100000] [--malformed 100000] [--slow-share 0.1]

Every position must lie in the free space, be finite, and have a positive definite covariance; the candidates'
probabilities add up to the confidence that the answer states, and to one at most; no answer is 5xx but 504 for a fix
that reached its time limit; the most memory in the second half of the run is at most `--growth` MiB above that in the
first, and no file descriptor is left open. Memory is looked at when the service has had no request for `--rest`
seconds, in which it gives back what slow fixes have freed. Of the valid reports, `--slow-share` are of all kinds, nine
of ten of which are slow by their estimate and are located in threads; the others are drawn until the estimate calls
them quick. Request n depends on the seed and n alone: `--only n` sends that one and prints the answer.
"""

import http.client
import json
import math
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.common.costly_reports import random_measurement, random_report
from benchmarks.common.example_table import open_or_build, table_parser
from benchmarks.common.malformed import malformed
from benchmarks.common.running_service import open_files, resident_mebibytes, running, serve_command
from benchmarks.common.sound_answers import faults_of
from rayfix_service.fusion.measurements.report import Angle, Height, Report
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.locator import Locator
from rayfix_service.wire import InvalidReportError, report_to_document
from rayfix_tables.errors import ReportError

CONNECTIONS = 4
_NATIVE = "/v1/positions"


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is sent, and whether it is a valid report, and a slow one by its estimate."""

    number: int
    path: str
    body: bytes
    valid: bool
    slow: bool = False


class Source:
    """Draws requests: the n-th depends on the seed and n alone."""

    def __init__(self, locator: Locator, *, seed: int, valid_share: float, slow_share: float) -> None:
        self._locator = locator
        self._seed, self._valid_share, self._slow_share = seed, valid_share, slow_share
        self._stations = [station.id for station in locator.table.site.stations]

    def request(self, number: int) -> Request:
        """Draw the n-th request."""
        rng = np.random.default_rng([self._seed, number])
        if rng.random() >= self._valid_share:
            path, body = malformed(rng)
            return Request(number=number, path=path, body=body, valid=False)
        of_all_kinds = rng.random() < self._slow_share
        while True:
            report = random_report(rng, self._stations, most=6) if of_all_kinds else self._narrow_report(rng)
            if rng.random() < 0.3:
                report = replace(
                    report, height=Height(z=float(rng.uniform(0.0, 4.0)), stdev=float(rng.uniform(0.05, 1)))
                )
            try:
                body = json.dumps(report_to_document(report)).encode()
                slow = self._locator.seconds(report) > ServiceSettings.quick_fix_seconds
            except (InvalidReportError, ReportError):
                continue
            if of_all_kinds or not slow:
                return Request(number=number, path=_NATIVE, body=body, valid=True, slow=slow)

    def _narrow_report(self, rng: np.random.Generator) -> Report:
        """Draw a report that begins with a narrow angle, as most quick ones do."""
        spread = math.radians(float(np.exp(rng.uniform(math.log(0.1), math.log(6.0)))))
        angle = Angle(
            station_id=str(rng.choice(self._stations)),
            azimuth=float(rng.uniform(-math.pi, math.pi)),
            azimuth_stdev=spread,
            zenith=float(rng.uniform(0.0, math.pi)),
            zenith_stdev=spread,
        )
        more = [random_measurement(rng, self._stations) for _ in range(int(rng.integers(0, 3)))]
        return Report(measurements=(angle, *more))


@dataclass(kw_only=True)
class Found:
    """What the answers were."""

    statuses: Counter[tuple[str, int]] = field(default_factory=Counter)
    fixes: Counter[str] = field(default_factory=Counter)
    slow: int = 0
    faults: list[str] = field(default_factory=list)


def judge(request: Request, status: int, answer: bytes, free_space: Any, found: Found) -> None:
    """Add what one answer was, and what is wrong with it."""
    found.statuses["valid" if request.valid else "malformed", status] += 1
    found.slow += request.slow
    documents = []
    try:
        document = json.loads(answer)
        documents = [*document.get("results", []), document] if isinstance(document, dict) else []
    except ValueError:
        found.faults.append(f"request {request.number}: the answer with {status} is not JSON")
    if status >= 500 and not (status == 504 and request.slow):
        found.faults.append(f"request {request.number}: {status} {answer[:200]!r}")
    if request.valid and status not in (200, 422, 504):  # 422: a height outside the building
        found.faults.append(f"request {request.number}: a valid report is answered {status} {answer[:200]!r}")
    for one in documents:
        if "candidates" in one:
            found.fixes[one["status"]] += 1
            found.faults += [f"request {request.number}: {fault}" for fault in faults_of(one, free_space)]
        elif one.get("status") == 500:
            found.faults.append(f"request {request.number}: a report of several met a defect")


def send(port: int, requests: Iterator[Request], free_space: Any, found: Found, lock: threading.Lock) -> None:
    """Send requests over one connection, one after the other, and judge the answers."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    while True:
        with lock:
            request = next(requests, None)
        if request is None:
            connection.close()
            return
        kind = "text/plain" if request.path.endswith("ublox") else "application/json"
        try:
            connection.request("POST", request.path, request.body, {"Content-Type": kind})
            response = connection.getresponse()
            status, answer = response.status, response.read()
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            with lock:
                found.faults.append(f"request {request.number}: {type(error).__name__}: {error}")
                if len(found.faults) > 100:
                    return
            continue
        with lock:
            judge(request, status, answer, free_space, found)


def main() -> None:
    parser = table_parser(__doc__)
    parser.add_argument("--valid", type=int, default=100_000)
    parser.add_argument("--malformed", type=int, default=100_000)
    parser.add_argument("--slow-share", type=float, default=0.1, help="of the valid ones; default 0.1")
    parser.add_argument("--seconds", type=float, default=3600.0, help="when to end earlier")
    parser.add_argument("--growth", type=float, default=4.0, help="MiB; default 4")
    parser.add_argument("--rest", type=float, default=3.0, help="s before memory is looked at; default 3")
    parser.add_argument("--only", type=int, metavar="N", help="send one request")
    options = parser.parse_args()
    total = options.valid + options.malformed
    with open_or_build(options.table) as table, running(serve_command(table.path)) as service:
        locator = Locator(table)
        locator.warm_up()
        source = Source(locator, seed=options.seed, valid_share=options.valid / total, slow_share=options.slow_share)
        free_space = table.scene.free_space
        pid = service.process.pid
        found, lock = Found(), threading.Lock()
        if options.only is not None:
            request = source.request(options.only)
            print(request.path, request.body)
            send(service.port, iter([request]), free_space, found, lock)
            print(found)
            return
        begin, files, memory = time.monotonic(), open_files(pid), []
        parts = 20
        for part in range(parts):
            numbers = range(total * part // parts, total * (part + 1) // parts)
            requests = (source.request(number) for number in numbers)
            with ThreadPoolExecutor(CONNECTIONS) as pool:
                sending = [
                    pool.submit(send, service.port, requests, free_space, found, lock) for _ in range(CONNECTIONS)
                ]
            for each in sending:
                each.result()
            if service.process.poll() is not None:
                sys.exit(f"the service ended with {service.process.returncode}:\n{service.log()}")
            time.sleep(options.rest)
            memory.append(resident_mebibytes(pid))
            done = sum(found.statuses.values())
            print(f"{done:8} requests  {time.monotonic() - begin:6.0f} s  {memory[-1]:7.1f} MiB", flush=True)
            if time.monotonic() - begin > options.seconds or len(found.faults) > 100:
                break
        time.sleep(1.0)
        left = open_files(pid) - files
        alive = service.process.poll() is None
    for (kind, status), count in sorted(found.statuses.items()):
        print(f"{kind:10} {status} {count:8}")
    print(f"{found.slow} were slow by their estimate; fixes: {dict(found.fixes)}")
    half = len(memory) // 2
    growth = max(memory[half:]) - max(memory[:half]) if half else 0.0
    print(f"most memory in the second half against the first: {growth:+.1f} MiB; file descriptors: {left:+d}")
    for fault in found.faults[:20]:
        print(fault)
    if found.faults or growth > options.growth or left > 0 or not alive:
        sys.exit(f"a bound does not hold: {len(found.faults)} faults")


if __name__ == "__main__":
    main()
