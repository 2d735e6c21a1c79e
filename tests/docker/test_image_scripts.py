"""Programs that only the images have, run as they are."""

import functools
import hashlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from compile_service_kernels import ROOM, write_room
from rayfix_tables.table import Table
from tests.support.checkout import ROOT

IMAGE = ROOT / "docker/image"


class Quiet(SimpleHTTPRequestHandler):
    """A file server that logs nothing."""

    def log_message(self, *arguments: object) -> None:
        """Do nothing."""


@pytest.fixture(scope="module")
def room_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Table of the empty room that kernels are compiled with."""
    path = tmp_path_factory.mktemp("store") / "room.h5"
    write_room(path)
    return path


@pytest.fixture(scope="module")
def store(room_path: Path) -> Iterator[str]:
    """Address of an object store that holds the room's table and something else."""
    (room_path.parent / "other.h5").write_bytes(b"no table")
    handler = functools.partial(Quiet, directory=str(room_path.parent))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def run(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(IMAGE / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_a_table_is_fetched_by_its_hash(store: str, room_path: Path, tmp_path: Path):
    table_id = Table.open(room_path).table_id
    target = tmp_path / "site.h5"
    done = run("fetch_table.py", f"{store}/room.h5?signature=secret", table_id, target)
    assert done.returncode == 0, done.stderr
    assert target.read_bytes() == room_path.read_bytes()
    # Once it is there, nobody is asked.
    assert run("fetch_table.py", "http://127.0.0.1:9/", table_id, target).returncode == 0
    # What is damaged is fetched again.
    target.write_bytes(target.read_bytes()[:-1000])
    assert run("fetch_table.py", f"{store}/room.h5", table_id, target).returncode == 0
    assert target.read_bytes() == room_path.read_bytes()


@pytest.mark.parametrize(
    ("name", "table_id", "word"),
    [("room.h5", "0" * 64, "is not table"), ("other.h5", None, "is not table"), ("none.h5", None, "404")],
)
def test_nothing_else_is_taken(store: str, room_path: Path, tmp_path: Path, name: str, table_id: str | None, word: str):
    table_id = table_id or Table.open(room_path).table_id
    done = run("fetch_table.py", f"{store}/{name}?signature=secret", table_id, tmp_path / "site.h5")
    assert done.returncode == 1
    assert word in done.stderr
    assert "secret" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_files_of_a_site_are_fetched_by_their_hashes(store: str, room_path: Path, tmp_path: Path):
    names = ("room.h5", "other.h5")
    files = [
        (name, f"{store}/{name}?signature=secret", hashlib.sha256(room_path.with_name(name).read_bytes()).hexdigest())
        for name in names
    ]
    done = run("fetch_files.py", tmp_path, *files[0], *files[1])
    assert done.returncode == 0, done.stderr
    for name in names:
        assert (tmp_path / name).read_bytes() == room_path.with_name(name).read_bytes()
    assert run("fetch_files.py", tmp_path, "room.h5", "http://127.0.0.1:9/", files[0][2]).returncode == 0


@pytest.mark.parametrize(("name", "word"), [("room.h5", "not 0000"), ("none.h5", "404")])
def test_a_file_with_another_hash_is_not_taken(store: str, tmp_path: Path, name: str, word: str):
    done = run("fetch_files.py", tmp_path, name, f"{store}/{name}?signature=secret", "0" * 64)
    assert done.returncode == 1
    assert word in done.stderr
    assert "secret" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_waiting_ends_when_the_table_is_there(room_path: Path):
    done = run("wait_for_table.py", room_path)
    assert done.returncode == 0
    assert done.stdout.endswith("is there\n")


def test_a_service_that_is_not_ready_is_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RAYFIX_PORT", "9")
    done = run("ready.py")
    assert done.returncode == 1
    assert "/readyz" in done.stderr


def test_the_rooms_tubes_are_those_of_straight_paths(tmp_path: Path):
    """Before they are rounded to what a table holds."""
    write_room(tmp_path / "room.h5", compact=False)
    table = Table.open(tmp_path / "room.h5")
    station = table.site.stations[0]
    for level in table.levels(station.id):
        mixture = level.mixture
        # The mean lies at the path length's distance, and its derivative by the length is the unit vector there.
        offset = mixture.x_mean - station.position
        length = mixture.u_mean[:, :1]
        assert offset == pytest.approx(length * mixture.jacobian[:, :, 0], abs=1e-5)
        assert (offset**2).sum(axis=1) == pytest.approx(length[:, 0] ** 2, rel=1e-5)
        # Derivatives by the angles are as long as the path, and at right angles to it and to each other.
        gram = mixture.jacobian.transpose(0, 2, 1) @ mixture.jacobian
        lengths = length[:, 0] ** 2
        for axis in (1, 2):
            assert gram[:, axis, axis] == pytest.approx(lengths, rel=1e-4)
            assert gram[:, 0, axis] == pytest.approx(0 * lengths, abs=1e-5)
        assert gram[:, 1, 2] == pytest.approx(0 * lengths, abs=1e-4)
    assert table.scene.free_space.volume == pytest.approx(ROOM.prod())


def test_the_room_is_a_table_of_the_present_format(room_path: Path, tmp_path: Path):
    """Its components are those of straight paths to half precision."""
    write_room(tmp_path / "whole.h5", compact=False)
    table, whole = Table.open(room_path), Table.open(tmp_path / "whole.h5")
    assert (table.format_version, whole.format_version) == (5, 4)
    for name, part in table.parts.items():
        for level, exact in zip(part.levels, whole.parts[name].levels, strict=True):
            assert level.is_compact
            most = float(exact.mixture.u_mean[:, 0].max())
            np.testing.assert_allclose(level.mixture[:].jacobian, exact.mixture.jacobian, atol=2.0**-11 * most)
            np.testing.assert_allclose(level.mixture[:].u_mean, exact.mixture.u_mean, rtol=2.0**-11, atol=1e-7)
