"""What a connection may cost: large heads, slow heads and bodies, idle, unread and too many connections."""

import contextlib
import json
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from rayfix.cli import main
from rayfix_service.http.access.keys import add_key
from rayfix_service.http.settings import BodyLimits, ConnectionLimits, FeedLimits, ServiceSettings
from rayfix_service.server import server as server_module
from rayfix_service.server.server import fitting
from rayfix_service.wire.limits import MessageLimits
from tests.support.messages.reports import REPORT
from tests.support.running.server_process import ServerProcess, start_server

QUICK = {"head_seconds": 1.0, "body_seconds": 1.5, "idle_seconds": 1.0, "unread_seconds": 1.5, "connections": 40}
HOST = "Host: 127.0.0.1\r\n"


@pytest.fixture(scope="module")
def server(hall_table_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """Return a service with keys and short times; whoever attacks it here has none."""
    keys = tmp_path_factory.mktemp("secret") / "keys"
    (keys.parent / "key").write_text(add_key(keys, "gateway"))
    with start_server(hall_table_path, settings={"api_keys": str(keys), "connection_limits": QUICK}) as server:
        server.key = (keys.parent / "key").read_text()  # type: ignore[attr-defined]
        yield server
        log = server.stop()
        assert "Traceback" not in log


def open_connection(server: ServerProcess) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), timeout=20)


def read_all(connection: socket.socket) -> bytes:
    """Read until the service ends the connection."""
    received = b""
    with contextlib.suppress(ConnectionError):
        while piece := connection.recv(1 << 16):
            received += piece
    return received


def status(answer: bytes) -> int:
    return int(answer.split(b" ")[1])


def send_until_refused(connection: socket.socket, piece: bytes, most: int) -> int:
    """Send a piece again and again, until the service no longer takes it; how many bytes it took."""
    sent = 0
    with contextlib.suppress(ConnectionError):
        while sent < most:
            connection.sendall(piece)
            sent += len(piece)
    return sent


def alive(server: ServerProcess) -> float:
    """Ask whether the process answers; how long that took."""
    start = time.monotonic()
    with server.client() as http:
        assert http.get("/livez").status_code == 200
    return time.monotonic() - start


def figures(server: ServerProcess) -> dict[str, float]:
    """Why connections were closed, and how often."""
    with server.client() as http:
        text = http.get("/metrics", headers={"x-api-key": server.key}).text  # type: ignore[attr-defined]
    return {m[1]: float(m[2]) for m in re.finditer(r'rayfix_connections_closed_total\{reason="(\w+)"\} (\S+)', text)}


# --- heads -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "head",
    [
        b"GET /livez HTTP/1.1\r\nx: " + b"a" * (1 << 20),
        b"GET /livez HTTP/1.1\r\n" + b"x: a\r\n" * (1 << 18),
        b"GET /livez HTTP/1.1\r\n" + b"".join(b"x%d: a\r\n" % n for n in range(200)) + b"\r\n",
        b"GET /livez HTTP/1.1\r\nx: " + b"a" * (33 << 10) + b"\r\n\r\n",
        b"GET /" + b"a" * (1 << 20),
        b"GET /livez?" + b"a" * (33 << 10) + b" HTTP/1.1\r\n\r\n",
    ],
    ids=["one field", "many fields", "200 fields", "just too long", "path", "query"],
)
def test_a_large_head_is_refused_before_it_is_read(server: ServerProcess, head: bytes):
    with open_connection(server) as connection:
        with contextlib.suppress(ConnectionError):
            connection.sendall(head)
        assert status(read_all(connection)) == 431
    assert alive(server) < 5.0


def test_an_endless_head_costs_nothing(server: ServerProcess):
    """It was gathered whole, before any key was asked for, and held all other requests up."""
    for piece in (b"a" * (1 << 16), b"x: a\r\n" * 10_000):
        with open_connection(server) as connection:
            connection.sendall(b"GET /livez HTTP/1.1\r\nx: ")
            assert send_until_refused(connection, piece, 200 << 20) < 100 << 20
    assert alive(server) < 5.0


