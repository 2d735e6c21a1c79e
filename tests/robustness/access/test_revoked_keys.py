"""A key that is taken out opens nothing, and what it had opened ends."""

import asyncio
import contextlib
import shutil
import socket
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from rayfix_service.http.access.keys import ApiKeys, add_key
from rayfix_service.http.errors import ServiceError
from tests.support.messages.reports import REPORT
from tests.support.running.running_app import RunningApp
from tests.support.running.server_process import ServerProcess, start_server

SECONDS = 5.0


def remove(path: Path, name: str) -> None:
    lines = path.read_text().splitlines(keepends=True)
    path.with_suffix(".new").write_text("".join(line for line in lines if not line.startswith(f"{name}:")))
    path.with_suffix(".new").replace(path)


def listen(server: ServerProcess, key: str) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=SECONDS + 2)
    connection.sendall(f"GET /v1/fixes HTTP/1.1\r\nHost: 127.0.0.1\r\nX-API-Key: {key}\r\n\r\n".encode())
    assert b" 200 " in connection.recv(1 << 16)
    return connection


def test_the_streams_of_a_removed_key_end_and_others_go_on(hall_table_path: Path, tmp_path: Path):
    path = tmp_path / "keys"
    gone, kept = add_key(path, "gone"), add_key(path, "kept")
    with start_server(hall_table_path, settings={"api_keys": str(path)}) as server:
        url = f"ws://127.0.0.1:{server.port}/v1/stream"
        with (
            connect(url, additional_headers={"X-API-Key": gone}) as one,
            connect(url, additional_headers={"X-API-Key": kept}) as other,
            listen(server, gone) as events,
            listen(server, kept) as other_events,
            server.client() as http,
        ):
            remove(path, "gone")
            start = time.monotonic()
            received = b""
            while not received.endswith(b"0\r\n\r\n"):  # the end of the answer
                piece = events.recv(1 << 16)
                assert piece
                received += piece
            with pytest.raises(ConnectionClosed) as closed:
                one.recv(timeout=SECONDS)
            assert time.monotonic() - start < SECONDS
            assert closed.value.rcvd is not None
            assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1008, "the API key is no longer taken")
            other.send("{}")
            assert '"status":422' in str(other.recv(timeout=20))
            http.post("/v1/positions", json=REPORT, headers={"x-api-key": kept})
            text = b""
            while b"event: fix" not in text:
                text += other_events.recv(1 << 16)
            assert http.get("/v1/table", headers={"x-api-key": gone}).status_code == 401
        log = server.stop()
    assert "Traceback" not in log


def test_a_stream_that_nobody_reads_ends_too(hall_table_path: Path, tmp_path: Path):
    path = tmp_path / "keys"
    gone, kept = add_key(path, "gone"), add_key(path, "kept")
    report = REPORT | {"target_id": "x" * 200}
    batch = {"reports": [report] * 200}
    with start_server(hall_table_path, settings={"api_keys": str(path)}) as server, socket.socket() as events:
        events.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        events.connect(("127.0.0.1", server.port))
        events.sendall(f"GET /v1/fixes HTTP/1.1\r\nHost: 127.0.0.1\r\nX-API-Key: {gone}\r\n\r\n".encode())
        with server.client() as http:
            for _ in range(20):  # some 10 MB of events
                assert http.post("/v1/positions/batch", json=batch, headers={"x-api-key": kept}).status_code == 200
            remove(path, "gone")
            server.wait_for("a stream whose key was taken out is cut", seconds=SECONDS)
        assert "Traceback" not in server.stop()


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 2 * SECONDS
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("way", ["last line", "emptied", "unlinked"])
def test_without_keys_nobody_gets_in(hall_table_path: Path, tmp_path: Path, way: str):
    path = tmp_path / "keys"
    key = add_key(path, "only")
    with RunningApp(hall_table_path, api_keys=path, watch_seconds=0.02) as service:

        def gets_in() -> bool:
            service.run(asyncio.sleep(0.02))
            return service.get("/v1/table", headers={"x-api-key": key}).status_code == 200

        assert gets_in()
        if way == "last line":
            remove(path, "only")
        elif way == "emptied":
            path.write_text("")
        else:
            path.unlink()
        until(lambda: not gets_in())
        assert service.get("/v1/table").status_code == 401
        fresh = add_key(path, "fresh")
        until(lambda: service.get("/v1/table", headers={"x-api-key": fresh}).status_code == 200 or gets_in())
        assert not gets_in()


def test_a_file_that_is_empty_or_gone_for_one_look_changes_nothing(tmp_path: Path):
    """Editors empty a file before they write it, and some replace it in two steps."""
    path = tmp_path / "keys"
    key = add_key(path, "only")
    shutil.copy(path, tmp_path / "copy")

    async def look() -> None:
        keys = ApiKeys(path)
        ended: list[str] = []
        with keys.in_use(key, lambda: ended.append("")):
            for damage in (lambda: path.write_text(""), path.unlink):
                damage()
                assert not await keys.reread()
                shutil.copy(tmp_path / "copy", path)
                assert await keys.reread()
                assert keys.name_of(key) == "only"
            for text in ("nonsense", path.read_text()[:-9], "only:"):
                path.write_text(text)
                for _ in range(3):
                    with pytest.raises(ServiceError, match="line 1"):
                        await keys.reread()
                assert keys.name_of(key) == "only"
            assert not ended
            path.write_text("# none\n")
            assert not await keys.reread()
            assert await keys.reread()
            assert ended == [""]
            assert keys.name_of(key) is None

    asyncio.run(look())


def test_a_key_that_is_made_anew_under_its_name_ends_the_streams_of_the_old(tmp_path: Path):
    path = tmp_path / "keys"
    old = add_key(path, "gateway")

    async def look() -> None:
        keys = ApiKeys(path)
        ended: list[str] = []
        with contextlib.ExitStack() as stack:
            stack.enter_context(keys.in_use(old, lambda: ended.append("old")))
            path.unlink()
            new = add_key(path, "gateway")
            assert await keys.reread()
            stack.enter_context(keys.in_use(new, lambda: ended.append("new")))
            stack.enter_context(keys.in_use(old, lambda: ended.append("too late")))
        assert ended == ["old", "too late"]

    asyncio.run(look())
