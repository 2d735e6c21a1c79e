"""What may be imported from where: the service runs without the offline job's libraries."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

BLOCKER = """
import importlib.abc, sys

class Blocker(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {blocked!r}:
            raise ModuleNotFoundError(f"{{name}} is blocked", name=name)

sys.meta_path.insert(0, Blocker())
"""

WALK = """
import importlib, pkgutil
for root in {roots!r}:
    package = importlib.import_module(root)
    names = [m.name for m in pkgutil.walk_packages(package.__path__, root + ".")]
    compiled = ("cholesky", "compilation", "conditioning", "expanding", "kernel_lock", "tree_reduction", "triangles")
    names = [name for name in names if name.rpartition(".")[2] not in ("__main__", *compiled)]
    for name in names:
        importlib.import_module(name)
    assert len(names) >= 5, names
print("imported")
"""

LOCATE = """
import sys
from rayfix_service.locator import Locator
from rayfix_tables.table import Table
Locator(Table.open(sys.argv[1])).warm_up()
print("located")
"""

OFFLINE_LIBRARIES = {"trimesh", "sklearn", "embreex", "scipy", "matplotlib", "networkx", "collada"}


def run(code: str, blocked: set[str], *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh interpreter that cannot import some packages."""
    return subprocess.run(
        [sys.executable, "-c", BLOCKER.format(blocked=blocked) + code, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=1200,  # compiling all kernels takes minutes on a busy machine
        check=False,
    )


@pytest.mark.parametrize(
    ("roots", "blocked"),
    [
        (["rayfix_service"], OFFLINE_LIBRARIES | {"rayfix_offline", "rayfix"}),
        (
            ["rayfix_service.fusion", "rayfix_service.tracking"],
            OFFLINE_LIBRARIES | {"joblib", "rayfix_offline", "rayfix", "fastapi", "pydantic", "uvicorn"},
        ),
        (
            ["rayfix_tables"],
            OFFLINE_LIBRARIES | {"joblib", "rayfix_offline", "rayfix_service", "rayfix", "numba", "pydantic"},
        ),
    ],
)
def test_a_package_does_without(roots: list[str], blocked: set[str]) -> None:
    result = run(WALK.format(roots=roots), blocked)
    assert result.stdout == "imported\n", result.stderr


def test_the_blocker_blocks() -> None:
    result = run(WALK.format(roots=["rayfix_offline"]), {"trimesh"})
    assert result.returncode != 0
    assert "trimesh is blocked" in result.stderr


@pytest.mark.slow
def test_the_kernels_compile_without_scipy(hall_table_path: Path, tmp_path: Path) -> None:
    """In compiled code a mere ``@`` wants SciPy, and only an empty cache shows it."""
    result = run(LOCATE, OFFLINE_LIBRARIES, str(hall_table_path), NUMBA_CACHE_DIR=str(tmp_path))
    assert result.stdout == "located\n", result.stderr
