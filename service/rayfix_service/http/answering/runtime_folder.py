"""The common folder of the workers of a service, removed with them, however they end."""

import contextlib
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rayfix_tables.disk.ownership import is_at, try_lock

_PREFIX = "rayfix-serve-"
_LOCK = "in-use"


@contextmanager
def runtime_folder() -> Iterator[Path]:
    """Make a folder that is this process's and that of those forked from it; remove those of services that were killed.

    Raises
    ------
    OSError
        When there is no temporary folder.
    """
    parent = Path(tempfile.gettempdir())
    _remove_abandoned(parent)
    folder, descriptor = _make(parent)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(descriptor)


def _make(parent: Path) -> tuple[Path, int]:
    """Make a folder and lock it: the lock holds until this process and all that are forked from it have ended."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
        lock = folder / _LOCK
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        if try_lock(descriptor) is not False and is_at(descriptor, lock):
            return folder, descriptor
        os.close(descriptor)  # taken for abandoned by another service that starts


def _remove_abandoned(parent: Path) -> None:
    """Remove this user's folders of services of which no process is left."""
    for folder in parent.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            status = folder.lstat()
            if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
                continue
            descriptor = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                if try_lock(descriptor):
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(descriptor)
