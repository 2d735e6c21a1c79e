"""Where compiled kernels are kept when numba finds no folder that it can write to.

numba compiles a kernel once and keeps it beside its module, or else in the user's cache folder; ``NUMBA_CACHE_DIR``
names another one. Where it can write to none of them, as in a read-only container without a home, importing a module
with kernels fails: numba's decorator looks for the folder when it is applied. So this cannot wait for a first call, and
the three packages with kernels call :func:`ensure_kernel_cache` in their ``__init__``, which Python runs before any of
their modules, whichever is imported first. ``rayfix_tables`` does not: whoever only reads a table needs no folder.
Nothing else runs when a package is imported. This is the only module that changes the process's environment for it, so
that worker processes take the same folder.
"""

import logging
import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rayfix_tables.errors import RayfixError

VARIABLE = "NUMBA_CACHE_DIR"

_log = logging.getLogger("rayfix")


def ensure_kernel_cache(package: Path) -> None:
    """Let numba keep kernels in a private temporary folder if it can write nowhere else.

    Parameters
    ----------
    package : Path
        Folder of the package with the kernels.

    Raises
    ------
    RayfixError
        When no temporary folder can be written to either.
    """
    given = os.environ.get(VARIABLE)
    if any(
        _is_writable(folder) for folder in (given and Path(given), package / "__pycache__", _user_cache()) if folder
    ):
        return
    folder = _temporary_folder()
    os.environ[VARIABLE] = str(folder)
    if "numba" in sys.modules:
        # It read the environment when it was imported.
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    _log.warning(
        "compiled kernels go to %s, as neither %s nor the user's cache folder can be written to; "
        "set %s to a folder that lasts",
        folder,
        given or package,
        VARIABLE,
    )


def _is_writable(folder: Path) -> bool:
    """Whether numba could keep kernels in a folder: it makes the folder and a file in it, and so does this."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _user_cache() -> Path | None:
    """Folder that numba takes of the user's; None without a home, for which numba takes one called ``~``."""
    if sys.platform == "darwin":
        folder = Path(os.path.expanduser("~/Library/Caches"))
    else:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return folder / "numba" if folder.is_absolute() else None


def _temporary_folder() -> Path:
    """Make a folder that only this user can read and write: what is in it is run."""
    tried = []
    for parent in _temporary_parents():
        try:
            return _private_folder(parent)
        except OSError as error:
            tried.append(f"{parent} ({error.strerror})")
    raise RayfixError(
        f"there is no folder for compiled kernels: none of {', '.join(tried)} can be written to; "
        f"set {VARIABLE} to a folder that can, or mount one at /tmp"
    )


def _temporary_parents() -> Iterator[Path]:
    # Not tempfile.gettempdir(), which takes the current folder when all else fails.
    named = [os.environ[name] for name in ("TMPDIR", "TEMP", "TMP") if os.environ.get(name)]
    yield from map(Path, dict.fromkeys((*named, "/tmp", "/var/tmp", "/dev/shm")))


def _private_folder(parent: Path) -> Path:
    """Folder of this user, the same one each time unless another user has taken its name."""
    folder = parent / f"rayfix-kernels-{os.geteuid()}"
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        found = folder.lstat()
        # Whoever else could write there could have this process run anything.
        mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077
        if not mine:
            folder = Path(tempfile.mkdtemp(prefix="rayfix-kernels-", dir=parent))
    tempfile.TemporaryFile(dir=folder).close()
    return folder
