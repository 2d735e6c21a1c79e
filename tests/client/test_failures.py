"""Clients against a service that fails as it is told to."""

import asyncio
import http.server
import json
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from typing import Any

import httpx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix.client import (
    AnswerError,
    AsyncClient,
    Client,
    ClientError,
    ProblemError,
    RefusedReportError,
    RetryPolicy,
    UnreachableError,
)
from rayfix.client.calls import batch_calls
from rayfix.client.events import EventReader
from rayfix.client.retries import seconds_of
from rayfix_tables.errors import RayfixError, ReportError

QUICK = RetryPolicy(attempts=4, first_pause=0.001, longest_pause=0.002)
REPORT = {"target_id": "agv-7", "measurements": [{"type": "pt", "station_id": "bs1", "range_m": 3, "stdev_m": 1}]}
FIX: dict[str, Any] = {
    "target_id": "agv-7",
    "timestamp": None,
    "status": "insufficient",
    "position": None,
    "covariance_m2": None,
    "horizontal_accuracy_m": None,
    "vertical_accuracy_m": None,
    "ellipsoid_semi_axes_m": None,
    "confidence": 0.68,
    "candidates": [],
    "measurements": [],
    "table_id": "0" * 64,
    "compute_ms": 1.0,
    "a_later_key": 1,
}
PROBLEM = {
    "type": "urn:rayfix:problem:invalid-report",
    "title": "Report cannot be used",
    "status": 422,
    "detail": "measurements is missing; give an array",
    "errors": [{"path": "measurements", "message": "measurements is missing; give an array"}],
}

Answers = list[httpx.Response | Exception]


class Flaky:
    """Gives prepared answers in turn and keeps the requests."""

    def __init__(self, *answers: httpx.Response | Exception) -> None:
        self.answers: Answers = list(answers)
        self.requests: list[httpx.Request] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        """Answer a request."""
        self.requests.append(request)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def client(self, **options: Any) -> Client:
        """Return a client of it."""
        options.setdefault("retries", QUICK)
        return Client("http://service", transport=httpx.MockTransport(self), **options)


def busy(status: int = 503, **headers: str) -> httpx.Response:
    return httpx.Response(status, headers=headers, json={**PROBLEM, "type": "urn:rayfix:problem:not-ready"})


@pytest.mark.parametrize(
    "failure",
    [busy(503), busy(502), busy(429), busy(504), httpx.ConnectError("no route"), httpx.ReadTimeout("late")],
    ids=["503", "502", "429", "504", "connection", "timeout"],
)
def test_what_may_pass_is_tried_again(failure: httpx.Response | Exception):
    service = Flaky(failure, failure, httpx.Response(200, json=FIX))
    fix = service.client().locate(REPORT)
    assert fix.status == "insufficient"
    assert len(service.requests) == 3
    assert {request.content for request in service.requests} == {json.dumps(REPORT, separators=(",", ":")).encode()}


@pytest.mark.parametrize("status", [400, 401, 404, 422, 500])
def test_what_will_not_pass_is_not(status: int):
    service = Flaky(httpx.Response(status, json={**PROBLEM, "status": status}))
    with pytest.raises(RefusedReportError) as found:
        service.client().locate(REPORT)
    assert (found.value.status, found.value.path) == (status, ("measurements",))
    assert len(service.requests) == 1


def test_patience_ends():
    service = Flaky(*[httpx.ConnectError("refused")] * 4)
    with pytest.raises(UnreachableError, match=r"does not answer after 4 attempts \(refused\)"):
        service.client().locate(REPORT)
    service = Flaky(*[busy()] * 4)
    with pytest.raises(ProblemError) as found:
        service.client().locate(REPORT)
    assert found.value.kind == "urn:rayfix:problem:not-ready"
    assert not isinstance(found.value, ReportError)
    assert service.answers == []


def test_the_client_for_asyncio_tries_again_as_well():
    service = Flaky(httpx.ConnectError("refused"), busy(), httpx.Response(200, json=FIX))

    async def scenario() -> str:
        async with AsyncClient("http://service", transport=httpx.MockTransport(service), retries=QUICK) as client:
            return (await client.locate(REPORT)).status

    assert asyncio.run(scenario()) == "insufficient"
    assert len(service.requests) == 3


def test_retry_after_is_waited_for(monkeypatch: pytest.MonkeyPatch):
    pauses: list[float] = []
    own, sleep = threading.get_ident(), time.sleep

    def pause(seconds: float) -> None:
        if threading.get_ident() == own:
            pauses.append(seconds)
        else:  # a service that another test has left running
            sleep(seconds)

    monkeypatch.setattr("time.sleep", pause)
    service = Flaky(busy(429, **{"Retry-After": "7"}), busy(), httpx.Response(200, json=FIX))
    service.client().locate(REPORT)
    assert 7.0 <= pauses[0] <= 7.001
    assert pauses[1] <= 0.002
    with pytest.raises(ProblemError):
        Flaky(busy(429, **{"Retry-After": "3600"})).client().locate(REPORT)
    assert len(pauses) == 2


def test_pauses_grow_and_are_not_all_alike():
    policy = RetryPolicy(attempts=6, first_pause=0.2, longest_pause=1.0)
    source = random.Random(1)
    drawn = [[policy.pause(n, source) for _ in range(400)] for n in range(1, 6)]
    assert [policy.pause(6, source), policy.pause(7, source)] == [None, None]
    for pauses, most in zip(drawn, (0.2, 0.4, 0.8, 1.0, 1.0), strict=True):
        values = [pause for pause in pauses if pause is not None]
        assert len(values) == 400
        assert 0.98 * most < max(values) <= most
        assert min(values) < 0.02 * most


