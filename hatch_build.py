"""Build hook: packages hold the viewer, built by npm where its files are missing or older than their sources.

The environment variable ``RAYFIX_VIEWER`` decides what happens where they have to be built:

- ``auto``, the default: built where there is an npm with a Node.js that is new enough, left out where there is none;
- ``skip``: left out;
- ``require``: built, or there is no package.
"""

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

VARIABLE = "RAYFIX_VIEWER"
FRONTEND = Path("service/rayfix_service/web/frontend")
BUILT = Path("service/rayfix_service/web/static/index.html")
NO_NODE = "there is no npm with Node.js 20.19 or later"


class ViewerBuildHook(BuildHookInterface):
    """Runs ``npm ci`` and ``npm run build``."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the viewer, unless this is an editable install, which ``make viewer`` serves."""
        root = Path(self.root)
        choice = os.environ.get(VARIABLE) or "auto"
        if choice not in ("auto", "skip", "require"):
            self.app.abort(f"{VARIABLE} is {choice!r}; give auto, skip or require")
        if version == "editable" or choice == "skip" or is_fresh(root):
            return
        if not can_build():
            if choice == "require":
                self.app.abort(f"the viewer cannot be built: {NO_NODE}; install it, or set {VARIABLE}=skip")
            self.app.display_warning(f"{NO_NODE}: the package will be without the viewer")
            return
        for command in (["npm", "ci"], ["npm", "run", "build"]):
            done = subprocess.run(
                command, cwd=root / FRONTEND, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
            )
            if done.returncode:
                self.app.abort(
                    f"the viewer cannot be built: '{' '.join(command)}' failed ({reason(done.stdout)}); see whether "
                    f"npm reaches its registry, or set {VARIABLE}=skip to install without the viewer"
                )


def reason(output: str) -> str:
    """Return the line of npm's output that says most: the first of its errors, else the last line of all."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if re.match(r"npm (error|ERR!) (?!code|syscall|errno|A complete log)", line)]
    return (errors or lines[-1:] or ["it said nothing"])[0]


def can_build() -> bool:
    """Whether there is an npm whose Node.js is new enough for Vite."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        return False
    done = subprocess.run(["node", "--version"], capture_output=True, text=True, check=False)
    try:
        major, minor = done.stdout.strip().removeprefix("v").split(".")[:2]
        return (int(major), int(minor)) >= (20, 19)
    except ValueError:
        return False


def is_fresh(root: Path) -> bool:
    """Whether the viewer is built and no source is newer."""
    built = root / BUILT
    if not built.is_file():
        return False
    frontend = root / FRONTEND
    sources = [*frontend.glob("*.*"), *(frontend / "src").rglob("*.*")]
    return all(source.stat().st_mtime <= built.stat().st_mtime for source in sources)
