"""Worker processes: forked once all is loaded, replaced when they die or hang, gone with their service."""

import gc
import json
import os
import shutil
import signal
import socket
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import h5py
import httpx
import psutil
import pytest

from rayfix_service.http.access.keys import add_key
from rayfix_service.http.answering.served_tables import file_state, forget_changed, load_tables
from tests.support.messages.reports import REPORT
from tests.support.running.server_process import start_server
from tests.support.running.talking_process import TalkingProcess

RUN = """\
    import os, signal, sys
    from rayfix_service.server import workers

    workers._LOOK_SECONDS, workers._SILENT_LOOKS = 0.02, {silent_looks}

    def work():
        os.write(1, b"worker %d\\n" % os.getpid())  # at once: both say it at the same time
        {work}

    workers.run_workers(work, count=2, meanwhile=lambda: None, ending=lambda: None)
    print("ended", flush=True)
    """
MANY_LOOKS = (
    5000  # a worker of a busy machine may take seconds to its first beat, and must not be taken for one that hangs
)
SERVE = """\
    import os, sys
    from rayfix_service.http.answering import table_checks
    from rayfix_service.server.server import serve

    check_file = table_checks.check_file

    def told(*arguments, **options):
        os.write(2, b"verified\\n")
        return check_file(*arguments, **options)

    table_checks.check_file = told
    serve(sys.argv[1], port=0, workers=2)
    """


class Service(TalkingProcess):
    """A process that has workers, and what it has printed."""

    def worker(self) -> int:
        """Read on until a worker tells of its process, and return that."""
        return int(self.read(r"worker (\d+)$"))


@contextmanager
def service(code: str, *arguments: str) -> Iterator[Service]:
    """Run code, and end it in any case, lest a test waits for ever for what is not said."""
    started = Service(code, *arguments)
    limit = threading.Timer(100, started.process.kill)
    limit.start()
    try:
        yield started
    finally:
        limit.cancel()
        started.process.kill()
        started.process.communicate(timeout=30)


def ends(pid: int) -> bool:
    """Wait for a process that is no child of this one to end, and tell whether it did."""
    try:
        psutil.Process(pid).wait(timeout=10)
    except psutil.NoSuchProcess:
        return True
    except psutil.TimeoutExpired:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    return True


def test_a_worker_that_dies_or_hangs_is_replaced_and_all_end_together():
    with service(RUN.format(work="signal.pause()", silent_looks=400)) as run:
        first, second = run.worker(), run.worker()
        os.kill(first, signal.SIGKILL)
        third = run.worker()
        assert f"worker {first} has ended with status -9" in run.said
        os.kill(second, signal.SIGSTOP)
        fourth = run.worker()
        assert f"worker {second} hangs" in run.said
        assert len({first, second, third, fourth}) == 4
        run.process.send_signal(signal.SIGTERM)
        run.read("^ended$")
        assert run.process.wait(10) == 0
        assert all(ends(pid) for pid in (first, second, third, fourth))
        assert run.said.count("replaced") == 2


def test_workers_whose_service_is_killed_end_by_themselves():
    with service(RUN.format(work="signal.pause()", silent_looks=MANY_LOOKS)) as run:
        pids = [run.worker(), run.worker()]
        run.process.kill()
        assert all(ends(pid) for pid in pids)


def test_workers_none_of_which_can_start_end_the_service():
    with service(RUN.format(work="sys.exit(workers.COULD_NOT_START)", silent_looks=MANY_LOOKS)) as run:
        pids = [run.worker(), run.worker()]
        run.read("ServiceError: a worker could not start; the log has the cause")
        assert run.process.wait(10) != 0
        assert all(ends(pid) for pid in pids)


