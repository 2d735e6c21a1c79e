"""The pages of the site file and of the command line are what the code gives."""

import subprocess
import sys
from pathlib import Path

from tests.support.checkout import ROOT

TOOL = ROOT / "tools" / "generate_reference.py"


def run(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, TOOL, *arguments], capture_output=True, text=True)


def test_the_pages_are_current() -> None:
    done = run("--check")
    assert done.returncode == 0, done.stderr


def test_a_stale_page_is_found(tmp_path: Path) -> None:
    assert run("--folder", tmp_path).returncode == 0
    page = tmp_path / "site-file.md"
    text = page.read_text(encoding="utf-8")
    for key in ("boresight_azimuth_deg", "windows_deg", "range_stdev_m"):
        assert f"| `{key}` |" in text
    page.write_text(text.replace("`60`", "`61`"), encoding="utf-8")
    done = run("--check", "--folder", tmp_path)
    assert done.returncode == 1
    assert "make reference" in done.stderr
    commands = (tmp_path / "command-line.md").read_text(encoding="utf-8")
    assert "| `--root-path PATH` |" in commands
    assert "||" not in commands.replace(" ", "").replace("\\|", "")
