"""Bad files among the tables of a service: the others answer, and so do workers that take the place of others."""

import asyncio
import contextlib
import json
import logging
import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import psutil
import pytest

from benchmarks.robustness.flips import flipped
from rayfix_service.http.answering import served_tables, table_checks
from rayfix_service.http.answering.served_tables import load_tables
from rayfix_service.server.server import serve
from rayfix_tables.checked import CheckLimits
from rayfix_tables.disk.schema import write_text
from rayfix_tables.errors import TableError
from tests.support.checkout import ROOT
from tests.support.running.running_app import RunningApp
from tests.support.running.server_process import ServerProcess, start_server
from tests.support.tables.hand_tables import line_of_sight, table_of

POLL = 0.05  # s
HANGS = (2985, 3)  # a bit of the stored table with which HDF5 2.0 is busy for ever
SHORT = CheckLimits(seconds=1.0)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a small table that can be served. Do not change it; copy it."""
    path = tmp_path_factory.mktemp("tables") / "hand.h5"
    table_of(path, *(line_of_sight(station) for station in "abc"))
    return path


@pytest.fixture(scope="module")
def hanging(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file that HDF5 reads for ever."""
    path = tmp_path_factory.mktemp("hanging") / "hanging.h5"
    path.write_bytes(flipped((ROOT / "tests/tables/stored/format-1.h5").read_bytes(), *HANGS))
    return path


def put(source: Path, path: Path) -> None:
    """Rename a copy into place."""
    os.replace(shutil.copy(source, path.with_suffix(".new")), path)


def watching(tables: Path, *, ready: bool = True) -> RunningApp:
    """Return an application that often looks at its tables' files."""
    return RunningApp(tables, ready=ready, watch_seconds=POLL, table_check=SHORT)


def names(service: RunningApp) -> list[str]:
    """Names of the tables that answer."""
    return [table["name"] for table in service.get("/v1/tables").json()["tables"]]


def refused(service: RunningApp) -> list[str]:
    """Names of the files that are refused."""
    found: list[str] = service.get("/readyz").json()["refused"]
    return found


