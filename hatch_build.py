"""Build hook: packages hold the viewer, built by npm where its files are missing or older than their sources."""

import shutil
import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FRONTEND = Path("service/rayfix_service/web/frontend")
BUILT = Path("service/rayfix_service/web/static/index.html")


class ViewerBuildHook(BuildHookInterface):
    """Runs ``npm ci`` and ``npm run build``."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the viewer, unless this is an editable install, which ``make viewer`` serves."""
        root = Path(self.root)
        if version == "editable" or is_fresh(root):
            return
        if not can_build():
            self.app.display_warning("no npm with Node.js 20.19 or later: the package will be without the viewer")
            return
        for command in (["npm", "ci"], ["npm", "run", "build"]):
            subprocess.run(command, cwd=root / FRONTEND, check=True)


def can_build() -> bool:
    """Whether there is an npm whose Node.js is new enough for Vite."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        return False
    version = subprocess.run(["node", "--version"], capture_output=True, text=True, check=True).stdout
    major, minor = version.strip().removeprefix("v").split(".")[:2]
    return (int(major), int(minor)) >= (20, 19)


def is_fresh(root: Path) -> bool:
    """Whether the viewer is built and no source is newer."""
    built = root / BUILT
    if not built.is_file():
        return False
    frontend = root / FRONTEND
    sources = [*frontend.glob("*.*"), *(frontend / "src").rglob("*.*")]
    return all(source.stat().st_mtime <= built.stat().st_mtime for source in sources)