@pytest.mark.slow
def test_a_table_is_verified_once_for_all_workers_and_again_when_it_changes(hall_table_copy: Path):
    with service(SERVE, str(hall_table_copy)) as run:
        port = int(run.read(r"running on http://127\.0\.0\.1:(\d+)"))
        pids = [int(run.read(r"Started server process \[(\d+)\]")) for _ in range(2)]
        while run.said.count("ready with") < 2:
            run.read("ready with")
        assert run.said.count("verified") == 1

        # Who takes the place of a dead worker has the table too; a new file is verified by one for all.
        os.kill(pids[0], signal.SIGKILL)
        run.read("ready with")
        assert run.said.count("verified") == 1
        beside = shutil.copy(hall_table_copy, hall_table_copy.with_suffix(".new"))
        os.replace(beside, hall_table_copy)
        for _ in range(2):
            run.read("loaded table copy")
        assert run.said.count("verified") == 2
        os.kill(pids[1], signal.SIGKILL)
        run.read("ready with")
        assert run.said.count("verified") == 2
        assert httpx.get(f"http://127.0.0.1:{port}/readyz", trust_env=False, timeout=30).status_code == 200
        run.process.send_signal(signal.SIGTERM)
        assert run.process.wait(30) == 0


@pytest.mark.parametrize("workers", [1, 2])
def test_what_was_sent_before_the_end_is_answered(hall_table_path: Path, workers: int):
    body = json.dumps(REPORT).encode()
    head = "POST /v1/positions HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    head += f"Content-Length: {len(body)}"
    with start_server(hall_table_path, workers=workers) as server, ExitStack() as stack:
        address = ("127.0.0.1", server.port)
        server.wait_for("startup complete", workers)
        first = psutil.Process(server.process.pid)
        answering = first.children() if workers > 1 else [first]
        # All is sent and SIGTERM too while nobody can accept a connection, let alone read from it.
        for process in answering:
            process.suspend()
        connections = [stack.enter_context(socket.create_connection(address, 30)) for _ in range(40)]
        for connection in connections:
            connection.sendall(f"{head}\r\n\r\n".encode() + body)
        first.terminate()
        time.sleep(0.6)  # the first process of several looks twice a second
        for process in answering:
            process.resume()
        assert [connection.recv(12) for connection in connections] == [b"HTTP/1.1 200"] * 40
        server.process.wait(30)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(address)


def test_the_first_process_lets_go_of_a_table_whose_file_has_changed(hall_table_copy: Path):
    tables = load_tables(hall_table_copy)
    forget_changed(tables)
    (served,) = tables.values()
    (part, *_) = served.locator.table.parts.values()
    mapped = weakref.ref(part.levels[0].mixture.x_mean)
    os.replace(shutil.copy(hall_table_copy, hall_table_copy.with_suffix(".new")), hall_table_copy)
    assert served.state != file_state(hall_table_copy)
    del served, part
    gc.disable()  # what is frozen is not collected either
    try:
        forget_changed(tables)
        assert not tables
        assert mapped() is None
    finally:
        gc.enable()


def test_a_damaged_table_is_refused_before_there_are_workers(hall_table_copy: Path):
    with h5py.File(hall_table_copy, "r+") as file:
        file["scene/vertices_m"][0, 0] += 1.0
    with service(SERVE, str(hall_table_copy)) as run:
        run.read(r"CorruptTableError: .*copy\.h5 is damaged: the checksum of .* restore it from a copy")
        assert run.process.wait(10) != 0
        assert "running on" not in run.said
        assert "Started" not in run.said


def test_workers_share_the_rate_of_a_key(hall_table_path: Path, tmp_path: Path):
    """Whichever worker answers: the other one is asked once the first has let all reports through."""
    headers = {"x-api-key": add_key(tmp_path / "keys", "a")}
    settings = {"api_keys": str(tmp_path / "keys"), "reports_per_second": 1e-3, "burst_seconds": 5e3}
    with start_server(hall_table_path, workers=2, settings=settings) as server:
        workers = psutil.Process(server.process.pid).children()
        assert len(workers) == 2
        statuses = []
        for silent in workers:
            silent.suspend()
            with server.client() as client:
                statuses.append(
                    [client.post("/v1/positions", json=REPORT, headers=headers).status_code for _ in "1234"]
                )
            silent.resume()
        assert statuses == [[200] * 4, [200, 429, 429, 429]]
