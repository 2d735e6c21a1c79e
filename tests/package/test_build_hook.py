"""The build hook of packages: with npm, without, and with an npm that fails."""

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tests.support.checkout import ROOT


class Application:
    """What hatchling gives a hook to speak through."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def display_warning(self, text: str) -> None:
        """Keep a warning."""
        self.warnings.append(text)

    def abort(self, text: str) -> None:
        """End the build."""
        raise SystemExit(text)


@pytest.fixture
def hook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the hook of a checkout in which nothing is built, and a folder of programs that is all of PATH."""
    interface = ModuleType("hatchling.builders.hooks.plugin.interface")
    interface.BuildHookInterface = object  # type: ignore[attr-defined]
    for name in ("hatchling", "hatchling.builders", "hatchling.builders.hooks", "hatchling.builders.hooks.plugin"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, interface.__name__, interface)
    spec = importlib.util.spec_from_file_location("hatch_build_under_test", ROOT / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (tmp_path / module.FRONTEND).mkdir(parents=True)
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}/nowhere")
    monkeypatch.delenv(module.VARIABLE, raising=False)
    made = module.ViewerBuildHook()
    made.root, made.app = str(tmp_path), Application()
    return SimpleNamespace(hook=made, module=module, root=tmp_path)


def program(folder: Path, name: str, script: str) -> None:
    path = folder / "bin" / name
    path.write_text(f"#!/bin/sh\n{script}\n", encoding="ascii")
    path.chmod(0o755)


def test_without_node_the_package_is_without_the_viewer_and_says_so(hook: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    hook.hook.initialize("standard", {})
    assert hook.hook.app.warnings == [
        "there is no npm with Node.js 20.19 or later: the package will be without the viewer"
    ]
    monkeypatch.setenv("RAYFIX_VIEWER", "require")
    with pytest.raises(SystemExit, match=r"cannot be built: there is no npm .* or set RAYFIX_VIEWER=skip"):
        hook.hook.initialize("standard", {})


def test_an_npm_that_fails_is_one_line_with_the_way_out(hook: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    program(hook.root, "node", "echo v22.1.0")
    program(
        hook.root,
        "npm",
        "echo 'npm error code EAI_AGAIN'; echo 'npm error errno -3'; echo 'npm error getaddrinfo EAI_AGAIN'; exit 1",
    )
    with pytest.raises(SystemExit) as stopped:
        hook.hook.initialize("standard", {})
    assert str(stopped.value) == (
        "the viewer cannot be built: 'npm ci' failed (npm error getaddrinfo EAI_AGAIN); see whether npm reaches its "
        "registry, or set RAYFIX_VIEWER=skip to install without the viewer"
    )
    monkeypatch.setenv("RAYFIX_VIEWER", "skip")
    hook.hook.initialize("standard", {})
    monkeypatch.setenv("RAYFIX_VIEWER", "no")
    with pytest.raises(SystemExit, match="give auto, skip or require"):
        hook.hook.initialize("standard", {})


def test_what_is_built_is_taken_without_npm(hook: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the source distribution, all of whose files have one time."""
    monkeypatch.setenv("RAYFIX_VIEWER", "require")
    built = hook.root / hook.module.BUILT
    built.parent.mkdir(parents=True)
    source = hook.root / hook.module.FRONTEND / "index.html"
    for path in (built, source):
        path.touch()
        os.utime(path, (1_580_601_600, 1_580_601_600))
    hook.hook.initialize("standard", {})
    assert hook.hook.app.warnings == []
