"""The HTTP service as a process of its own, and what it checks before it starts."""

import errno
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from rayfix_service.http.errors import ServiceError
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.http.telemetry.metrics import MULTIPROCESS_VARIABLE
from rayfix_service.server.server import check_address, is_loopback, serve
from rayfix_tables.errors import NotATableError, TableError
from tests.support.messages.reports import REPORT
from tests.support.running.server_process import start_server


def wide_report() -> dict[str, Any]:
    """Angles of all stations, so uncertain that a fix takes some milliseconds."""
    angle = {"type": "aoa", "azimuth_deg": 30, "azimuth_stdev_deg": 10, "zenith_deg": 95, "zenith_stdev_deg": 10}
    return {"measurements": [angle | {"station_id": f"bs{n}"} for n in (1, 2, 3, 4)]}


def test_a_real_server_answers_and_ends(hall_table_path: Path):
    with start_server(hall_table_path) as server:
        with server.client() as http:
            assert http.get("/livez").status_code == http.get("/readyz").status_code == 200
            fix = http.post("/v1/positions", json=REPORT)
            assert fix.status_code == 200
            assert fix.json()["position"] is not None
            for body, status in [(b" " * (2 << 20), 413), (b"{", 400)]:
                refusal = http.post("/v1/positions", content=body, headers={"content-type": "application/json"})
                assert refusal.status_code == refusal.json()["status"] == status
                assert refusal.headers["content-type"] == "application/problem+json"
        # Head and body of an answer arrive together, and answers to requests that were sent at once in their order.
        with socket.create_connection(("127.0.0.1", server.port)) as connection:
            for number in range(3):
                connection.sendall(_posted_report(f"alone-{number}"))
                assert connection.recv(1 << 16).endswith(b"}")
            connection.sendall(_posted_report("first") + _posted_report("second"))
            answers = b""
            while len(found := re.findall(rb"x-request-id: (\w+)", answers)) < 2:
                answers += connection.recv(1 << 16)
            assert found == [b"first", b"second"]
        # A client that leaves within its body is no error, and one that leaves its batch ends that.
        batch = json.dumps({"reports": [wide_report()] * 1000})
        for path, length, body in [
            ("/v1/positions", 99, "{"),
            ("/v1/positions/batch", len(batch), batch),
        ]:
            head = [f"POST {path} HTTP/1.1", "Host: localhost", "Content-Type: application/json"]
            with socket.create_connection(("127.0.0.1", server.port)) as connection:
                connection.sendall("\r\n".join([*head, f"Content-Length: {length}", "", body]).encode())
                time.sleep(0.2)
        server.wait_for("/v1/positions/batch given up: the client left")
        with pytest.raises(ServiceError, match=f"port {server.port}.*give another"):
            serve(hall_table_path, port=server.port)
        log = server.stop()
    assert "Traceback" not in log
    assert "ERROR" not in log
    assert "Application shutdown complete" in log


def _posted_report(identifier: str) -> bytes:
    body = json.dumps(REPORT)
    head = [
        "POST /v1/positions HTTP/1.1",
        "Host: localhost",
        "Content-Type: application/json",
        f"X-Request-ID: {identifier}",
    ]
    return "\r\n".join([*head, f"Content-Length: {len(body)}", "", body]).encode()


@pytest.mark.slow
def test_several_workers_share_a_port(hall_table_path: Path):
    with start_server(hall_table_path, workers=2) as server:
        for _ in range(4):
            with server.client() as http:
                assert http.post("/v1/positions", json=REPORT).status_code == 200
        # Whichever worker is asked answers for both.
        for _ in range(4):
            with server.client() as http:
                figures = http.get("/metrics").text
            assert 'rayfix_http_requests_total{method="POST",route="/v1/positions",status="200"} 4.0' in figures
            assert "rayfix_ready 1.0" in figures
        log = server.stop()
    assert "Traceback" not in log


def test_requests_under_way_are_finished(hall_table_path: Path):
    batch = {"reports": [REPORT] * 300}
    with start_server(hall_table_path) as server, ThreadPoolExecutor(4) as pool:

        def post() -> int:
            with server.client() as http:
                response = http.post("/v1/positions/batch", json=batch)
                assert len(response.json()["results"]) == 300
                return response.status_code

        posted = [pool.submit(post) for _ in range(4)]
        # The first batch is under way when the figures are answered between two of its fixes.
        with server.client() as http:
            while _figure(http.get("/metrics").text, "rayfix_fusion_seconds_count") < 1:
                time.sleep(0.001)
        server.process.send_signal(signal.SIGTERM)
        under_way = [future for future in posted if not future.done()]
        log = server.stop()
        assert under_way
        assert [future.result() for future in posted] == [200] * 4
    assert "Cancel" not in log


