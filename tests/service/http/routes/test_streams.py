"""The routes that stay open: the feed of fixes and the stream of reports, against a real server."""

import asyncio
import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from rayfix_service.http.answering.feed import QUEUE_LENGTH, FixFeed
from rayfix_service.http.answering.feed_relay import FeedRelay
from rayfix_service.http.openapi.examples import (
    BATCH_EXAMPLES,
    FIX_EVENT_EXAMPLE,
    NRPPA_EXAMPLES,
    SILABS_EXAMPLES,
    UBLOX_EXAMPLES,
)
from rayfix_service.http.routes.stream import FixEventDocument
from rayfix_service.wire import FixDocument, parse_report
from tests.support.messages.reports import REPORT
from tests.support.running.server_process import ServerProcess, start_server


@pytest.fixture(scope="module")
def server(hall_table_path: Path) -> Iterator[ServerProcess]:
    with start_server(hall_table_path) as server:
        yield server


class Listener:
    """A listener of the feed, that hears of everything from when it is made."""

    def __init__(self, server: ServerProcess, query: str = "") -> None:
        self._http = server.client()
        self._context = self._http.stream("GET", f"/v1/fixes{query}")
        self.response: httpx.Response = self._context.__enter__()
        self._lines = self.response.iter_lines()
        assert next(self._lines) == "retry: 2000"
        assert next(self._lines) == ""

    def next(self) -> dict[str, str]:
        """Return the fields of the next event."""
        fields: dict[str, str] = {}
        for line in self._lines:
            if not line and fields:
                return fields
            name, colon, value = line.partition(": ")
            if name and colon:
                fields[name] = value
        raise EOFError

    def close(self) -> None:
        """Leave."""
        self._context.__exit__(None, None, None)
        self._http.close()


@pytest.fixture
def listen(server: ServerProcess) -> Iterator[Callable[[str], Listener]]:
    listeners: list[Listener] = []

    def listen(query: str = "") -> Listener:
        listeners.append(Listener(server, query))
        return listeners[-1]

    yield listen
    for listener in listeners:
        listener.close()


@pytest.fixture
def socket(server: ServerProcess) -> Iterator[ClientConnection]:
    with connect(f"ws://127.0.0.1:{server.port}/v1/stream") as connection:
        yield connection


# --- the feed --------------------------------------------------------------------------------------------


def test_the_feed_tells_of_each_fix_and_its_report(server: ServerProcess, listen: Callable[..., Listener]):
    listener = listen()
    assert listener.response.headers["content-type"] == "text/event-stream; charset=utf-8"
    assert listener.response.headers["cache-control"] == "no-store"
    with server.client() as http:
        fix = http.post("/v1/positions", json=REPORT).json()
        http.post("/v1/positions", json={"measurements": []})  # no fix, no event
        again = http.post("/v1/positions", json=REPORT | {"target_id": "two\nlines"}).json()
    first, second = listener.next(), listener.next()
    assert first["event"] == second["event"] == "fix"
    assert int(second["id"]) == int(first["id"]) + 1
    assert json.loads(first["data"]) == {"table": "hall", "report": REPORT, "fix": fix}
    assert json.loads(second["data"]) == {"table": "hall", "report": REPORT | {"target_id": "two\nlines"}, "fix": again}


def test_every_route_tells_the_feed(server: ServerProcess, socket: ClientConnection, listen: Callable[..., Listener]):
    listener = listen()
    batch = BATCH_EXAMPLES["two_reports"]["value"]
    nrppa = NRPPA_EXAMPLES["multi_rtt"]["value"]
    with server.client() as http:
        http.post("/v1/positions/batch", json=batch)
        socket.send(json.dumps(REPORT))
        socket.recv()
        foreign = [
            http.post("/v1/positions/nrppa", json=nrppa).json(),
            http.post("/v1/positions/silabs?output=omlox", json=SILABS_EXAMPLES["three_locators"]["value"]).json(),
            *http.post("/v1/positions/ublox", content=UBLOX_EXAMPLES["three_anchors"]["value"])
            .json()
            .get("results", ()),
            *http.post(
                "/v1/positions/ublox",
                content=UBLOX_EXAMPLES["three_anchors"]["value"],
                headers={"content-type": "text/plain"},
            ).json()["results"],
        ]
        events = [json.loads(listener.next()["data"]) for _ in range(6)]
        assert [event["report"] for event in events[:3]] == [*batch["reports"], REPORT]
        # What a message of another format was turned into gets the same fix.
        for event, answer in zip(events[3:], foreign, strict=True):
            FixEventDocument.model_validate(event)
            fix = http.post("/v1/positions", json=event["report"]).json()
            position = event["fix"]["position"]
            assert [*fix["position"].values()] == pytest.approx([*position.values()], abs=1e-9)
            assert [*position.values()] == answer.get("position", {}).get("coordinates", [*position.values()])
            assert event["fix"]["target_id"] == event["report"].get("target_id")


