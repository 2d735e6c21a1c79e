"""Workers that cannot start, and what services that were killed leave behind."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import psutil
import pytest

from rayfix_service.http.access.keys import add_key
from rayfix_service.http.answering.runtime_folder import runtime_folder
from tests.support.running.server_process import start_server
from tests.support.running.talking_process import TalkingProcess
from tests.support.tables.hand_tables import line_of_sight, table_of

RUN = """\
    import os, sys, time
    from pathlib import Path
    from rayfix_service.server import workers

    workers._LOOK_SECONDS = 0.02
    broken = Path(sys.argv[1])

    def work():
        if broken.exists():
            workers.tell_failure(broken.read_text())
            sys.exit(workers.COULD_NOT_START)
        workers.tell_started()
        os.write(1, b"worker %d\\n" % os.getpid())  # at once: both say it at the same time
        time.sleep(60)

    workers.run_workers(work, count=2, meanwhile=lambda: None, ending=lambda: None)
    print("ended", flush=True)
    """


@contextmanager
def running(*arguments: str) -> Iterator[TalkingProcess]:
    """Run workers, and end them in any case, lest a test waits for ever for what is not said."""
    run = TalkingProcess(RUN, *arguments)
    limit = threading.Timer(100, run.process.kill)
    limit.start()
    try:
        yield run
    finally:
        limit.cancel()
        run.process.kill()
        run.process.communicate(timeout=30)


def test_a_worker_that_cannot_start_is_tried_again_while_others_run(tmp_path: Path):
    broken = tmp_path / "broken"
    with running(str(broken)) as run:
        first, _ = (int(run.read(r"worker (\d+)$")) for _ in range(2))
        broken.write_text("the key file is half written")
        os.kill(first, signal.SIGKILL)
        run.read("a worker cannot start and is tried again: the key file is half written")
        broken.write_text("the key file is empty")
        run.read("a worker cannot start and is tried again: the key file is empty")
        broken.unlink()
        run.read(r"worker (\d+)$")
        assert run.said.count("cannot start") == 2  # once for each reason
        run.process.send_signal(signal.SIGTERM)
        run.read("^ended$")
        assert run.process.wait(10) == 0


def test_workers_that_have_run_are_tried_again_though_none_is_left(tmp_path: Path):
    broken = tmp_path / "broken"
    with running(str(broken)) as run:
        pids = [int(run.read(r"worker (\d+)$")) for _ in range(2)]
        broken.write_text("no keys")
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        run.read("a worker cannot start and is tried again: no keys")
        broken.unlink()
        assert not {int(run.read(r"worker (\d+)$")) for _ in range(2)} & set(pids)


def test_a_service_none_of_whose_first_workers_can_start_ends_with_the_reason(tmp_path: Path):
    (tmp_path / "broken").write_text("no keys")
    with running(str(tmp_path / "broken")) as run:
        run.read("ServiceError: a worker could not start; no keys")
        assert run.process.wait(10) != 0
        assert "ended" not in run.said


def test_a_key_file_that_is_half_written_for_a_moment_ends_no_service(tmp_path: Path):
    table, keys = tmp_path / "hand.h5", tmp_path / "keys"
    table_of(table, *(line_of_sight(station) for station in "abc"))
    key = add_key(keys, "a")
    whole = keys.read_text()
    with start_server(table, workers=2, settings={"api_keys": str(keys)}) as server:
        keys.write_text("a:12")
        for worker in psutil.Process(server.process.pid).children():
            worker.kill()
        server.wait_for("a worker cannot start and is tried again: ")
        keys.write_text(whole)
        server.wait_for("ready with", 4)
        with server.client() as http:
            assert http.get("/v1/table", headers={"x-api-key": key}).status_code == httpx.codes.OK
        assert "Traceback" not in server.stop()


FORGET = """\
    import sys
    from pathlib import Path
    from rayfix_service.http.telemetry.metrics import forget_dead_workers

    begin = Path(sys.argv[1])
    print("waits", flush=True)
    while not begin.exists():
        pass
    forget_dead_workers()
    """


def test_workers_forget_the_same_dead_worker_at_the_same_time(tmp_path: Path):
    folder = tmp_path / "figures"
    folder.mkdir()
    gone = range(5_000_000, 5_001_000)  # above the greatest number of a process
    names = [f"gauge_{mode}_{pid}.db" for pid in gone for mode in ("livemax", "livemin")]
    kept = ["counter_5000000.db", f"gauge_livemax_{os.getpid()}.db"]
    for name in {*names, *kept}:
        (folder / name).touch()
    environment = {**os.environ, "PROMETHEUS_MULTIPROC_DIR": str(folder), "PYTHONHASHSEED": "0"}
    command = [sys.executable, "-c", textwrap.dedent(FORGET), str(tmp_path / "begin")]
    with_pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment}
    processes = [subprocess.Popen(command, **with_pipes) for _ in range(3)]  # type: ignore[call-overload]
    try:
        for process in processes:
            assert process.stdout.readline() == "waits\n"
        (tmp_path / "begin").touch()
        for process in processes:
            assert process.communicate(timeout=60)[1] == ""
            assert process.returncode == 0
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    assert {path.name for path in folder.iterdir()} == set(kept)


HOLD = """\
    import os, sys
    from rayfix_service.http.answering.runtime_folder import runtime_folder

    with runtime_folder() as folder:
        (folder / "figures").mkdir()
        if child := os.fork():
            print(folder, child, flush=True)
        sys.stdin.read()
    """


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make the temporary folder one of the test's own."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def test_the_folder_of_a_service_that_was_killed_is_removed_by_the_next(temporary: Path):
    """Once its last worker has ended, too: a worker holds the lock that its service took."""
    unlocked = temporary / "rayfix-serve-other"
    unlocked.mkdir()
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(HOLD)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as service:
        assert service.stdout is not None
        name, worker = service.stdout.readline().split()
        service.kill()
        service.wait(30)
        with runtime_folder() as folder:
            assert Path(name).is_dir()
            assert folder.is_dir()
        os.kill(int(worker), signal.SIGKILL)
        psutil.Process(int(worker)).wait(30) if psutil.pid_exists(int(worker)) else None
        with runtime_folder() as folder:
            assert not Path(name).exists()
            with runtime_folder() as another:
                assert folder.is_dir()
                assert another.is_dir()
    assert list(temporary.iterdir()) == [unlocked]


def test_a_folder_of_another_user_or_that_is_a_link_is_left_alone(temporary: Path):
    (temporary / "mine").mkdir()
    (temporary / "mine" / "in-use").touch()
    (temporary / "rayfix-serve-link").symlink_to(temporary / "mine")
    (temporary / "rayfix-serve-file").touch()
    with runtime_folder():
        pass
    assert {path.name for path in temporary.iterdir()} == {"mine", "rayfix-serve-link", "rayfix-serve-file"}
    assert (temporary / "mine" / "in-use").exists()
