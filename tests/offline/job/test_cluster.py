"""Building on a real Dask scheduler with worker processes of its own, one of which is killed."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from rayfix_offline.build import build_table
from rayfix_tables.errors import BuildError
from tests.support.scenes.rooms import room_with_crate

SITE = """\
[site]
name = "room"
scene = "room.ply"
[propagation]
max_reflections = 2
max_path_length_m = 20.0
[table]
windows_deg = [3.0, 12.0]
[[stations]]
id = "a"
position_m = [0.4, 0.5, 2.5]
[[stations]]
id = "b"
position_m = [3.5, 0.6, 2.5]
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Site of a room of 4 x 5 x 3 m with a box in it."""
    folder = tmp_path_factory.mktemp("cluster")
    room_with_crate().export(folder / "room.ply")
    (folder / "site.toml").write_text(SITE, encoding="utf-8")
    return folder / "site.toml"


class Processes:
    """A scheduler and workers, each a process."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._stack = stack
        self.file = folder / "scheduler.json"
        self._start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        deadline = time.monotonic() + 60
        while not self._is_written():
            assert time.monotonic() < deadline, "the scheduler did not start"
            time.sleep(0.05)

    def _is_written(self) -> bool:
        """Say whether the scheduler's file is there as a whole: it appears empty and is then written."""
        try:
            json.loads(self.file.read_text(encoding="utf-8"))
        except (FileNotFoundError, json.JSONDecodeError):
            return False
        return True

    def _start(self, module: str, *options: str, before: str = "") -> "subprocess.Popen[bytes]":
        script = f"{before}\nfrom distributed.cli.{module} import main\nmain()"
        command = [sys.executable, "-c", script, "--scheduler-file", str(self.file), *options]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process

    def worker(self, before: str = "") -> "subprocess.Popen[bytes]":
        """Start one more worker, which first runs some code."""
        return self._start(
            "dask_worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1", before=before
        )

    def address(self, workers: int) -> str:
        """Wait for workers and return the scheduler's address."""
        from distributed import Client

        address = str(json.loads(self.file.read_text(encoding="utf-8"))["address"])
        if workers:
            with Client(address, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=90)
        return address


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    """Start a scheduler that ends with the test."""
    pytest.importorskip("distributed", reason="the extra rayfix[cluster] is not installed")
    with ExitStack() as stack:
        yield Processes(tmp_path, stack)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # Dask's own, about ports and loops
def test_a_cluster_builds_the_same_table_though_a_worker_is_killed(
    site: Path, tmp_path: Path, processes: Processes
) -> None:
    local = build_table(site, tmp_path / "local.h5", jobs=1)
    victim = processes.worker()
    processes.worker()
    address = processes.address(workers=2)
    blocks = 0

    def kill_one(stage: str, done: int, total: int) -> None:
        nonlocal blocks
        blocks += "cells" in stage
        if blocks == 3:
            victim.kill()

    remote = build_table(site, tmp_path / "remote.h5", cluster=address, progress=kill_one)
    assert victim.poll() is not None
    assert blocks > 10
    assert remote.table_id == local.table_id
    assert {s.origin for s in remote.stations} == {"built"}


@pytest.mark.filterwarnings("default")
def test_a_scheduler_that_is_not_there(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = pytest.importorskip("rayfix_offline.job.cluster", reason="the extra rayfix[cluster] is not installed")
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 1)
    with pytest.raises(BuildError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1; start one"):
        build_table(site, tmp_path / "t.h5", cluster="tcp://127.0.0.1:1")
    assert not (tmp_path / "t.h5").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_scheduler_without_workers(site: Path, tmp_path: Path, processes: Processes) -> None:
    address = processes.address(workers=0)
    with pytest.raises(BuildError, match=r"has no workers; start some with 'dask worker tcp://127"):
        build_table(site, tmp_path / "t.h5", cluster=address)


WITHOUT_RAYFIX = "import sys\nfor name in ('tables', 'offline'): sys.modules[f'rayfix_{name}'] = None"
OTHER_VERSION = "import rayfix_tables.version as version\nversion.software_version = lambda: '9.9'"


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("before", "why"),
    [
        (WITHOUT_RAYFIX, r"it has no rayfix \(.*rayfix_tables.*\); install rayfix"),
        (OTHER_VERSION, r"it has rayfix 9\.9, not"),
    ],
)
def test_workers_without_this_rayfix_are_refused(
    site: Path, tmp_path: Path, processes: Processes, before: str, why: str
) -> None:
    processes.worker(before)
    address = processes.address(workers=1)
    with pytest.raises(BuildError, match=rf"no worker with rayfix \S+ is left at tcp://\S+ \({why}") as caught:
        build_table(site, tmp_path / "t.h5", cluster=address)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_build_goes_on_with_those_that_have_it_and_ends_when_none_is_left(
    site: Path,
    tmp_path: Path,
    processes: Processes,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("rayfix_offline.job.cluster.LOOK_SECONDS", 0.2)
    monkeypatch.setattr("rayfix_offline.job.cluster_workers.LEFT_SECONDS", 1.0)
    processes.worker(WITHOUT_RAYFIX)
    only = processes.worker()
    address = processes.address(workers=2)
    blocks = 0

    def kill_the_only_one(stage: str, done: int, total: int) -> None:
        nonlocal blocks
        blocks += "cells" in stage
        if blocks == 2:
            only.kill()

    with pytest.raises(BuildError, match=r"is left at tcp://\S+ .*finished blocks are kept"):
        build_table(site, tmp_path / "t.h5", cluster=address, progress=kill_the_only_one)
    assert blocks >= 2
    assert sum("gets no work: it has no rayfix" in record.getMessage() for record in caplog.records) == 1