def _figure(figures: str, name: str) -> float:
    return next(float(line.split()[1]) for line in figures.splitlines() if line.startswith(f"{name} "))


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_only_its_requests_fail(hall_table_path: Path):
    done = threading.Event()

    def post() -> tuple[int, list[int]]:
        """Post until told to end; how often the connection broke, and the statuses of answers."""
        broken, statuses = 0, []
        while not done.is_set():
            with server.client() as http:
                try:
                    while not done.is_set():
                        statuses.append(http.post("/v1/positions", json=REPORT).status_code)
                except httpx.TransportError:
                    broken += 1
        return broken, statuses

    with start_server(hall_table_path, workers=2) as server, ThreadPoolExecutor(4) as pool:
        (first, _) = (int(pid) for pid in re.findall(r"Started server process \[(\d+)\]", "".join(server.log)))
        posting = [pool.submit(post) for _ in range(4)]
        time.sleep(0.5)
        os.kill(first, signal.SIGKILL)
        server.wait_for("ready with", 3)
        time.sleep(0.5)
        done.set()
        results = [future.result() for future in posting]
        with server.client() as http:
            assert "rayfix_ready 1.0" in http.get("/metrics").text
        server.stop()
    # A client had one request on the way; with a new connection, the worker that is left or the new one answers.
    assert all(broken <= 1 for broken, _ in results)
    assert {status for _, statuses in results for status in statuses} == {200}


def test_the_log_may_be_json(hall_table_path: Path):
    with start_server(hall_table_path, log_format="json", access_log=True) as server:
        with server.client() as http:
            assert http.post("/v1/positions", json=REPORT, headers={"x-request-id": "r-1"}).status_code == 200
        log = server.stop()
    entries = [json.loads(line) for line in log.splitlines()]
    assert all(entry.keys() >= {"time", "level", "logger", "message"} for entry in entries)
    assert any("ready with table" in entry["message"] for entry in entries)
    (access,) = (entry for entry in entries if entry.get("request_id") == "r-1")
    assert access["logger"] == "rayfix_service.access"
    assert (access["method"], access["path"], access["status"]) == ("POST", "/v1/positions", "200")
    assert 0 < access["seconds"] < 30


def no_room(*arguments: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_what_only_this_machine_reaches():
    assert is_loopback("127.0.0.1")
    assert is_loopback("::1")
    assert is_loopback("localhost")
    assert not is_loopback("0.0.0.0")
    assert not is_loopback("192.0.2.1")
    assert not is_loopback("no.such.host.invalid")


def test_what_cannot_be_served_is_said_first(hall_table_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(TableError, match="nowhere"):
        serve(tmp_path / "nowhere.h5", port=0)
    with pytest.raises(NotATableError):
        serve(Path(__file__), port=0)
    with pytest.raises(ServiceError, match="workers is 0; give at least 1"):
        serve(hall_table_path, workers=0)
    with pytest.raises(ServiceError, match="port is 70000; give one from 0 to 65535"):
        serve(hall_table_path, port=70000)
    with pytest.raises(ServiceError, match=r"'no\.such\.host\.invalid'.*127\.0\.0\.1"):
        check_address("no.such.host.invalid", 8000)
    with pytest.raises(ServiceError, match=r"192\.0\.2\.1"):  # an address kept for documentation
        check_address("192.0.2.1", 8000)
    for host in ("0.0.0.0", "::"):
        with pytest.raises(ServiceError, match="API keys are needed; make one with 'rayfix api-key"):
            serve(hall_table_path, host=host)
    for keys, text in [("missing", "cannot be read"), ("empty", "has no key"), ("wrong", "line 2 is no NAME:HASH")]:
        (tmp_path / "empty").write_text("# none yet\n")
        (tmp_path / "wrong").write_text("\nsecret\n")
        with pytest.raises(ServiceError, match=text):
            serve(hall_table_path, port=0, settings=ServiceSettings(api_keys=tmp_path / keys))
    monkeypatch.setenv(MULTIPROCESS_VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(ServiceError, match="nowhere, where metrics cannot be written"):
        serve(hall_table_path, port=0)
    monkeypatch.setenv(MULTIPROCESS_VARIABLE, str(tmp_path))
    monkeypatch.setattr("os.posix_fallocate", no_room)
    with pytest.raises(ServiceError, match=r"No space left on device.*make room"):
        serve(hall_table_path, port=0)
    assert {path.name for path in tmp_path.iterdir()} == {"empty", "wrong"}


def test_a_free_port_is_free_again_after_the_check():
    check_address("127.0.0.1", 0)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ServiceError, match=str(port)):
            check_address("127.0.0.1", port)
    check_address("127.0.0.1", port)
    check_address("127.0.0.1", port)


def test_the_service_needs_no_offline_package():
    code = (
        "import sys\n"
        "for name in ('trimesh', 'sklearn', 'embreex', 'joblib', 'rayfix', 'rayfix_offline'):\n"
        "    sys.modules[name] = None\n"
        "import rayfix_service.server.server\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
