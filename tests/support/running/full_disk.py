"""Commands that see folders of their own: a small disk, or folders that cannot be written to."""

import functools
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

_NAMESPACE = ("unshare", "--mount", "--map-root-user")


@functools.cache
def _may_mount() -> bool:
    if shutil.which("unshare") is None:
        return False
    probe = subprocess.run([*_NAMESPACE, "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False)
    return probe.returncode == 0


needs_mounts = pytest.mark.skipif(not _may_mount(), reason="no folders may be mounted here")
"""A test that needs folders of its own; not every container may mount them."""


def mounted(
    command: Sequence[str], *, read_only: Sequence[Path] = (), small: Sequence[tuple[Path, str]] = ()
) -> list[str]:
    """Return a command that runs another with some folders as nobody else sees them.

    Parameters
    ----------
    command : sequence of str
    read_only : sequence of Path
        What is in them can be seen.
    small : sequence of (Path, str)
        Each with a disk of its own, empty, of a size such as ``1m``. They may lie in those above.
    """
    lines = [f'mount --bind "{path}" "{path}" && mount -o remount,bind,ro "{path}" &&' for path in read_only]
    lines += [f'mount -t tmpfs -o "size={size}" tmpfs "{path}" &&' for path, size in small]
    return [*_NAMESPACE, "sh", "-c", " ".join([*lines, 'exec "$@"']), "sh", *command]


def temporary_folders() -> list[Path]:
    """Return the folders that Python takes for temporary files, but for those that the environment names."""
    return [path for name in ("/tmp", "/var/tmp", "/usr/tmp") if (path := Path(name)).is_dir()]


def seen_by(pid: int, path: Path) -> Path:
    """Return a path as a process with folders of its own sees it."""
    return Path(f"/proc/{pid}/root{path}")