def test_one_target_may_be_followed(server: ServerProcess, listen: Callable[..., Listener]):
    listener = listen("?target_id=b")
    with server.client() as http:
        for target in ("a", "b", None, "c", "b"):
            http.post("/v1/positions", json=REPORT | {"target_id": target})
    events = [listener.next(), listener.next()]
    assert [json.loads(event["data"])["fix"]["target_id"] for event in events] == ["b", "b"]
    assert int(events[1]["id"]) - int(events[0]["id"]) == 3


def test_the_example_of_an_event_is_one():
    FixEventDocument.model_validate(FIX_EVENT_EXAMPLE)


def test_a_slow_listener_loses_the_oldest_and_is_told():
    async def listen() -> tuple[int, list[int], bytes]:
        feed = FixFeed()
        feed.publish("hall", "a", unwanted)
        with feed.subscribe() as slow, feed.subscribe(target_id="b") as other:
            for _ in range(QUEUE_LENGTH + 3):
                feed.publish("hall", "a", lambda: b"{}")
            dropped, events = slow.take()
            assert slow.take() == (0, [])
            assert other.take() == (0, [])
            assert feed.num_listeners == 2
            feed.publish("hall", "b", lambda: b"{}")
            assert [len(s.take()[1]) for s in (slow, other)] == [1, 1]
        assert feed.num_listeners == 0
        feed.publish("hall", "a", unwanted)
        return dropped, [event.number for event in events], events[0].data

    def unwanted() -> bytes:
        raise AssertionError("nobody listens")

    dropped, numbers, data = asyncio.run(listen())
    assert dropped == 3
    assert numbers == list(range(4, QUEUE_LENGTH + 4))
    assert data == b"{}"


def test_waiting_ends_with_an_event_with_the_end_and_with_the_time():
    async def wait() -> None:
        feed = FixFeed()
        with feed.subscribe() as subscription:
            await subscription.wait(0.001)
            assert subscription.take() == (0, [])
            asyncio.get_running_loop().call_soon(feed.publish, "hall", None, lambda: b"{}")
            await subscription.wait(60)
            assert len(subscription.take()[1]) == 1
            asyncio.get_running_loop().call_soon(feed.close)
            await subscription.wait(60)
            assert subscription.closed
            await subscription.wait(60)  # for ever closed
        with feed.subscribe() as late:
            assert late.closed

    asyncio.run(wait())


def test_open_streams_do_not_hold_up_the_end(hall_table_path: Path):
    with start_server(hall_table_path) as server:
        listener = Listener(server)
        with connect(f"ws://127.0.0.1:{server.port}/v1/stream") as socket:
            start = time.monotonic()
            log = server.stop()
            assert time.monotonic() - start < 5.0
            with pytest.raises(ConnectionClosed) as closed:
                socket.recv()
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1012  # the service restarts
        with pytest.raises(EOFError):
            listener.next()
        listener.close()
    assert server.process.returncode == -15
    assert "Traceback" not in log
    assert "ERROR" not in log