def test_a_head_within_the_limits_is_taken(server: ServerProcess):
    fields = "".join(f"x{n}: {'a' * 250}\r\n" for n in range(90))
    with open_connection(server) as connection:
        connection.sendall(f"GET /livez HTTP/1.1\r\n{HOST}{fields}\r\n".encode())
        assert status(connection.recv(1 << 16)) == 200
        # Many requests at once are none with a large head.
        connection.sendall(f"GET /livez HTTP/1.1\r\n{HOST}x: {'a' * 5000}\r\n\r\n".encode() * 40)
        answers = b""
        while answers.count(b"HTTP/1.1 200") < 40:
            piece = connection.recv(1 << 16)
            assert piece, answers
            answers += piece


@pytest.mark.parametrize("end", [b"x: a\r\n", b"0;"], ids=["trailers", "chunk extension"])
def test_what_is_in_a_chunked_body_and_no_body_is_bounded(server: ServerProcess, end: bytes):
    with open_connection(server) as connection:
        key = server.key  # type: ignore[attr-defined]
        head = f"POST /v1/positions HTTP/1.1\r\n{HOST}X-API-Key: {key}\r\nContent-Type: application/json\r\n"
        connection.sendall(f"{head}Transfer-Encoding: chunked\r\n\r\n".encode())
        connection.sendall(b"1\r\n{\r\n" + (b"0\r\n" if end.startswith(b"x") else end))
        assert (
            send_until_refused(connection, b"x: a\r\n" * 10_000 if end.startswith(b"x") else b"a" * 65536, 1 << 28)
            < 1 << 27
        )


def test_small_chunks_are_a_body(server: ServerProcess):
    body = json.dumps(REPORT).encode()
    key = server.key  # type: ignore[attr-defined]
    with server.client() as http:
        headers = {"x-api-key": key, "content-type": "application/json"}
        pieces = (body[n : n + 1] for n in range(len(body)))
        assert http.post("/v1/positions", content=pieces, headers=headers).status_code == 200
        spaces = (b" " for _ in range(20_000))
        assert http.post("/v1/positions", content=spaces, headers=headers).status_code == 400


# --- time ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"", b""),
        (b"\r\n", b""),
        (b"GET /livez HTTP/1.1\r\nHost: x", b" 408 "),
        (b"GET /livez HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b" 200 "),
        (b"GET /livez HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n\r\n", b" 200 "),
        (b"GET /livez HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET", b" 408 "),
        (b"POST /v1/positions HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n{", b" 401 "),
    ],
    ids=[
        "nothing",
        "a line's end",
        "half a head",
        "idle",
        "idle after a line's end",
        "half a second head",
        "half a body",
    ],
)
def test_a_silent_connection_ends(server: ServerProcess, sent: bytes, answer: bytes):
    with open_connection(server) as connection:
        connection.sendall(sent)
        assert answer in read_all(connection)


def test_a_byte_now_and_then_does_not_keep_a_connection(server: ServerProcess):
    key = server.key  # type: ignore[attr-defined]
    post = f"POST /v1/positions HTTP/1.1\r\n{HOST}X-API-Key: {key}\r\nContent-Type: application/json\r\n"
    for begin in ("GET /livez HTTP/1.1\r\nx: ", f"{post}Content-Length: 9999\r\n\r\n"):
        with open_connection(server) as connection:
            connection.sendall(begin.encode())
            start = time.monotonic()
            with contextlib.suppress(ConnectionError):
                while time.monotonic() - start < 15.0:
                    connection.sendall(b" ")
                    connection.settimeout(0.2)
                    with contextlib.suppress(TimeoutError):
                        assert status(connection.recv(1 << 16)) == 408
                        break
            assert time.monotonic() - start < 10.0


