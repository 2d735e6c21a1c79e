"""Images made and kept by buildah."""

import json
import platform
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BASE = "docker.io/library/debian:bookworm-slim"
NODE = "docker.io/library/node:22-bookworm-slim"
_NOT_IN_SLIM = ("man", "locale", "info", "groff", "lintian", "linda")


@dataclass(frozen=True, kw_only=True)
class Store:
    """A folder of images and containers.

    Attributes
    ----------
    folder : pathlib.Path
    driver : str
        ``vfs`` works on every file system, by copying; ``overlay`` is faster where it works.
    """

    folder: Path
    driver: str = "vfs"

    def buildah(self, *arguments: str | Path, quiet: bool = True) -> str:
        """Run buildah and return what it printed."""
        places = ["--root", self.folder / "storage", "--runroot", self.folder / "run", "--storage-driver", self.driver]
        command = [str(part) for part in ("buildah", *places, *arguments)]
        done = subprocess.run(command, stdout=subprocess.PIPE if quiet else None, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} ended with status {done.returncode}\n{done.stdout or ''}")
        return (done.stdout or "").strip()

    def has(self, image: str) -> bool:
        """Whether there is an image of this name."""
        return bool(self.buildah("images", "--quiet", "--filter", f"reference={image}"))

    def make_base(self) -> None:
        """Make what Debian's slim image holds from Debian's packages, under its name."""
        root = self.folder / "base"
        shutil.rmtree(root, ignore_errors=True)
        debootstrap = ["debootstrap", "--variant=minbase", "bookworm", str(root)]
        with (self.folder / "debootstrap.log").open("w") as log:
            subprocess.run(debootstrap, check=True, stdout=log, stderr=log)
        emptied = [root / "usr/share" / name for name in _NOT_IN_SLIM]
        emptied += [root / name for name in ("var/cache/apt", "var/lib/apt/lists", "var/log")]
        for folder in emptied:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
        for document in (root / "usr/share/doc").rglob("*"):
            if document.is_symlink() or (document.is_file() and document.name != "copyright"):
                document.unlink()
        container = self.buildah("from", "scratch")
        self.buildah("add", "--quiet", container, root, "/")
        self.buildah("config", "--cmd", "bash", container)
        self.buildah("commit", "--quiet", "--rm", container, BASE)
        shutil.rmtree(root)

    def make_node(self, base: str) -> None:
        """Make what Node's image holds from a base and npm's registry, under its name."""
        prefix = self.folder / "node"
        shutil.rmtree(prefix, ignore_errors=True)
        processor = {"x86_64": "x64", "aarch64": "arm64"}[platform.machine()]
        install = ["npm", "install", "--global", "--no-progress", "--loglevel=error", "--prefix", str(prefix)]
        subprocess.run([*install, f"node-linux-{processor}@22", "npm@10"], check=True, stdout=subprocess.DEVNULL)
        container = self.buildah("from", "--pull-never", base)
        self.buildah("add", "--quiet", container, prefix, "/usr/local")
        self.buildah("commit", "--quiet", "--rm", container, NODE)
        shutil.rmtree(prefix)

    def build(
        self, context: Path, target: str, *, base: str, secrets: Mapping[str, Path], arguments: Mapping[str, str]
    ) -> None:
        """Build a target of docker/Dockerfile under its name ``rayfix-TARGET``."""
        options = [f"--secret=id={name},src={path}" for name, path in secrets.items()]
        options += [f"--build-arg={name}={value}" for name, value in {"BASE": base, **arguments}.items()]
        self.buildah(
            *("bud", "--isolation", "chroot", "--format", "docker", "--pull-never", "--network", "host", "--layers"),
            *("--file", context / "docker/Dockerfile", "--target", target, "--tag", f"rayfix-{target}"),
            *options,
            context,
        )

    def config(self, image: str) -> dict[str, Any]:
        """Return the configuration of an image: Env, Entrypoint, Cmd, User, Healthcheck and so on."""
        description = json.loads(self.buildah("inspect", "--type", "image", image))
        config: dict[str, Any] = description["Docker"]["config"]
        return config

    def history(self, image: str) -> str:
        """Return what the image says of how it was made."""
        return json.dumps(json.loads(self.buildah("inspect", "--type", "image", image))["Docker"].get("history", []))

    @contextmanager
    def root_of(self, image: str) -> Iterator[Path]:
        """Mount the files of a new container of an image."""
        container = self.buildah("from", "--pull-never", f"localhost/{image}")
        try:
            yield Path(self.buildah("mount", container))
        finally:
            self.buildah("rm", container)
