"""The version stands in pyproject.toml; wherever else it must stand, it is the same."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]


@pytest.mark.parametrize(
    ("file", "pattern"),
    [
        ("docker/helm/rayfix/Chart.yaml", r"^version: (\S+)$"),
        ("docker/helm/rayfix/Chart.yaml", r"^appVersion: (\S+)$"),
        ("docker/Dockerfile", r"\bVERSION=(\S+)"),
        ("docs/dask-operator.md", r"image: rayfix-\w+:(\S+)"),
        ("CITATION.cff", r"^version: (\S+)$"),
    ],
)
def test_the_version_is_that_of_the_project(file: str, pattern: str):
    found = re.findall(pattern, (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE)
    assert found
    assert set(found) == {VERSION}


def test_the_changelog_begins_with_the_version():
    headings = re.findall(r"^## (\S+), (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0][0] == VERSION


def test_ci_runs_every_python_that_the_package_supports():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    supported = [c.rpartition(" ")[2] for c in project["classifiers"] if re.search(r"Python :: 3\.\d", c)]
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))["jobs"].values()
    (job,) = (job for job in jobs if any(step.get("run") == ".ci/run" for step in job["steps"]))
    assert job["strategy"]["matrix"]["python"] == supported


def test_tools_of_development_are_a_group_and_no_extra():
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "dev" not in document["project"]["optional-dependencies"]
    assert {"pytest", "ruff", "mypy"} <= {
        re.match(r"[\w.-]+", text)[0] for text in document["dependency-groups"]["dev"]
    }
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert "--group dev" in makefile
    assert re.search(r"pip install .*'pip>=25\.1'", makefile)  # the first one that knows --group
