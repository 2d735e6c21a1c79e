"""The page on the architecture names folders that are there, and folders and modules stay small."""

import re

import pytest

from tests.support.checkout import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
SOURCES = ("benchmarks", "evaluation", "offline", "rayfix", "service", "tables", "tests", "tools")
FOLDERS = sorted({path.parent for source in SOURCES for path in (ROOT / source).rglob("*.py")})


def test_each_question_has_a_folder_that_is_there() -> None:
    section = PAGE.split("## Where do I change ...?")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| a") and "---" not in line]
    assert len(rows) == 10
    for row in rows:
        folders = re.findall(r"`([a-z_]+/[a-z_/]+/)`", row)
        assert folders, row
        assert all((ROOT / folder).is_dir() for folder in folders), row


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(ROOT)))
def test_folders_and_modules_are_small(folder) -> None:
    modules = [path for path in folder.glob("*.py") if path.name != "__init__.py"]
    assert len(modules) <= 15
    for module in modules:
        assert len(module.read_text(encoding="utf-8").splitlines()) <= 500, module