def test_the_body_of_a_refused_request_is_not_read_for_ever(server: ServerProcess):
    for head in ("Transfer-Encoding: chunked\r\n\r\n10000\r\n", "Content-Length: 99999999999\r\n\r\n"):
        with open_connection(server) as connection:
            connection.sendall(f"POST /v1/positions HTTP/1.1\r\n{HOST}{head}".encode())
            answer = connection.recv(1 << 16)
            assert status(answer) == 401
            assert b"connection: close" in answer.lower()
            piece = b"a" * 65536 + (b"\r\n10000\r\n" if "chunked" in head else b"")
            assert send_until_refused(connection, piece, 1 << 30) < 1 << 29


def test_a_refused_body_that_is_short_leaves_the_connection_open(server: ServerProcess):
    with open_connection(server) as connection:
        connection.sendall(f"POST /v1/positions HTTP/1.1\r\n{HOST}Content-Length: 5\r\n\r\n".encode())
        assert status(connection.recv(1 << 16)) == 401
        connection.sendall(f"12345GET /livez HTTP/1.1\r\n{HOST}\r\n".encode())
        assert status(connection.recv(1 << 16)) == 200


def test_an_answer_that_nobody_reads_ends_the_connection(server: ServerProcess):
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect(("127.0.0.1", server.port))
        connection.settimeout(20)
        before = figures(server)["unread"]
        request = f"GET /openapi.json HTTP/1.1\r\n{HOST}\r\n".encode()
        connection.sendall(request * 90)
        deadline = time.monotonic() + 15.0
        while figures(server)["unread"] == before:
            assert time.monotonic() < deadline
            time.sleep(0.1)


# --- many ------------------------------------------------------------------------------------------------


def test_silent_connections_give_way(server: ServerProcess):
    before = figures(server)["full"]
    silent = [open_connection(server) for _ in range(200)]
    try:
        assert alive(server) < 5.0
        key = server.key  # type: ignore[attr-defined]
        with server.client() as http:
            assert http.post("/v1/positions", json=REPORT, headers={"x-api-key": key}).status_code == 200
        assert figures(server)["full"] - before >= 150
    finally:
        for connection in silent:
            connection.close()


def test_with_all_connections_at_work_only_life_is_shown(hall_table_path: Path):
    """Streams of events take all there are."""
    settings = {"connection_limits": {"connections": 8}}
    with start_server(hall_table_path, settings=settings) as server:
        streams = []
        for _ in range(8):
            streams.append(open_connection(server))
            streams[-1].sendall(f"GET /v1/fixes HTTP/1.1\r\n{HOST}\r\n".encode())
            assert status(streams[-1].recv(1 << 16)) == 200
        for _ in range(50):
            assert alive(server) < 5.0
            with server.client() as http:
                refusal = http.post("/v1/positions", json=REPORT)
            assert refusal.status_code == 503
            assert refusal.headers["retry-after"] == "1"
            assert refusal.json()["type"] == "urn:rayfix:problem:overloaded"
        idle = [open_connection(server) for _ in range(100)]
        assert alive(server) < 5.0
        for connection in (*streams, *idle):
            connection.close()
        deadline = time.monotonic() + 20.0
        with server.client() as http:
            while http.post("/v1/positions", json=REPORT).status_code != 200:
                assert time.monotonic() < deadline
                time.sleep(0.1)
        assert "Traceback" not in server.stop()


def test_the_systems_limit_of_files_is_never_met(monkeypatch: pytest.MonkeyPatch):
    limits = ConnectionLimits(connections=1000)
    asked: list[Any] = []
    monkeypatch.setattr(server_module.resource, "setrlimit", lambda which, pair: asked.append(pair))
    for (soft, hard), connections, raised in [
        ((256, 4096), 1000, [(1150, 4096)]),
        ((256, 512), 362, [(512, 512)]),
        ((4096, 4096), 1000, []),
    ]:
        asked.clear()
        monkeypatch.setattr(server_module.resource, "getrlimit", lambda which, pair=(soft, hard): pair)
        assert fitting(limits).connections == connections
        assert asked == raised


# --- the end ---------------------------------------------------------------------------------------------


