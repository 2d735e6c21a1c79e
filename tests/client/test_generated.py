"""The blocking client is what the asynchronous one gives."""

import inspect
import subprocess
import sys
from pathlib import Path

import rayfix
from tests.support.checkout import ROOT

TOOL = ROOT / "tools" / "generate_client.py"
BLOCKING = ROOT / "rayfix" / "client" / "synchronous.py"


def check(target: Path) -> "subprocess.CompletedProcess[str]":
    """Compare a file with what the asynchronous client gives."""
    return subprocess.run(
        [sys.executable, str(TOOL), "--check", "--target", str(target)], capture_output=True, text=True, check=False
    )


def test_the_blocking_client_is_generated_from_the_asynchronous_one():
    done = check(BLOCKING)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_stale_client_is_noticed(tmp_path: Path):
    stale = tmp_path / "synchronous.py"
    stale.write_text(BLOCKING.read_text(encoding="utf-8").replace("def ready", "def is_ready"), encoding="utf-8")
    done = check(stale)
    assert done.returncode == 1
    assert "run 'make client'" in done.stderr


def test_both_clients_have_the_same_methods_with_the_same_arguments():
    def arguments(kind: type) -> dict[str, list[str]]:
        return {
            name: list(inspect.signature(member).parameters)
            for name, member in inspect.getmembers(kind, inspect.isfunction)
            if not name.startswith("__a")
        }

    blocking = arguments(rayfix.Client)
    del blocking["__enter__"], blocking["__exit__"]
    assert blocking == arguments(rayfix.AsyncClient)
    assert {"locate", "locate_batch", "stream", "fixes", "close"} <= set(blocking)
