"""Log messages while kernels of rayfix are compiled.

numba compiles a kernel silently at its first call. After an installation that takes a minute, on a busy machine several
minutes. Kernels loaded from the cache on disk are not announced.
"""

import logging
import time

from numba.core import event

from rayfix_tables.gaussians.kernel_lock import kernel_lock

_AGAIN_SECONDS = 10.0
"""Time between two messages."""

_log = logging.getLogger("rayfix")


class _Announcer(event.Listener):  # type: ignore[misc]
    """Tracks compilations, one at a time, because numba holds a lock during each."""

    def __init__(self) -> None:
        self._count = 0
        self._begin = 0.0
        self._last: float | None = None

    def on_start(self, event: event.Event) -> None:
        """Announce the first compilation; the compilation of a kernel includes those of the kernels that it calls."""
        if not _is_own(event):
            return
        if self._last is None:
            self._begin = self._last = time.monotonic()
            _log.warning(
                "compiling kernels, once: a few take seconds, all a minute or two, and longer on a busy machine"
            )

    def on_end(self, event: event.Event) -> None:
        """Count compilations, and log the number at intervals."""
        if not _is_own(event) or self._last is None:
            return
        self._count += 1
        now = time.monotonic()
        if now - self._last >= _AGAIN_SECONDS:
            self._last = now
            _log.warning("compiling kernels: %d compiled in %.0f s", self._count, now - self._begin)


def _is_own(event: event.Event) -> bool:
    """Whether a kernel is one of rayfix."""
    module = getattr(event.data["dispatcher"].py_func, "__module__", "") or ""
    return module.startswith("rayfix_")


_announcer = _Announcer()
_registered = False


def watch_compilation() -> None:
    """Announce compilations of rayfix's kernels from now on, and have processes compile one after the other."""
    global _registered
    if not _registered:
        _registered = True
        event.register("numba:compile", _announcer)
        event.register("numba:compiler_lock", kernel_lock())
