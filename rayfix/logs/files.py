"""Opening logs: plain or gzip, with a count of the bytes that have been read."""

import gzip
import hashlib
import io
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from rayfix_tables.errors import ReportError

LONGEST = 1 << 20
"""Bytes that a line, or an element of an array, may have."""

_GZIP = b"\x1f\x8b"
_HEAD = 1 << 20


class LogFile:
    """An open log.

    Parameters
    ----------
    path : pathlib.Path
    raw : BinaryIO
        The file itself.

    Attributes
    ----------
    name : str
        Of the file, without its folder and ``.gz``.
    content : BinaryIO
        Its content, decompressed.
    """

    def __init__(self, path: Path, raw: BinaryIO) -> None:
        self.path = path
        self.name = path.name
        self._raw = raw
        zipped = raw.read(2) == _GZIP
        raw.seek(0)
        self.content: BinaryIO = io.BufferedReader(gzip.GzipFile(fileobj=raw)) if zipped else raw

    @property
    def bytes_read(self) -> int:
        """How much of the file has been read, compressed bytes."""
        return self._raw.tell()

    def head(self) -> bytes:
        """Return the beginning of the content, a line's length at most, and leave the file at its beginning.

        Raises
        ------
        ReportError
            As :meth:`read` does.
        """
        found = self.read(LONGEST)
        self.content.seek(0)
        return found

    def read(self, count: int) -> bytes:
        """Read at most so many bytes of the content; none at its end.

        Raises
        ------
        ReportError
            When the file cannot be read on, or is damaged.
        """
        try:
            return self.content.read(count)
        except (OSError, EOFError, zlib.error) as error:
            raise _unreadable(self.path, error) from None

    def lines(self) -> Iterator[tuple[int, bytes]]:
        """Give the lines with their numbers; of one that is too long, only the beginning.

        Raises
        ------
        ReportError
            As :meth:`read` does.
        """
        number, inside = 0, False
        while True:
            try:
                line = self.content.readline(LONGEST + 1)
            except (OSError, EOFError, zlib.error) as error:
                raise _unreadable(self.path, error) from None
            if not line:
                return
            whole = line.endswith(b"\n")
            if not inside:
                number += 1
                yield number, line
            inside = not whole


@contextmanager
def open_log(path: Path) -> Iterator[LogFile]:
    """Open a log.

    Raises
    ------
    ReportError
        When there is no such file, or it cannot be read.
    """
    try:
        raw = path.open("rb")
    except OSError as error:
        raise ReportError(f"{path} cannot be read ({error.strerror}); give a file with reports") from error
    with raw:
        if not raw.seekable():
            raise ReportError(f"{path} is a pipe or a device; write the log to a file first")
        try:
            yield LogFile(path, raw)
        except OSError as error:
            raise _unreadable(path, error) from error


def fingerprint(path: Path) -> list[str | int]:
    """Tell a log from others: its name, size, time of change, and the hash of its beginning.

    Raises
    ------
    ReportError
        When it cannot be read.
    """
    try:
        with path.open("rb") as file:
            digest = hashlib.sha256(file.read(_HEAD)).hexdigest()
        stat = path.stat()
    except OSError as error:
        raise ReportError(f"{path} cannot be read ({error.strerror}); give a file with reports") from error
    return [path.name, stat.st_size, stat.st_mtime_ns, digest]


def _unreadable(path: Path, error: Exception) -> ReportError:
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return ReportError(f"{path} cannot be read to its end ({reason}); is the file complete?")