def test_workers_tell_each_other(tmp_path: Path):
    async def exchange() -> tuple[list[bytes], list[bytes], int]:
        one, other = FixFeed(), FixFeed()
        relays = [FeedRelay(one, tmp_path), FeedRelay(other, tmp_path)]
        for number, relay in enumerate(relays):
            relay._own = tmp_path / f"feed-{number}.sock"  # they would be of two processes
        (tmp_path / "feed-9.sock").touch()  # of a worker that was killed
        keeping = [asyncio.create_task(relay.keep()) for relay in relays]
        await asyncio.sleep(0.05)
        with one.subscribe() as here, one.subscribe(target_id="b") as of_b:
            await relays[0].connect()
            await relays[0].connect()  # does nothing
            for target in ("a", "b", "line\nbreak"):
                other.publish("hall", target, json.dumps(target).encode)
            one.publish("hall", "own", lambda: b"{}")
            events: list[bytes] = []
            while len(events) < 4:
                await here.wait(10)
                events += [event.data for event in here.take()[1]]
            of_b_alone = [event.data for event in of_b.take()[1]]
            heard = other.num_listeners
        for task in keeping:
            task.cancel()
        await asyncio.wait(keeping)
        await asyncio.sleep(0.05)
        return events, of_b_alone, heard

    events, of_b_alone, heard = asyncio.run(exchange())
    assert sorted(events) == sorted([b'"a"', b'"b"', b'"line\\nbreak"', b"{}"])
    assert of_b_alone == [b'"b"']
    assert heard == 0  # another worker is none that listens
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_listener_hears_of_all_workers(hall_table_path: Path):
    with start_server(hall_table_path, workers=2) as server:
        listener = Listener(server)
        for number in range(20):  # each on a connection of its own, which either worker takes
            with server.client() as http:
                http.post("/v1/positions", json=REPORT | {"target_id": str(number)})
        heard = [json.loads(listener.next()["data"])["fix"]["target_id"] for _ in range(20)]
        with server.client() as http:
            figures = http.get("/metrics").text
        assert 'route="/v1/positions",status="200"} 20.0' in figures
        listener.close()
    assert sorted(heard, key=int) == [str(number) for number in range(20)]


# --- the stream ------------------------------------------------------------------------------------------


def test_each_message_is_answered_in_its_order(socket: ClientConnection):
    messages = [
        json.dumps(REPORT | {"target_id": "first"}),
        "{",
        json.dumps({"measurements": []}),
        json.dumps(REPORT | {"target_id": "last"}).encode(),
    ]
    for message in messages:
        socket.send(message)
    first, malformed, empty, last = (json.loads(socket.recv()) for _ in messages)
    assert (first["target_id"], last["target_id"]) == ("first", "last")
    FixDocument.model_validate(first)
    assert first["position"] == last["position"]
    assert (malformed["status"], empty["status"]) == (400, 422)
    assert empty["errors"][0]["path"] == "measurements"


def test_the_stream_has_other_outputs(server: ServerProcess):
    with connect(f"ws://127.0.0.1:{server.port}/v1/stream?output=omlox") as socket:
        socket.send(json.dumps(REPORT))
        assert json.loads(socket.recv())["crs"] == "local"


def test_a_message_that_is_too_long_is_refused(server: ServerProcess, socket: ClientConnection):
    socket.send(" " * (1 << 20) + json.dumps(REPORT))
    refusal = json.loads(socket.recv())
    assert refusal["status"] == 413
    assert "longer than 1048576 bytes" in refusal["detail"]
    socket.send(json.dumps(REPORT))
    assert json.loads(socket.recv())["status"] == "ok"
    with contextlib.suppress(ConnectionClosed):  # the server need not read it all
        socket.send(" " * (17 << 20))
    with pytest.raises(ConnectionClosed) as closed:
        socket.recv()
    assert closed.value.rcvd is None or closed.value.rcvd.code == 1009


def test_what_is_no_stream_is_refused_before_it_opens(server: ServerProcess):
    with pytest.raises(InvalidStatus) as refusal:
        connect(f"ws://127.0.0.1:{server.port}/v1/stream?output=morse")
    assert refusal.value.response.status_code == 422
    assert "output" in json.loads(refusal.value.response.body)["detail"]


def test_a_client_that_sends_without_reading_waits_and_others_do_not(server: ServerProcess):
    with connect(f"ws://127.0.0.1:{server.port}/v1/stream", compression=None) as socket:
        for _ in range(200):
            socket.send(json.dumps(REPORT))
        with server.client() as http:
            assert http.get("/livez").status_code == 200
        answers = [json.loads(socket.recv()) for _ in range(200)]
    assert all(answer["position"] == answers[0]["position"] for answer in answers)
    assert parse_report(json.dumps(REPORT).encode()).target_id == answers[0]["target_id"]
