"""Progress on standard error, and what the demo shows while its service starts."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.progress import Progress

from rayfix import demo, own_command, progress
from rayfix_tables.errors import RayfixError


def test_without_a_terminal_a_silent_stage_is_named_from_time_to_time(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "_LINE_SECONDS", 0.05)
    with progress.build_progress(enabled=True) as show:
        assert show is not None
        show("reading the scene", 0, 0)
        time.sleep(0.3)
        show("balancing", 1, 4)
        time.sleep(0.3)
    lines = capsys.readouterr().err.splitlines()
    assert any(line.startswith("reading the scene, 0:0") for line in lines)
    assert any(line.startswith("balancing 25%, 0:0") for line in lines)


def test_the_clock_of_a_stage_that_is_done_goes_on_until_the_end() -> None:
    bar = Progress()
    task = bar.add_task("writing", total=10, completed=10, begin=time.monotonic() - 3675.0, ended=None)
    bar.update(task, completed=10)
    assert bar.tasks[task].finished
    column = progress._TimesColumn()
    assert column.render(bar.tasks[task]).plain == "61:15"
    bar.update(task, ended=bar.tasks[task].fields["begin"] + 65.0)
    assert column.render(bar.tasks[task]).plain == "1:05"


def waited(folder: Path, script: str) -> None:
    """Wait for a service that is this script, at an address where nothing answers."""
    log = folder / "service.log"
    with log.open("wb") as sink:
        process = subprocess.Popen([sys.executable, "-c", script], stdout=sink, stderr=subprocess.STDOUT)
    try:
        demo._wait_until_ready("http://127.0.0.1:9", process, log)
    finally:
        process.kill()
        process.wait()


def test_the_demo_waits_for_a_service_that_works_and_shows_its_kernels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "_IDLE_SECONDS", 2.0)
    busy = (
        "import time\nprint('2026-11-30T20:08:31.979Z WARNING:  compiling kernels, once', flush=True)\n"
        "end = time.monotonic() + 5.0\n"
        "while time.monotonic() < end: pass\nprint('no table')\nraise SystemExit(2)"
    )
    with pytest.raises(RayfixError, match=r"ended with status 2; see its log \S+service.log: no table"):
        waited(tmp_path, busy)
    assert capsys.readouterr().out == "   compiling kernels, once\n"


def test_the_demo_does_not_wait_for_a_service_that_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "_IDLE_SECONDS", 0.5)
    with pytest.raises(RayfixError, match="has done nothing for"):
        waited(tmp_path, "import time\ntime.sleep(600)")


def test_hints_name_a_command_that_exists(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / ".venv" / "bin" / "rayfix"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n", encoding="ascii")
    program.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(program)])
    monkeypatch.setenv("PATH", "/nowhere")
    assert own_command.own_command() == ".venv/bin/rayfix"
    monkeypatch.setenv("PATH", str(program.parent))
    assert own_command.own_command() == "rayfix"
    monkeypatch.setattr(sys, "argv", [str(Path(own_command.__file__).with_name("__main__.py"))])
    assert own_command.own_command() == f"{sys.executable} -m rayfix"
