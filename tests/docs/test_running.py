"""The documentation's commands and Python blocks run as they stand, on a small table of the bundled hall.

Blocks of a page run in turn in one folder, which holds what the pages name; Python blocks share their names. What asks
``localhost:8000`` asks a service of the test's own, and planning maps have coarse squares.
"""

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rayfix.cli import main
from rayfix.example.files import example_report
from tests.support.checkout import ROOT
from tests.support.doc_blocks import PAGES, Block, blocks_of, commands_of
from tests.support.running.server_process import ServerProcess, start_rayfix_serve

RUNNABLE = {page: [block for block in blocks_of(page) if block.reason is None] for page in PAGES}
SERVED = [
    pytest.param(block, command, id=f"{block}-{command}")
    for blocks in RUNNABLE.values()
    for block in blocks
    if block.language == "sh"
    for command in commands_of(block.text)
    if command.startswith("rayfix serve ")
]
SLOW = {"README.md", "planning.md", "start-research.md", "tutorial.md", "arrays.md", "start-5g.md", "start-ble-uwb.md"}
"""Pages whose blocks take more than a few seconds."""

VIEWER = ROOT / "service/rayfix_service/web/static/index.html"
SHELL = set("|&;<>$`")
TABLES = ("site.h5", "hall.h5", "T.h5", "tables/hall.h5", "demo/hall.h5")


def pages() -> list[object]:
    """Pages with a block to run, for parametrize."""
    return [
        pytest.param(page, id=page.name, marks=[pytest.mark.slow] if page.name in SLOW else [])
        for page, blocks in RUNNABLE.items()
        if any(block.language in {"sh", "python"} for block in blocks)
    ]


@pytest.fixture(scope="module")
def service_url(hall_table_path: Path) -> Iterator[str]:
    """Address of a service of the hall in a process of its own."""
    with start_rayfix_serve(hall_table_path) as server:
        yield server.url


@pytest.fixture
def folder(tmp_path: Path, hall_table_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, which holds the files that the pages name."""
    site = hall_table_path.parent
    for name in ("site.toml", "SITE.toml"):
        shutil.copy(site / "site.toml", tmp_path / name)
    shutil.copy(site / "hall.glb", tmp_path)
    for name in TABLES:
        lay_table(hall_table_path, tmp_path / name)
    (tmp_path / "report.json").write_text(example_report(), encoding="utf-8")
    for block in blocks_of(next(page for page in PAGES if page.name == "formats.md")):
        if name := block.words.get("input"):
            (tmp_path / {"ublox": "lines.txt"}.get(name, f"{name}.json")).write_text(block.text, encoding="utf-8")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/rayfix").write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m rayfix "$@"\n')
    (tmp_path / "bin/rayfix").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def lay_table(table: Path, target: Path) -> None:
    """Link a table into a folder; builds replace tables and never write into them."""
    target.parent.mkdir(exist_ok=True)
    target.hardlink_to(table)


def run_command(command: str, url: str, hall: Path) -> None:
    """Run one line of a shell block, which must succeed."""
    words = shlex.split(command)
    if command.startswith("rayfix serve "):
        return  # test_a_service_starts
    if command.startswith("rayfix view ") and not VIEWER.is_file():
        return  # as without Node.js
    if words[0] == "rayfix" and not SHELL & set(command):
        coarse = ["--spacing-m", "2", "--draws", "1"] if words[1] == "plan" else []
        assert main([*words[1:], *coarse]) == 0, command
        if words[1] == "example":  # the small table's windows, so that the example's build has nothing left to do
            shutil.copy(hall.parent / "site.toml", Path(words[2]) / "site.toml")
            lay_table(hall, Path(words[2]) / "hall.h5")
        return
    if words[0] == "curl" and shutil.which("curl") is None:
        return
    script = command.replace("localhost:8000", url.removeprefix("http://")).replace("curl -s ", "curl -sS --fail ")
    subprocess.run(["bash", "-euo", "pipefail", "-c", script], check=True, timeout=300)


def run_block(block: Block, names: dict[str, object], url: str, hall: Path) -> None:
    """Run a block, or write the file that it is."""
    if path := block.words.get("file"):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(block.text, encoding="utf-8")
    elif block.language == "sh":
        for command in commands_of(block.text):
            run_command(command, url, hall)
    elif block.language == "python":
        exec(compile(block.text.replace("http://localhost:8000", url), str(block), "exec"), names)


@pytest.mark.parametrize("page", pages())
def test_the_blocks_of_a_page_run(page: Path, folder: Path, service_url: str, hall_table_path: Path):
    report = json.loads(example_report())
    # What the text around a block names: a report, many, and the taps of an impulse response of one path.
    taps = np.sinc(np.arange(64) - 20.3) + 0j
    names: dict[str, object] = {"report": report, "reports": [report, report], "taps": taps}
    for block in RUNNABLE[page]:
        try:
            run_block(block, names, service_url, hall_table_path)
        except (Exception, SystemExit) as error:
            raise AssertionError(f"{block}: {error!r}") from error


@pytest.mark.slow
@pytest.mark.parametrize(("block", "command"), SERVED)
def test_a_service_starts(block: Block, command: str, folder: Path, hall_table_path: Path):
    """With the keys that its block makes before; on the loopback address, where one without keys is not refused."""
    for before in commands_of(block.text):
        if before.startswith("rayfix api-key "):
            assert main(shlex.split(before)[1:]) == 0
    words = shlex.split(command)[1:]
    if not Path(words[1]).exists():  # built by earlier blocks of the page
        lay_table(hall_table_path, Path(words[1]))
    if "--api-keys" in words:
        (folder / "keys").exists() or main(["api-key", "reader", "-o", "keys"])
        words = ["127.0.0.1" if word == "0.0.0.0" else word for word in words]
    workers = int(words[words.index("--workers") + 1]) if "--workers" in words else 1
    with ServerProcess("-m", "rayfix", *words, "--port", "0", workers=workers) as server, server.client() as client:
        assert client.get("/readyz").status_code == 200
