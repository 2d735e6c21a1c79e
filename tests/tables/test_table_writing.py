"""Writing that fails leaves nothing behind, and what was there before stays."""

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rayfix_tables.disk.ownership import own_file
from rayfix_tables.errors import TableError
from rayfix_tables.mixture import TubeMixture
from rayfix_tables.table import Table
from rayfix_tables.write import check_writable

LIMITED = """
import pickle, resource, sys
from pathlib import Path
from rayfix_tables.errors import TableError
from rayfix_tables.write import write_table

path, limit = Path(sys.argv[1]), int(sys.argv[2])
content = pickle.loads(Path(sys.argv[3]).read_bytes())
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    write_table(path, software_version="1", **content)
except TableError as error:
    print(error)
    sys.exit(3)
"""
"""Write a table where no file may grow beyond a limit, as on a full disk (Python ignores SIGXFSZ)."""


class InterruptedMixture(TubeMixture):
    """A mixture at which the user presses Ctrl-C."""

    def as_stored(self) -> TubeMixture:
        """Be interrupted."""
        raise KeyboardInterrupt


def interrupted(content: Any) -> Any:
    """Replace the last level's mixture by one that is interrupted, so that most is written already."""
    last = content.parts[-1]
    level = last.levels[-1]
    mixture = InterruptedMixture(**vars(level.mixture))
    levels = (*last.levels[:-1], replace(level, mixture=mixture))
    return replace(content, parts=(*content.parts[:-1], replace(last, levels=levels)))


@contextmanager
def nothing_changes(folder: Path) -> Iterator[None]:
    """Check that names and contents in a folder are the same afterwards."""
    before = {entry.name: entry.read_bytes() for entry in folder.iterdir()}
    yield
    assert {entry.name: entry.read_bytes() for entry in folder.iterdir()} == before


@pytest.fixture(params=[False, True], ids=["first table", "former table"])
def folder(request: pytest.FixtureRequest, tmp_path: Path, make_content: Callable[..., Any]) -> Path:
    """Give a folder without or with a former table ``t.h5``."""
    folder = tmp_path / "tables"
    folder.mkdir()
    if request.param:
        make_content(1).write(folder / "t.h5")
    return folder


def test_an_interrupt_while_writing(folder: Path, make_content: Callable[..., Any]) -> None:
    with nothing_changes(folder), pytest.raises(KeyboardInterrupt):
        interrupted(make_content(2)).write(folder / "t.h5")
    # The same process can write that table right away.
    table_id = make_content(2).write(folder / "t.h5")
    assert Table.open(folder / "t.h5").table_id == table_id


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.7, 0.999])
def test_a_full_disk(folder: Path, make_content: Callable[..., Any], tmp_path: Path, share: float) -> None:
    content = make_content(2, num_faces=2000)
    content.write(tmp_path / "whole.h5")
    limit = int(share * (tmp_path / "whole.h5").stat().st_size)
    pickled = tmp_path / "content.pickle"
    pickled.write_bytes(pickle.dumps(vars(content)))
    command = [sys.executable, "-c", LIMITED, str(folder / "t.h5"), str(limit), str(pickled)]
    with nothing_changes(folder):
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (3, "")
    assert done.stdout.startswith(f"cannot write {folder / 't.h5'}: ")
    assert done.stdout.endswith("free some space or choose another folder\n")
    assert done.stdout.count("\n") == 1


def test_a_table_in_use_is_replaced_and_stays_readable(make_content: Callable[..., Any], tmp_path: Path) -> None:
    """A service that has mapped the old table goes on with it."""
    path = tmp_path / "t.h5"
    old_id, old = make_content(1).write(path), Table.open(path)
    before = old.levels("bs0")[0].mixture.x_mean.copy()
    new_id = make_content(2).write(path)
    assert (old.levels("bs0")[0].mixture.x_mean == before).all()
    assert Table.open(path).table_id == new_id != old_id == old.table_id


def test_a_folder_that_is_gone(make_content: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for parent in (tmp_path / "none", tmp_path / "file"):
        with pytest.raises(TableError, match="cannot write") as caught:
            make_content(1).write(parent / "t.h5")
        assert str(parent / "t.h5") in str(caught.value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_what_can_be_known_before_the_work(tmp_path: Path) -> None:
    check_writable(tmp_path / "t.h5")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(TableError, match=r"it is a folder; give a file name such as .*table\.h5"):
        check_writable(tmp_path)
    with pytest.raises(TableError, match=r"there is no folder .*none; create it first"):
        check_writable(tmp_path / "none" / "t.h5")
    (tmp_path / "file").touch()
    with pytest.raises(TableError, match=r"there is no folder .*file; create it first"):
        check_writable(tmp_path / "file" / "t.h5")


def test_only_a_table_gives_way_to_a_table(make_content: Callable[..., Any], tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text("[site]", encoding="utf-8")
    with pytest.raises(TableError, match=r"site\.toml: the file there is not a table; give another name"):
        check_writable(path)
    path.write_bytes(b"")
    check_writable(path)
    make_content(1).write(path)
    check_writable(path)


READ_ONLY = """
import os, sys
from pathlib import Path
from rayfix_tables.errors import TableError
from rayfix_tables.table import Table
from rayfix_tables.write import check_writable

if os.getuid() == 0:
    os.setuid(65534)
for action, path in ((check_writable, sys.argv[1]), (Table.open, sys.argv[1]), (Table.open, sys.argv[2])):
    try:
        action(Path(path))
    except TableError as error:
        print(error)
"""


def test_rights_that_are_missing(tmp_path_factory: pytest.TempPathFactory, make_content: Callable[..., Any]) -> None:
    """A folder that may not be written and a table that may not be read; for root, which may all, as another user."""
    folder = tmp_path_factory.mktemp("readonly")
    path = folder / "t.h5"
    make_content(1).write(path)
    path.chmod(0)
    closed = folder / "closed" / "t.h5"
    closed.parent.mkdir(mode=0)
    parents = [p for p in (folder, *folder.parents) if p.owner() == folder.owner() and not p.stat().st_mode & 0o001]
    modes = {parent: parent.stat().st_mode for parent in parents}
    if os.getuid() == 0:
        for parent in parents:
            parent.chmod(0o755)
    folder.chmod(0o555)
    try:
        done = subprocess.run(
            [sys.executable, "-c", READ_ONLY, str(path), str(closed)],
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
    finally:
        folder.chmod(0o755)
        closed.parent.chmod(0o755)
        for parent, mode in modes.items():
            parent.chmod(mode)
    assert done.stdout.splitlines() == [
        f"cannot write {path}: the folder {folder} is read-only; choose another",
        f"{path} cannot be read; ask its owner for the right to read it",
        f"{closed} cannot be read; ask its owner for the right to read it",
    ]


def test_what_a_killed_process_left_is_removed(make_content: Callable[..., Any], tmp_path: Path) -> None:
    abandoned, descriptor = own_file(tmp_path, ".t.h5.partial-")
    os.close(descriptor)
    # Another process is still at work, another table is none of ours, and who knows what the last is.
    at_work, descriptor = own_file(tmp_path, ".t.h5.partial-")
    others = {at_work.name, abandoned.name.replace("t.h5", "other.h5"), ".t.h5.partial-new", ".t.h5.partial-1"}
    for name in others:
        (tmp_path / name).touch()
    try:
        make_content(1).write(tmp_path / "t.h5")
    finally:
        os.close(descriptor)
    assert {entry.name for entry in tmp_path.iterdir()} == {"t.h5", *others}