def test_retry_after_is_seconds_or_a_date():
    assert seconds_of("12") == 12.0
    moment = format_datetime(datetime.now(UTC) + timedelta(seconds=30), usegmt=True)
    assert 20.0 < seconds_of(moment) <= 30.0
    assert seconds_of(format_datetime(datetime.now(UTC) - timedelta(days=1), usegmt=True)) == 0.0
    assert seconds_of("soon") == 0.0


@pytest.mark.parametrize("body", [b"<html>hello</html>", b"[]", b"{}", b'{"status": "ok"}', b"null"])
def test_an_answer_of_something_else_is_called_so(body: bytes):
    for status in (200, 418):
        with pytest.raises(AnswerError, match="check the address"):
            Flaky(httpx.Response(status, content=body)).client().locate(REPORT)
    with pytest.raises(AnswerError):
        Flaky(httpx.Response(200, content=body)).client().locate_batch([REPORT])
    with pytest.raises(AnswerError):
        Flaky(httpx.Response(200, content=body)).client().stations()


def test_a_batch_must_have_all_its_answers():
    with pytest.raises(AnswerError):
        Flaky(httpx.Response(200, json={"results": [FIX]})).client().locate_batch([REPORT, REPORT])


@settings(deadline=None)
@given(st.lists(st.integers(0, 3_000_000), max_size=12))
def test_batches_are_small_enough_and_lose_nothing(sizes: list[int]):
    reports = [{"n": n, "x": "y" * size} for n, size in enumerate(sizes)]
    cut = list(batch_calls(reports, {}))
    sent = [one for _, call in cut for one in json.loads(call.body or b"")["reports"]]
    assert sent == reports
    assert sum(count for count, _ in cut) == len(reports)
    assert all(len(call.body or b"") < 9_000_000 for _, call in cut)
    assert [count for count, _ in batch_calls([{}] * 2001, {})] == [1000, 1000, 1]


def test_key_table_track_and_target_are_sent():
    service = Flaky(httpx.Response(200, json=FIX))
    client = service.client(api_key="secret", table="ground", track=True)
    client.locate(REPORT)
    (request,) = service.requests
    assert request.headers["authorization"] == "Bearer secret"
    assert request.headers["x-target-id"] == "agv-7"
    assert dict(request.url.params) == {"table": "ground", "track": "true"}
    assert "secret" not in repr(client.settings)


@pytest.mark.parametrize("url", ["localhost:8000", "ftp://x", "http://", "http://x/?a=b", ""])
def test_an_address_that_is_none_is_refused(url: str):
    with pytest.raises(ClientError, match="is not the address of a service"):
        Client(url)


def test_a_feed_is_joined_again_after_its_end():
    def feed(n: int) -> httpx.Response:
        data = json.dumps({"table": "hall", "report": REPORT, "fix": {**FIX, "target_id": f"t{n}"}})
        return httpx.Response(200, content=f": hello\n\nid: 1\nevent: fix\ndata: {data}\n\nevent: dropped\ndata: 1\n\n")

    service = Flaky(feed(0), httpx.ConnectError("gone"), busy(), feed(1), httpx.Response(404, json=PROBLEM))
    feed_of_fixes = service.client().fixes()
    assert [next(feed_of_fixes).fix.target_id for _ in range(2)] == ["t0", "t1"]
    with pytest.raises(ProblemError):
        next(feed_of_fixes)


@settings(deadline=None)
@given(st.lists(st.text(st.characters(exclude_characters="\r\n"), max_size=9), max_size=5), st.booleans())
def test_events_come_out_as_they_went_in(lines: list[str], named: bool):
    reader = EventReader()
    written = [": a comment", *(["event: fix"] if named else []), *(f"data: {line}" for line in lines), "id: 3"]
    assert [reader.take(line) for line in written] == [None] * len(written)
    event = reader.take("")
    if not lines:
        assert event is None
    else:
        assert event is not None
        assert (event.name, event.data) == ("fix" if named else "message", "\n".join(lines))
    assert reader.take("") is None


@pytest.fixture
def serve_bytes() -> Iterator[Callable[[list[bytes]], str]]:
    """Start a server on loopback that answers each request with the next bytes and cuts the connection."""
    servers = []

    def start(answers: list[bytes]) -> str:
        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.wfile.write(answers.pop(0))
                self.close_connection = True

            def log_message(self, *args: object) -> None: ...

        server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_address[1]}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def test_connections_that_break_are_made_again(serve_bytes: Callable[[list[bytes]], str]):
    whole = json.dumps({"stations": []}).encode()
    good = b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n%b" % (len(whole), whole)
    url = serve_bytes([b"", good[:-5], b"nonsense\r\n\r\n", good])
    with Client(url, retries=QUICK) as client:
        assert client.stations() == ()
    with Client("http://127.0.0.1:9", retries=QUICK) as client, pytest.raises(UnreachableError) as found:
        client.stations()
    assert isinstance(found.value, RayfixError)


def test_it_needs_nothing_of_the_service():
    code = """if True:
        import sys
        for name in ("numba", "pydantic", "fastapi", "trimesh", "sklearn", "scipy", "uvicorn", "rayfix_service"):
            sys.modules[name] = None
        import rayfix
        client = rayfix.Client("http://localhost:1", retries=rayfix.client.RetryPolicy(attempts=1))
        try:
            client.locate({"measurements": []})
        except rayfix.RayfixError as error:
            print(type(error).__name__)
        rayfix.AsyncClient("http://localhost:1")
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "UnreachableError"
