"""What test modules share is in ``tests.support``: none imports another, and nothing there imports a test."""

import ast
from pathlib import Path

from tests.support.checkout import ROOT

TESTS = ROOT / "tests"


def imported_by(path: Path) -> set[str]:
    """Names of the modules that a module imports."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return names | {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}


def test_no_module_imports_a_test():
    paths = list(TESTS.rglob("*.py"))
    tests = {path.stem for path in paths if path.parent not in (TESTS, TESTS / "support")} | {"conftest"}
    for path in paths:
        for name in imported_by(path):
            assert name not in tests, (path, name)
            assert not name.startswith("tests.") or f"{name}.".startswith("tests.support."), (path, name)
