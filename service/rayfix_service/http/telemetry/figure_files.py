"""Files of figures that several processes share, on disks that may be full.

prometheus-client maps sparse files. Where the disk is full, the first write to a page that is not there yet ends the
process with SIGBUS, and so it ends each of its successors. Here a page is there before it is written to.
"""

import logging
import mmap
import os
from contextlib import suppress

from prometheus_client.mmap_dict import MmapedDict

_INITIAL_BYTES = 1 << 16  # as prometheus-client has it
_KEY_BYTES = 64  # of an entry besides its key, at most

_IN_MEMORY = (
    "the figures of process %d are left out of /metrics of the other workers from now on: %s (%s); make room there "
    "and start the service again"
)

_log = logging.getLogger(__name__)


class ReservedDict(MmapedDict):
    """Figures of one process in a file that has room for them, else in memory.

    Parameters
    ----------
    filename : str
    read_mode : bool
        As of ``MmapedDict``.
    """

    def __init__(self, filename: str, read_mode: bool = False) -> None:
        self._path = filename
        if read_mode or self._reserve(_INITIAL_BYTES):
            super().__init__(filename, read_mode)  # type: ignore[no-untyped-call]
            return
        with suppress(OSError):
            if os.path.getsize(filename) == 0:
                os.unlink(filename)
        descriptor = os.memfd_create("figures")
        try:
            super().__init__(f"/proc/self/fd/{descriptor}")  # type: ignore[no-untyped-call]
        finally:
            os.close(descriptor)
        self._path = ""

    def _init_value(self, key: str) -> None:
        while self._path and self._used + len(key.encode()) + _KEY_BYTES > self._capacity:
            if self._reserve(2 * self._capacity):
                self._capacity *= 2
                self._m = mmap.mmap(self._f.fileno(), self._capacity)
            else:
                self._move_to_memory()
        super()._init_value(key)  # type: ignore[no-untyped-call]

    def _reserve(self, size: int) -> bool:
        """Make the file that long, with room on its disk."""
        try:
            with open(self._path, "ab") as file:
                os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            _log.warning(_IN_MEMORY, os.getpid(), self._path, error.strerror)
            return False
        return True

    def _move_to_memory(self) -> None:
        """Leave the file as it is, with its last figures, and go on with a copy."""
        content = self._m[:]
        self.close()  # type: ignore[no-untyped-call]
        self._f = os.fdopen(os.memfd_create("figures"), "a+b")
        self._f.write(content)
        self._f.flush()
        self._m = mmap.mmap(self._f.fileno(), self._capacity)
        self._path = ""
