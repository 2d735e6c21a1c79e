"""Every benchmark finds what it imports: none of them runs with the tests, and a module that has moved breaks it."""

import ast
import importlib.util
from pathlib import Path

import pytest

import benchmarks

_FOLDER = Path(benchmarks.__file__).parent
_OWN = ("benchmarks", "rayfix", "tests")


@pytest.mark.parametrize("path", sorted(_FOLDER.rglob("*.py")), ids=lambda path: str(path.relative_to(_FOLDER)))
def test_imports_of_rayfix_are_there(path: Path):
    missing = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(_OWN):
            module = importlib.import_module(node.module) if importlib.util.find_spec(node.module) else None
            missing += [
                f"{node.module}.{alias.name}"
                for alias in node.names
                if not hasattr(module, alias.name) and not importlib.util.find_spec(f"{node.module}.{alias.name}")
            ]
    assert missing == []
