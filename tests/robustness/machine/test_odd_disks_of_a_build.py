"""The command ``rayfix build`` on a full disk, and without a folder for temporary files."""

import subprocess
import sys
from pathlib import Path

import pytest

from rayfix_tables.checked import open_checked
from tests.support.running.full_disk import mounted, needs_mounts, temporary_folders
from tests.support.scenes.small_sites import write_site

LIST = 'exec 3>&1; "$@"; status=$?; find "$0" -type f -exec basename {} \\; >&3; exit $status'
"""Run a command and list the files of a folder, which ends with the command."""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Write a room with one station."""
    return write_site(tmp_path / "room", {"a": (0.4, 0.5)})


def building(site: Path, table: Path) -> list[str]:
    return [sys.executable, "-m", "rayfix", "build", str(site), "-o", str(table), "--jobs", "2", "--no-progress"]


@needs_mounts
def test_a_full_disk_is_a_line_and_keeps_what_is_finished(site: Path, tmp_path: Path):
    folder = tmp_path / "small"
    folder.mkdir()
    command = mounted(["sh", "-c", LIST, str(folder), *building(site, folder / "t.h5")], small=[(folder, "600k")])
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 2, done.stderr
    line = done.stderr.splitlines()[-1]
    assert line.startswith("rayfix: cannot save ")
    assert "No space left on device; finished blocks are kept: free some space and run the same build again" in line
    assert "Traceback" not in done.stderr
    assert not [name for name in done.stdout.splitlines() if "partial" in name or name.endswith(".h5")]


@needs_mounts
def test_a_build_needs_no_temporary_folder(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path / "missing"))
    folder = tmp_path / "own"
    folder.mkdir()
    copy = ["sh", "-c", '"$@" >&2 && cat "$0"', str(folder / "t.h5"), *building(site, folder / "t.h5")]
    command = mounted(copy, read_only=[*temporary_folders(), tmp_path], small=[(folder, "50m")])
    done = subprocess.run(command, capture_output=True, timeout=300, check=False, cwd=site.parent)
    assert done.returncode == 0, done.stderr.decode()
    (tmp_path / "copy.h5").write_bytes(done.stdout)
    assert [station.id for station in open_checked(tmp_path / "copy.h5").site.stations] == ["a"]
