"""docker/requirements.lock: complete, pinned as constraints.txt pins, and by hashes alone."""

import re
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from requirements import build_requirements, locked, requirements

ROOT = Path(__file__).resolve().parents[2]
LOCK = ROOT / "docker/requirements.lock"
PYPROJECT = ROOT / "pyproject.toml"
EXTRAS = ("cluster", "ifc", "mqtt", "offline", "service")


def pins(text: str) -> dict[str, str]:
    found = re.findall(r"^([\w.-]+)==([^\s\\]+)", text, re.MULTILINE)
    return {canonicalize_name(name): version for name, version in found}


def closure(wanted: list[str]) -> set[str]:
    """Names of all packages that these need, as what is installed here says."""
    found: set[str] = set()
    waiting = [(Requirement(text), "") for text in wanted]
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(requirement.name)
        for own in ("", *requirement.extras):
            key = f"{name}[{own}]"
            if key not in found:
                found.add(key)
                waiting += [(Requirement(text), own) for text in requires(name) or ()]
    return {key.partition("[")[0] for key in found}


@pytest.mark.parametrize("extra", EXTRAS)
def test_all_that_an_extra_needs_is_locked_for_it_and_nothing_else(extra: str):
    assert set(pins(locked(LOCK, [extra]))) == closure(requirements(PYPROJECT, [extra]))


def test_all_that_builds_the_wheel_is_locked():
    names = set(pins(locked(LOCK, ["build"])))
    assert {canonicalize_name(Requirement(text).name) for text in build_requirements(PYPROJECT)} <= names
    try:
        assert closure(build_requirements(PYPROJECT)) == names
    except PackageNotFoundError:  # hatchling itself is in no environment but those that build
        assert names >= {"hatchling", "packaging", "pathspec", "pluggy", "trove-classifiers"}


def test_versions_are_those_of_the_constraints():
    pinned = pins((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    found = pins(LOCK.read_text(encoding="utf-8"))
    assert len(found) > 50
    assert found == {name: pinned.get(name) for name in found}


def test_versions_are_those_that_the_project_asks_for():
    found = pins(LOCK.read_text(encoding="utf-8"))
    for text in (*requirements(PYPROJECT, EXTRAS), *build_requirements(PYPROJECT)):
        requirement = Requirement(text)
        assert requirement.specifier.contains(found[canonicalize_name(requirement.name)]), text


def test_every_package_has_hashes_and_no_address():
    text = LOCK.read_text(encoding="utf-8")
    body = [line for line in text.splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[a-z0-9.-]+==\S+ \\|    --hash=sha256:[0-9a-f]{64}( \\)?", line) for line in body)
    for name in pins(text):
        assert re.search(rf"^{re.escape(name)}==\S+ \\\n    --hash=sha256:", text, re.MULTILINE), name
    assert "://" not in text


def test_an_extra_that_is_not_locked_is_refused():
    for extras in ([], ["none"], ["service", "none"]):
        with pytest.raises(ValueError, match="is for build, cluster, ifc, mqtt, offline, service, and not for"):
            locked(LOCK, extras)


def test_the_build_of_packages_takes_the_pins():
    """Constraints reach isolated builds by the environment only."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(
        r"^PINNED := PIP_CONSTRAINT=\S+constraints.txt PIP_BUILD_CONSTRAINT=\S+constraints.txt$", makefile, re.M
    )
    for command in ("--editable", "-m build"):
        (line,) = (line for line in makefile.splitlines() if command in line)
        assert line.startswith("\t$(PINNED) ")