def test_slow_clients_do_not_hold_up_the_end(hall_table_path: Path):
    with (
        start_server(hall_table_path) as server,
        open_connection(server) as half_head,
        open_connection(server) as half_body,
    ):
        half_head.sendall(b"GET /livez HTTP/1.1\r\nx: ")
        half_body.sendall(f"POST /v1/positions HTTP/1.1\r\n{HOST}Content-Type: application/json\r\n".encode())
        half_body.sendall(b"Content-Length: 99\r\n\r\n{")
        alive(server)
        start = time.monotonic()
        log = server.stop()
        assert time.monotonic() - start < 9.0
        assert b" 408 " in read_all(half_body)
    told = [line for line in log.splitlines() if "closed: the body of a request did not come in time" in line]
    assert len(told) == 1
    assert "Traceback" not in log
    assert "ERROR" not in log


# --- web sockets -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "field"),
    [
        ("POST /v1/stream", ""),
        ("GET /v1/stream", "x: " + "a" * 9000),
        ("GET /v1/stream?" + "a" * 9000, ""),
        ("GET /v1/stream", "Sec-WebSocket-Version: 1"),
        ("GET /v1/stream", "x: caf\u00e9"),
    ],
)
def test_an_odd_handshake_is_refused(server: ServerProcess, first: str, field: str):
    with open_connection(server) as connection:
        head = f"{first} HTTP/1.1\r\n{HOST}Upgrade: websocket\r\nConnection: Upgrade\r\n"
        head += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
        head += f"{field}\r\n" if field else ""
        connection.sendall(f"{head}\r\n".encode())
        assert 400 <= status(read_all(connection)) < 500


# --- settings --------------------------------------------------------------------------------------------


def test_the_command_has_the_limits_of_the_settings(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    served: list[ServiceSettings] = []
    monkeypatch.setattr(server_module, "serve", lambda tables, *, settings, **options: served.append(settings))
    assert main(["serve", "hall.h5"]) == 0
    assert (served[0].connection_limits, served[0].feed_limits) == (ConnectionLimits(), FeedLimits())
    options = ["--connections", "7", "--head-kib", "8", "--head-fields", "9", "--head-seconds", "1", "--body-seconds"]
    options += ["2", "--idle-seconds", "3", "--unread-seconds", "4", "--listeners", "5", "--backlog-kib", "6"]
    assert main(["serve", "hall.h5", *options, "--allowed-host", "maps.example.com"]) == 0
    assert served[1].connection_limits == ConnectionLimits(
        connections=7,
        head_bytes=8 << 10,
        head_fields=9,
        head_seconds=1.0,
        body_seconds=2.0,
        idle_seconds=3.0,
        unread_seconds=4.0,
    )
    messages = ["--report-values", "1", "--message-values", "2", "--message-results", "3", "--message-stations", "4"]
    messages += ["--batch-rest-kib", "5", "--listed-errors", "6", "--body-kib", "7", "--batch-kib", "8"]
    hub = ["--omlox-hub", "http://hub:8081/v2", "--hub-answer-kib", "9"]
    assert main(["serve", "hall.h5", *messages, *hub]) == 0
    assert (served[0].message_limits, served[0].body_limits) == (MessageLimits(), BodyLimits())
    assert served[2].message_limits == MessageLimits(
        report_values=1, message_values=2, results=3, stations=4, batch_rest_bytes=5 << 10, listed_problems=6
    )
    assert served[2].body_limits == BodyLimits(report=7 << 10, batch=8 << 10)
    assert served[2].hub is not None
    assert served[2].hub.answer_bytes == 9 << 10
    assert served[1].feed_limits == FeedLimits(listeners=5, backlog_bytes=6 << 10)
    assert served[1].hosts == ("maps.example.com",)
    for option, value in (("--connections", "0"), ("--head-seconds", "0"), ("--body-seconds", "x")):
        with pytest.raises(SystemExit):
            main(["serve", "hall.h5", option, value])
        assert f"{option}: '{value}' is no" in capsys.readouterr().err


def test_httpx_reads_the_refusal_of_a_long_body(server: ServerProcess):
    with server.client() as http:
        refusal = http.post("/v1/positions", content=b" " * (8 << 20), headers={"content-type": "application/json"})
    assert refusal.status_code == httpx.codes.UNAUTHORIZED
