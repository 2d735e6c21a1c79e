"""docs/tutorial.ipynb runs from its first cell to its last, and comes to what it shows."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.checkout import ROOT

NOTEBOOK = ROOT / "docs" / "tutorial.ipynb"

RUN = """
import sys
import nbformat
from nbclient import NotebookClient

notebook = nbformat.read(sys.argv[1], 4)
NotebookClient(notebook, timeout=900, resources={"metadata": {"path": "."}}).execute()
nbformat.write(notebook, "run.ipynb")
"""


def printed(notebook: dict[str, Any]) -> str:
    """Return what the cells print."""
    outputs = [one for cell in notebook["cells"] for one in cell.get("outputs", ())]
    return "".join("".join(one.get("text", "")) for one in outputs)


def means(notebook: dict[str, Any]) -> dict[str, float]:
    """Return the mean errors before and after calibration, m."""
    return {name: float(value) for name, value in re.findall(r"^(\w+): \{'mean': ([\d.]+)", printed(notebook), re.M)}


@pytest.mark.slow
def test_the_notebook_runs_and_comes_to_what_it_shows(tmp_path: Path) -> None:
    pytest.importorskip("nbclient", reason="nbclient and ipykernel are not installed")
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    command = [sys.executable, "-c", RUN, str(NOTEBOOK)]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=1200, check=False
    )
    assert done.returncode == 0, done.stderr[-4000:]
    shown = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    run = json.loads((tmp_path / "run.ipynb").read_text(encoding="utf-8"))
    assert "rayfix:" not in printed(run)  # no command has refused anything
    assert set(means(run)) == {"before", "after"}
    assert means(run) == pytest.approx(means(shown), abs=0.03)
    assert means(run)["after"] < 0.6 * means(run)["before"]
