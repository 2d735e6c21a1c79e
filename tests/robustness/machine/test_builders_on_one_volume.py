"""Builders that share a folder and not their process numbers, as containers on one volume do."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rayfix_offline.job.shards import ShardStore
from rayfix_tables.mixture import TubeMixture
from rayfix_tables.table import Table
from tests.support.tables.random_tables import Content, random_content

MEANWHILE: list[Callable[[], Any]] = []
"""What another builder does while a table is being written."""


class SlowMixture(TubeMixture):
    """A mixture during whose writing another builder is at work."""

    def as_stored(self) -> TubeMixture:
        """Let the other builder work."""
        MEANWHILE.pop()()
        return super().as_stored()


def slow(content: Content) -> Content:
    """Replace the last level's mixture by a slow one, so that most is written already."""
    last = content.parts[-1]
    level = last.levels[-1]
    levels = (*last.levels[:-1], replace(level, mixture=SlowMixture(**vars(level.mixture))))
    return replace(content, parts=(*content.parts[:-1], replace(last, levels=levels)))


@pytest.fixture(autouse=True)
def first_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each builder be the first process of its container."""
    monkeypatch.setattr(os, "getpid", lambda: 1)


def test_two_builders_write_one_table(tmp_path: Path) -> None:
    """Under the final name there is a whole table at any time, and neither takes the other's file away."""
    path = tmp_path / "t.h5"
    seen = []

    def other() -> None:
        other_id = random_content(2).write(path)
        table = Table.open(path)
        table.verify()
        seen.append((other_id, table.table_id))

    MEANWHILE.append(other)
    own_id = slow(random_content(1)).write(path)
    assert len(seen) == 1
    assert seen[0][0] == seen[0][1] != own_id
    table = Table.open(path)
    table.verify()
    assert table.table_id == own_id
    assert [entry.name for entry in tmp_path.iterdir()] == ["t.h5"]


ARRAYS = {"x": np.arange(3.0)}


def test_a_builder_that_is_done_leaves_the_shards_of_another(tmp_path: Path) -> None:
    one, other = ShardStore.beside(tmp_path / "t.h5"), ShardStore.beside(tmp_path / "t.h5")
    one.save("a-0", ARRAYS)
    other.save("b-0", ARRAYS)
    one.remove()
    assert other.load("b-0") is not None
    other.save("b-1", ARRAYS)
    other.remove()
    assert list(tmp_path.iterdir()) == []
    one.save("a-0", ARRAYS)  # as a build that begins anew
    one.close()
    assert other.load("a-0") is not None
    other.remove()
    assert list(tmp_path.iterdir()) == []


def test_shards_of_a_builder_that_was_killed_are_removed_by_the_one_that_is_done(tmp_path: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path; import numpy as np\n"
        "from rayfix_offline.job.shards import ShardStore\n"
        "ShardStore.beside(Path(sys.argv[1])).save('a-0', {'x': np.arange(3.0)})\n"
        "os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path / "t.h5")], check=False).returncode == -9
    store = ShardStore.beside(tmp_path / "t.h5")
    assert store.load("a-0") is not None
    store.save("a-1", ARRAYS)
    store.remove()
    assert list(tmp_path.iterdir()) == []


def test_shards_that_are_being_saved_have_names_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, other = (ShardStore.beside(tmp_path / "t.h5") for _ in range(2))
    other.save("b-0", ARRAYS)
    seen: list[set[str]] = []
    fsync = os.fsync

    def meanwhile(descriptor: int) -> None:
        fsync(descriptor)
        seen.append({path.name for path in store.folder.glob("a-0.partial-*")})
        if len(seen) == 1:
            other.save("a-0", ARRAYS)

    monkeypatch.setattr(os, "fsync", meanwhile)
    store.save("a-0", ARRAYS)
    assert [len(names) for names in seen] == [1, 2]
    assert {path.name for path in store.folder.iterdir()} == {"a-0", "b-0"}
    store.close()
    other.remove()
