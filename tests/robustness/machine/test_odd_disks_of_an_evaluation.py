"""Reports of evaluations on full disks, and two evaluations that write into one folder."""

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rayfix_evaluation.report.style import new_figure, write_figure
from rayfix_evaluation.studies.store import Store, write_json, write_text
from rayfix_tables.errors import RayfixError

SETTINGS = {"seed": 1}


@contextmanager
def no_room(size: int = 1000) -> Iterator[None]:
    """Let no file grow beyond a size, as on a full disk; Python ignores the signal."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_full_disk_loses_no_result(tmp_path: Path):
    store = Store(folder=tmp_path)
    store.put(SETTINGS, [1.0])
    before = contents(tmp_path)
    for settings in (SETTINGS, {"seed": 2}):
        with no_room(), pytest.raises(RayfixError, match=r"cannot write .*; nothing finished is lost: free some space"):
            store.put(settings, list(range(1000)))
        assert contents(tmp_path) == before
    assert store.get(SETTINGS) == [1.0]


def test_a_full_disk_leaves_the_former_figures(tmp_path: Path):
    figure = new_figure(3.0, 2.0)
    write_figure(figure, tmp_path / "errors")
    before = contents(tmp_path)
    assert before.keys() == {"errors.svg", "errors.png"}
    figure.subplots().plot([0.0, 1.0], [0.0, 1.0])
    with no_room(), pytest.raises(RayfixError, match=r"cannot write .*errors\.svg: .*: free some space"):
        write_figure(figure, tmp_path / "errors")
    assert contents(tmp_path) == before


def test_a_folder_that_is_a_file(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(RayfixError, match=r"cannot write .*; choose another folder with -o"):
        write_json(tmp_path / "file" / "results.json", {})


def test_two_evaluations_write_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Both are the first process of their containers; one writes while the other renames."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    replace, waiting = Path.replace, [True]

    def meanwhile(self: Path, target: Path) -> Path:
        if waiting:
            waiting.clear()
            write_text(target, "the other's")
            assert target.read_text() == "the other's"
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", meanwhile)
    write_text(tmp_path / "results.json", "own")
    assert contents(tmp_path) == {"results.json": b"own"}
