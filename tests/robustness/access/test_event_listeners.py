"""Listeners of the feed that never read cost a bounded amount of memory."""

import asyncio
import re
import socket
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from rayfix_service.http.answering.feed import FixFeed
from rayfix_service.http.settings import FeedLimits
from tests.support.messages.reports import REPORT
from tests.support.running.server_process import ServerProcess, start_server


def silent_listener(server: ServerProcess, stack: ExitStack) -> bytes:
    """Open a listener that reads the head of its answer and then nothing; the status line."""
    connection = stack.enter_context(socket.socket())
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.settimeout(20)
    connection.connect(("127.0.0.1", server.port))
    connection.sendall(b"GET /v1/fixes HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    return connection.recv(64)


def resident_mib(server: ServerProcess) -> float:
    status = Path(f"/proc/{server.process.pid}/status").read_text()
    return int(re.findall(r"VmRSS:\s+(\d+) kB", status)[0]) / 1024


def test_listeners_that_never_read_cost_little_and_are_closed(hall_table_path: Path):
    settings = {"feed_limits": {"listeners": 50}, "connection_limits": {"unread_seconds": 3.0}}
    report = REPORT | {"target_id": "x" * 250}
    batch = {"reports": [report] * 500}
    with start_server(hall_table_path, settings=settings) as server, ExitStack() as stack:
        with server.client() as http:
            assert http.post("/v1/positions/batch", json=batch).status_code == 200
            before = resident_mib(server)
            statuses = [silent_listener(server, stack) for _ in range(60)]
            assert sum(b" 200 " in s for s in statuses) == 50
            assert sum(b" 503 " in s for s in statuses) == 10
            most = 0.0
            deadline = time.monotonic() + 100.0
            while True:
                answer = http.post("/v1/positions/batch", json=batch)
                assert {fix["status"] for fix in answer.json()["results"]} == {"ok"}
                most = max(most, resident_mib(server))
                found = re.findall(r'closed_total\{reason="unread"\} (\S+)', http.get("/metrics").text)
                if float(found[0]) == 50:
                    break
                assert time.monotonic() < deadline, (found, most - before)
            assert most - before < 60.0
            assert b" 200 " in silent_listener(server, stack)  # there is room again
        assert "Traceback" not in server.stop()


def test_a_backlog_is_bounded_in_bytes():
    async def run() -> None:
        feed = FixFeed(FeedLimits(listeners=2, backlog_bytes=1000))
        with feed.subscribe() as listener, feed.subscribe(own=True) as relay:
            assert not feed.is_full
            for n in range(10):
                feed.publish("hall", None, partial(bytes, b"%d" % n * 300))
            dropped, events = listener.take()
            assert (dropped, [event.data[:1] for event in events]) == (7, [b"7", b"8", b"9"])
            assert len(relay.take()[1]) == 10
            feed.publish("hall", None, lambda: b"a" * 5000)  # one alone is kept, however long
            assert listener.take()[0] == 0
            with feed.subscribe():
                assert feed.is_full

    asyncio.run(run())
