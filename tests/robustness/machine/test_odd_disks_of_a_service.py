"""Services whose temporary folder is full, or goes away, and what they say where there is none."""

import asyncio
import shutil
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from rayfix_service.http.answering.feed import FixFeed
from rayfix_service.http.answering.feed_relay import FeedRelay
from tests.support.running.full_disk import mounted, needs_mounts, seen_by, temporary_folders
from tests.support.running.server_process import ServerProcess
from tests.support.tables.hand_tables import line_of_sight, table_of

REPORT = {"measurements": [{"type": "pt", "station_id": "a", "range_m": 3.0, "stdev_m": 1.0}]}
EXECUTE = "import os, sys; os.execvp(sys.argv[1], sys.argv[1:])"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Return the path of a small table."""
    return table_of(tmp_path / "hand.h5", *(line_of_sight(station) for station in "abc")).path


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the temporary folder of processes that start from here."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


def serving(table: Path, *, workers: int = 2) -> list[str]:
    """Return the command that serves a table."""
    return [sys.executable, "-m", "rayfix", "serve", str(table), "--port", "0", "--workers", str(workers)]


def kill_one(server: ServerProcess) -> None:
    """Kill a worker and wait until another is ready in its place."""
    ready = sum("ready with" in line for line in server.log)
    psutil.Process(server.process.pid).children()[0].kill()
    server.wait_for("ready with", ready + 1)


def statuses(server: ServerProcess) -> list[int]:
    """Ask for what a worker writes down: a request of a new kind, a fix, a reload, the figures."""
    with server.client() as http:
        answers = [
            http.get("/v1/nowhere"),
            http.post("/v1/positions", json=REPORT),
            http.post("/v1/tables/reload"),
            http.get("/metrics"),
        ]
    return [answer.status_code for answer in answers]


@needs_mounts
def test_workers_outlive_a_full_temporary_folder(table: Path, temporary: Path):
    """A mapped page without room ends a process by a signal, and would end each of its successors."""
    command = mounted(serving(table), small=[(temporary, "12m")])
    with ServerProcess("-c", EXECUTE, *command, workers=2) as server:
        fill(seen_by(server.process.pid, temporary) / "filler")
        assert [statuses(server) for _ in range(4)] == [[404, 200, 200, 200]] * 4
        kill_one(server)
        assert [statuses(server) for _ in range(4)] == [[404, 200, 200, 200]] * 4
        log = server.stop()
    assert "status -7" not in log
    assert log.count("is replaced") == 1
    assert "figures of process" in log
    assert "No space left on device" in log
    assert "Traceback" not in log


def fill(path: Path) -> None:
    """Leave no room on a disk."""
    with path.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            return


def test_workers_outlive_their_temporary_folder(table: Path, temporary: Path):
    """As systemd removes what is ten days old."""
    with ServerProcess(*serving(table)[1:], workers=2) as server:
        (folder,) = temporary.glob("rayfix-serve-*")
        shutil.rmtree(folder)
        kill_one(server)
        assert [statuses(server) for _ in range(4)] == [[404, 200, 200, 503]] * 4
        with server.client() as http:
            assert "start the service again" in http.get("/metrics").json()["detail"]
        log = server.stop()
    assert "the other workers are not asked" in log
    assert "cannot be made: " in log
    assert "Traceback" not in log


def test_a_temporary_folder_of_a_long_path(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """Sockets have short paths; all but the other workers' fixes goes on."""
    folder = tmp_path / ("long" * 25)
    folder.mkdir()
    asyncio.run(FeedRelay(FixFeed(), folder).keep())
    (message,) = caplog.messages
    assert "do not reach the listeners of other workers" in message
    assert "set TMPDIR to a folder with a short path" in message


@needs_mounts
def test_without_any_temporary_folder_a_line_says_so(table: Path, temporary: Path):
    """Neither the usual ones nor the current one, which Python takes last."""
    command = mounted(serving(table), read_only=[*temporary_folders(), table.parent])
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, cwd=temporary)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("rayfix: the workers need a temporary folder and there is none")
    assert line.endswith("set TMPDIR to one")


@needs_mounts
@pytest.mark.slow
def test_one_process_needs_no_temporary_folder(table: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(temporary)
    command = mounted(serving(table, workers=1), read_only=[*temporary_folders(), table.parent])
    with ServerProcess("-c", EXECUTE, *command) as server:
        assert statuses(server) == [404, 200, 200, 200]
