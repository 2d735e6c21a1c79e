"""A table's file in the file system: its type is checked before it is opened; only regular files are."""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.errors import NotATableError, TableError

FileState = tuple[int, int, int]
"""Identifies a version of a file: inode, size and time of the last change."""

_SIGNATURE = b"\x89HDF\r\n\x1a\n"


@dataclass(frozen=True, kw_only=True)
class OpenFile:
    """A regular file that is open for reading.

    Attributes
    ----------
    path : Path
        Name when it was opened; another file may have this name now.
    descriptor : int
    state : FileState
        When it was opened.
    """

    path: Path
    descriptor: int
    state: FileState

    @property
    def size(self) -> int:
        """Size when it was opened, bytes."""
        return self.state[1]

    @property
    def unchanged(self) -> bool:
        """Whether it is unchanged since it was opened."""
        return state_of(os.fstat(self.descriptor)) == self.state

    def mapped(self) -> NDArray[np.uint8]:
        """Map its bytes, read-only."""
        with open(self.descriptor, "rb", closefd=False) as file:
            return np.memmap(file, dtype=np.uint8, mode="r")


def state_of(status: os.stat_result) -> FileState:
    """Return the state that identifies this version of a file."""
    return status.st_ino, status.st_size, status.st_mtime_ns


def why_not_regular(path: Path) -> str | None:
    """Describe a path that is not a regular file; None for a regular file, after symbolic links, and a missing one.

    Raises
    ------
    OSError
        When the path cannot be examined.
    """
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "is a symbolic link to nothing" if path.is_symlink() else None
    except OSError as error:
        if error.errno == errno.ELOOP:
            return "is a symbolic link that leads back to itself"
        raise
    if stat.S_ISREG(mode):
        return None
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket"}
    return f"is {kinds.get(stat.S_IFMT(mode), 'a device')}"


@contextmanager
def open_table_file(path: Path) -> Iterator[OpenFile]:
    """Open a file that may be a table. Pipes, sockets and devices are not opened, because that may block.

    Raises
    ------
    TableError
        When it is missing or must not be read.
    NotATableError
        When it is not a regular file, or not an HDF5 file.
    """
    descriptor = _open(path)
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or not has_signature(descriptor, status.st_size):
            raise NotATableError(
                f"{path} is not a rayfix table (not an HDF5 file); give a file that 'rayfix build' wrote"
            )
        yield OpenFile(path=path, descriptor=descriptor, state=state_of(status))
    finally:
        os.close(descriptor)


def _open(path: Path) -> int:
    try:
        if (what := why_not_regular(path)) is not None:
            raise NotATableError(f"{path} {what}, which is not a rayfix table; give a file that 'rayfix build' wrote")
        return os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError):
        raise TableError(f"there is no table at {path}; build one with 'rayfix build SITE.toml -o {path}'") from None
    except PermissionError:
        raise TableError(f"{path} cannot be read; ask its owner for the right to read it") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise TableError(f"{path} cannot be opened ({reason}); give the name of a table") from error


def has_signature(descriptor: int, size: int) -> bool:
    """Whether a file has HDF5's signature: at its beginning, or at 512 bytes times a power of two."""
    place = 0
    while place < size:
        if os.pread(descriptor, len(_SIGNATURE), place) == _SIGNATURE:
            return True
        place = max(512, 2 * place)
    return False
