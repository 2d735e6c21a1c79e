"""Containers without an engine: own mounts and processes, a read-only root, an account without rights, own environment.

The network is the machine's. Needs root, unshare, setpriv and nsenter (util-linux).
"""

import contextlib
import os
import shlex
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Volume:
    """A folder or file of the machine, as a container sees it."""

    source: Path
    target: str
    read_only: bool


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a container runs, and in what."""

    command: Sequence[str]
    environment: Mapping[str, str]
    user: int
    group: int
    folder: str
    volumes: Sequence[Volume] = ()
    tmpfs: Mapping[str, str] = field(default_factory=dict)
    read_only: bool = True


class Container:
    """A process in namespaces of its own."""

    def __init__(self, root: Path, run: Run, output: Path) -> None:
        self._run = run
        self.output = output
        with output.open("wb") as sink:
            self._outer = subprocess.Popen(
                ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-euc", _script(root, run)],
                stdout=sink,
                stderr=subprocess.STDOUT,
            )

    @property
    def pid(self) -> int:
        """Process 1 of the container, by the machine's numbers."""
        outer = self._outer.pid
        while self._outer.poll() is None:
            children = Path(f"/proc/{outer}/task/{outer}/children").read_text().split()
            if children:
                return int(children[0])
            time.sleep(0.01)
        raise SystemExit(f"a container ended at once:\n{self.log()}")

    def log(self) -> str:
        """Return what it has written."""
        return self.output.read_text(encoding="utf-8", errors="replace")

    def wait(self, seconds: float) -> int:
        """Wait for its end and return its status."""
        return self._outer.wait(seconds)

    def running(self) -> bool:
        """Whether it has not ended."""
        return self._outer.poll() is None

    def terminate(self) -> None:
        """Send SIGTERM to process 1, as engines do."""
        os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """End it, if it has not."""
        if self.running():
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
            self._outer.wait(30)

    def execute(self, *command: str) -> subprocess.CompletedProcess[str]:
        """Run one more program in it, as a health check does."""
        enter = ["nsenter", f"--target={self.pid}", "--mount", "--pid", "--root", f"--wd=/proc/{self.pid}/root"]
        account = [f"--setuid={self._run.user}", f"--setgid={self._run.group}"]
        return subprocess.run(
            [*enter, *account, *command],
            env=dict(self._run.environment),
            capture_output=True,
            text=True,
            check=False,
        )

    def inside(self, path: str) -> Path:
        """Path of one of its files on the machine."""
        return Path(f"/proc/{self.pid}/root") / path.lstrip("/")


@contextmanager
def container(root: Path, run: Run, output: Path) -> Iterator[Container]:
    """Start a container, and end it in any case."""
    for volume in run.volumes:
        _make_place(root / volume.target.lstrip("/"), volume.source.is_dir())
    for target in run.tmpfs:
        _make_place(root / target.lstrip("/"), True)
    started = Container(root, run, output)
    try:
        yield started
    finally:
        started.kill()


def _make_place(path: Path, is_folder: bool) -> None:
    """Make what a volume is mounted on, as engines do."""
    if is_folder:
        path.mkdir(parents=True, exist_ok=True)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def _script(root: Path, run: Run) -> str:
    """Shell commands that mount everything and become the container's program."""
    lines = [
        "mount --make-rprivate /",
        f"mount --bind {root} {root}",
        f"mount --rbind /dev {root}/dev",
        f"mount -t proc proc {root}/proc",
    ]
    for target, options in run.tmpfs.items():
        lines.append(f"mount -t tmpfs -o {shlex.quote(options)} tmpfs {root}{target}")
    for volume in run.volumes:
        place = shlex.quote(f"{root}{volume.target}")
        lines.append(f"mount --bind {shlex.quote(str(volume.source))} {place}")
        if volume.read_only:
            lines.append(f"mount -o remount,bind,ro {place}")
    if run.read_only:
        lines.append(f"mount -o remount,bind,ro {root}")
    environment = [f"{name}={value}" for name, value in run.environment.items()]
    program = shlex.join(
        [
            *("env", "--ignore-environment", *environment),
            *("/usr/bin/setpriv", "--no-new-privs", "--clear-groups", "--inh-caps=-all"),
            *("/usr/bin/unshare", f"--root={root}", f"--wd={run.folder}"),
            *(f"--setgid={run.group}", f"--setuid={run.user}", *run.command),
        ]
    )
    return "\n".join([*lines, f"exec {program}"])
