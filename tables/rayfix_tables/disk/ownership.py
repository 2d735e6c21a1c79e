"""Files and folders that belong to a running process; other processes remove them after its end.

Process numbers cannot identify the owner: each container has a process 1, and containers share volumes. Instead the
owner holds a lock on its file, which the system releases when the owner ends, even by a signal. Names are never reused.
"""

import contextlib
import fcntl
import glob
import os
import uuid
from pathlib import Path


def try_lock(descriptor: int, *, shared: bool = False) -> bool | None:
    """Lock an open file or folder if no other process has; returns whether it succeeded.

    Returns None on network file systems without locks; nothing on them must be treated as abandoned.
    """
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file still has that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except OSError:
        return False


def own_file(folder: Path, prefix: str) -> tuple[Path, int]:
    """Create a file that this process owns while it is open; returns its path and descriptor.

    Raises
    ------
    OSError
        When it cannot be created.
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
        os.close(descriptor)  # another process removed it as abandoned before it was locked


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
