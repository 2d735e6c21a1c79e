"""Files and folders that belong to a running process, and are removed by others once it has ended.

A process number does not tell: the first process of each container has the number 1, and containers share volumes. The
owner holds a lock on its file, which the system takes away when the owner ends, however it ends. Names are never used
twice.
"""

import contextlib
import fcntl
import glob
import os
import uuid
from pathlib import Path


def try_lock(descriptor: int, *, shared: bool = False) -> bool | None:
    """Lock an open file or folder, if nobody else has; returns whether it did.

    Some network file systems have no locks: there it returns None, and nothing is to be taken for abandoned.
    """
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except OSError:
        return False


def own_file(folder: Path, prefix: str) -> tuple[Path, int]:
    """Make a file that is this process's as long as it is open; returns its path and descriptor.

    Raises
    ------
    OSError
        When it cannot be made.
    """
    while True:
        path = folder / f"{prefix}{uuid.uuid4().hex}"
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            locked = try_lock(descriptor)
            if locked is None or (locked and is_at(descriptor, path)):
                return path, descriptor
        except BaseException:
            os.close(descriptor)
            with contextlib.suppress(OSError):
                path.unlink()
            raise
        os.close(descriptor)  # taken for abandoned before it was locked


def remove_abandoned(folder: Path, prefix: str) -> None:
    """Remove the files of :func:`own_file` whose owners have ended."""
    for path in folder.glob(f"{glob.escape(prefix)}{'[0-9a-f]' * 32}"):
        with contextlib.suppress(OSError):
            descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                if try_lock(descriptor) and is_at(descriptor, path):
                    path.unlink()
            finally:
                os.close(descriptor)