@contextlib.contextmanager
def counted_checks(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Collect the names of files that are checked."""
    checked: list[str] = []
    check_file = table_checks.check_file

    def told(opened, **options):  # type: ignore[no-untyped-def]
        checked.append(opened.path.name)
        return check_file(opened, **options)

    monkeypatch.setattr(table_checks, "check_file", told)
    yield checked


def test_a_file_that_is_read_for_ever_holds_up_nothing(
    table: Path,
    hanging: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
):
    """Also not by reloading: it is checked once, as long as it does not change."""
    put(table, tmp_path / "a.h5")
    with counted_checks(monkeypatch) as checked, watching(tmp_path) as service:
        before = service.get("/v1/table").json()["table_id"]
        put(hanging, tmp_path / "a.h5")
        put(hanging, tmp_path / "b.h5")
        put(table, tmp_path / "c.h5")
        service.wait_for(lambda: "c" in names(service))
        service.wait_for(lambda: refused(service) == ["a", "b"])
        assert names(service) == ["a", "c"]
        assert service.get("/v1/table?table=a").json()["table_id"] == before
        refusal = service.post("/v1/tables/reload")
        assert refusal.status_code == 409
        assert [error["path"] for error in refusal.json()["errors"]] == ["a", "b"]
        service.run(asyncio.sleep(5 * POLL))
        assert sorted(checked) == ["a.h5", "a.h5", "b.h5", "c.h5"]
        figures = service.get("/metrics").text
        assert "rayfix_tables_refused 2.0" in figures
        assert 'rayfix_table_loads_total{outcome="refused"} 2.0' in figures
        put(table, tmp_path / "b.h5")
        service.wait_for(lambda: refused(service) == ["a"])
    lines = [record.getMessage() for record in caplog.records if "table refused" in record.getMessage()]
    assert len(lines) == 2
    assert all("\n" not in line for line in lines)


def test_a_service_with_one_bad_file_is_ready_with_the_others(table: Path, tmp_path: Path):
    put(table, tmp_path / "good.h5")
    (tmp_path / "bad.h5").write_bytes(b"no table")
    assert load_tables(tmp_path).keys() == {"good"}
    with watching(tmp_path) as service:
        assert names(service) == ["good"]
        assert refused(service) == ["bad"]
    (tmp_path / "good.h5").unlink()
    with watching(tmp_path, ready=False) as service:
        service.wait_for(lambda: "does not pass" in service.get("/readyz").text)
        put(table, tmp_path / "good.h5")
        service.wait_for(lambda: service.get("/readyz").status_code == 200)
    (tmp_path / "good.h5").unlink()
    with pytest.raises(TableError, match=r"bad\.h5 is not a rayfix table"):
        serve(tmp_path, port=0)


def test_a_file_that_changes_all_the_time_keeps_no_other_waiting(table: Path, tmp_path: Path):
    put(table, tmp_path / "a.h5")

    async def change(path: Path) -> None:
        with path.open("ab") as file:
            while True:
                file.write(b"more")
                file.flush()
                await asyncio.sleep(POLL / 5)

    with watching(tmp_path) as service:

        async def start() -> asyncio.Task[None]:
            return asyncio.create_task(change(tmp_path / "busy.h5"))

        busy = service.run(start())
        service.run(asyncio.sleep(5 * POLL))
        put(table, tmp_path / "b.h5")
        service.wait_for(lambda: "b" in names(service), seconds=30)
        busy.cancel()


ODD_NAMES = [b"caf\xe9.h5", b"two\nlines.h5", b"bell\x07.h5", "right\u202eleft.h5".encode(), b"\x1b[31mred.h5"]


def test_odd_names_and_kinds_of_files_harm_nothing(table: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    for name in ODD_NAMES:
        shutil.copy(table, os.fsencode(tmp_path) + b"/" + name)
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "folder.h5").mkdir()
    (tmp_path / "dangling.h5").symlink_to("nothing")
    (tmp_path / "zero.h5").symlink_to("/dev/zero")
    (tmp_path / "circle.h5").symlink_to("circle.h5")
    put(table, tmp_path / "gr\u00fcn.h5")
    with caplog.at_level(logging.INFO), watching(tmp_path) as service:
        for path in ("/readyz", "/v1/tables", "/metrics"):
            assert service.get(path).status_code == 200, path
        assert names(service) == ["gr\u00fcn"]
        expected = {"caf\\udce9", "two\\nlines", "bell\\x07", "right\\u202eleft", "\\x1b[31mred"}
        assert set(refused(service)) == expected | {"pipe", "folder", "dangling", "zero", "circle"}
        refusal = service.post("/v1/tables/reload")
        assert refusal.status_code == 409
        errors = refusal.json()["errors"]
        assert len(errors) == len(refused(service))
        assert all(error["message"].isprintable() and error["path"].isprintable() for error in errors)
        service.run(asyncio.sleep(5 * POLL))
    lines = [record.getMessage() for record in caplog.records if record.name.startswith("rayfix_service")]
    assert all(line.isprintable() for line in lines)
    assert sum("table refused" in line for line in lines) == len(ODD_NAMES) + 5


def test_a_check_is_ended_with_its_service(hanging: Path, table: Path, tmp_path: Path):
    put(table, tmp_path / "a.h5")
    children: list[psutil.Process] = []
    with RunningApp(tmp_path, watch_seconds=POLL) as service:  # with 10 s for a check
        put(hanging, tmp_path / "b.h5")

        def checking() -> bool:
            children[:] = [each for each in psutil.Process().children() if "rayfix_tables" in " ".join(each.cmdline())]
            return bool(children)

        service.wait_for(checking)
    _, alive = psutil.wait_procs(children, timeout=5)
    assert not alive


def test_a_check_that_cannot_be_made_now_is_made_later(table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):

    put(table, tmp_path / "a.h5")
    monkeypatch.setattr(served_tables, "_AGAIN_SECONDS", POLL)
    check_file = table_checks.check_file
    failures = [OSError(12, "Cannot allocate memory")] * 3

    def told(opened, **options):  # type: ignore[no-untyped-def]
        if opened.path.name == "b.h5" and failures:
            raise TableError(f"{opened.path} cannot be checked now ({failures.pop()}); try again")
        return check_file(opened, **options)

    monkeypatch.setattr(table_checks, "check_file", told)
    with watching(tmp_path) as service:
        put(table, tmp_path / "b.h5")
        service.wait_for(lambda: "b" in names(service))
        assert refused(service) == []
        assert 'rayfix_table_loads_total{outcome="refused"} 1.0' in service.get("/metrics").text


def workers_of(server: ServerProcess) -> list[psutil.Process]:
    """Return the processes that answer."""
    return [
        each for each in psutil.Process(server.process.pid).children() if "rayfix_tables" not in str(each.cmdline())
    ]


def readiness(server: ServerProcess) -> dict[str, object]:
    """Answer of ``/readyz``, once there is one."""
    deadline = time.monotonic() + 60
    while True:
        with contextlib.suppress(Exception), server.client() as http:
            found: dict[str, object] = http.get("/readyz").json()
            return found
        assert time.monotonic() < deadline
        time.sleep(0.1)


def kill_all(server: ServerProcess, count: int) -> None:
    """Kill all workers and wait until so many others are ready."""
    said = sum("ready with" in line for line in server.log)
    for worker in workers_of(server):
        worker.send_signal(signal.SIGKILL)
    server.wait_for("ready with", said + count)


def test_workers_are_replaced_while_a_bad_file_lies_there(table: Path, hanging: Path, tmp_path: Path):
    put(table, tmp_path / "good.h5")
    put(hanging, tmp_path / "bad.h5")
    settings = {"table_check": {"seconds": 1.0}, "watch_seconds": 0.2}
    with start_server(tmp_path, workers=2, settings=settings) as server:
        for _ in range(2):
            kill_all(server, 2)
            document = readiness(server)
            assert document["refused"] == ["bad"]
            assert [each["name"] for each in document["tables"]] == ["good"]  # type: ignore[attr-defined]
        log = server.stop()
    assert "could not start" not in log
    assert "status -11" not in log


def test_the_old_table_answers_from_new_workers_while_its_file_is_bad(table: Path, hanging: Path, tmp_path: Path):
    """Also a table that came after the start."""
    path = tmp_path / "hall.h5"
    put(table, path)
    settings = {"table_check": {"seconds": 1.0}, "watch_seconds": 0.2}
    with start_server(path, workers=2, settings=settings) as server:
        table_id = readiness(server)["tables"][0]["table_id"]  # type: ignore[index]
        with h5py.File(shutil.copy(table, tmp_path / "next"), "r+") as file:
            write_text(file, "software_version", "next")
        os.replace(tmp_path / "next", path)
        server.wait_for("loaded table hall", 2)
        time.sleep(1.5)  # the first process looks twice a second
        put(hanging, path)
        server.wait_for("table refused", 2)
        kill_all(server, 2)
        assert readiness(server)["tables"] == [{"name": "hall", "table_id": table_id}]
        with server.client() as http:
            assert http.get("/v1/table").json()["software_version"] == "next"
        put(table, path)
        said = sum("loaded table hall" in line for line in server.log)
        server.wait_for("loaded table hall", said + 2)
        assert json.dumps(readiness(server)["refused"]) == "[]"
