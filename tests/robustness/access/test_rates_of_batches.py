"""The rate limit holds, however the reports come."""

import json
import socket
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from websockets.sync.client import connect

from rayfix_service.http.access.keys import add_key
from rayfix_service.http.openapi.examples import UBLOX_EXAMPLES
from tests.support.messages.reports import REPORT
from tests.support.running.server_process import start_server

RATE, BURST, BATCH = 10.0, 20, 200


@pytest.mark.parametrize("path", ["/v1/positions/batch", "/v1/positions/ublox"])
def test_batches_whose_heads_come_first_are_limited(hall_table_path: Path, tmp_path: Path, path: str):
    """All heads are let in, and then all bodies came in."""
    keys = tmp_path / "keys"
    key = add_key(keys, "gateway")
    lines = UBLOX_EXAMPLES["three_anchors"]["value"]
    is_batch = path.endswith("batch")
    body = (json.dumps({"reports": [REPORT] * BATCH}) if is_batch else _many(lines)).encode()
    kind = "application/json" if is_batch else "text/plain"
    head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nX-API-Key: {key}\r\nContent-Type: {kind}\r\n"
    settings = {"api_keys": str(keys), "reports_per_second": RATE}
    with start_server(hall_table_path, settings=settings) as server, ExitStack() as stack:
        start = time.monotonic()
        connections = []
        for _ in range(15):
            connections.append(stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=60)))
            connections[-1].sendall(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body[:9])
        with server.client() as http:
            assert http.get("/livez").status_code == 200  # by now all heads were read
        for connection in connections:
            connection.sendall(body[9:])
        statuses = [int(connection.recv(1 << 16).split(b" ")[1]) for connection in connections]
        seconds = time.monotonic() - start
    assert set(statuses) == {200, 429}
    reports = statuses.count(200) * (BATCH if is_batch else body.count(b"\n") / lines.count("\n"))
    assert reports <= RATE * seconds + BURST + BATCH


def _many(lines: str) -> str:
    """Return the lines of a transmission, for as many transmissions of other tags as a batch has reports."""
    return "".join(lines.replace("+UUDF:", f"+UUDF:{n:03d}") for n in range(100, 100 + 150))


def test_many_streams_of_one_key_are_limited_together(hall_table_path: Path, tmp_path: Path):
    """All of them waited for the same token, and then all took it."""
    keys = tmp_path / "keys"
    key = add_key(keys, "gateway")
    settings = {"api_keys": str(keys), "reports_per_second": RATE}
    with start_server(hall_table_path, settings=settings) as server, ExitStack() as stack:
        url = f"ws://127.0.0.1:{server.port}/v1/stream"
        start = time.monotonic()
        sockets = [
            stack.enter_context(connect(url, additional_headers={"X-API-Key": key}, open_timeout=30)) for _ in range(30)
        ]
        for _ in range(3):
            for socket_ in sockets:
                socket_.send(json.dumps(REPORT))
        while time.monotonic() - start < 3.0:
            time.sleep(0.1)
        with server.client() as http:
            figures = http.get("/metrics", headers={"x-api-key": key}).text
        seconds = time.monotonic() - start
    (fixes,) = (float(x.split()[1]) for x in figures.splitlines() if x.startswith("rayfix_fusion_seconds_count"))
    assert 0 < fixes <= RATE * seconds + BURST + 1
