"""The folder of compiled kernels when numba finds none that it can write to.

numba compiles a kernel once and caches it next to its module or in the user's cache folder; ``NUMBA_CACHE_DIR`` names
another one. If it can write to none of them, as in a read-only container without a home, importing a module with
kernels fails, because numba's decorator looks for the folder. The three packages with kernels therefore call
:func:`ensure_kernel_cache` in their ``__init__``, which Python runs before any of their modules. ``rayfix_tables`` does
not, because reading a table needs no folder. Nothing else runs when a package is imported. This is the only module that
changes the process's environment; worker processes inherit the folder.

numba compiles a kernel anew when its own file has changed. A kernel holds compiled copies of those that it calls, and
after a change of one of these, as a checkout of another version is, old copies would run with new ones: this ended in
wrong numbers or a crash. The call therefore forgets the kernels beside the modules when any module with kernels has
changed, or one that it imports from.
"""

import hashlib
import logging
import os
import re
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rayfix_tables.errors import RayfixError

VARIABLE = "NUMBA_CACHE_DIR"

_STAMP = "kernels.stamp"
_TABLES = Path(__file__).parents[1]
_IMPORTED = re.compile(rb"^\s*from (rayfix_[\w.]+) import", re.MULTILINE)

_log = logging.getLogger("rayfix")


def ensure_kernel_cache(package: Path) -> None:
    """Forget kernels of other sources, and let numba cache kernels in a temporary folder if it can write nowhere else.

    Parameters
    ----------
    package : Path
        Folder of the package with the kernels.

    Raises
    ------
    RayfixError
        When no temporary folder is writable either.
    """
    for folder in (_TABLES, package):
        _forget_stale_kernels(folder)
    if any(map(_is_writable, kernel_folders(package))):
        return
    given, folder = os.environ.get(VARIABLE), _temporary_folder()
    os.environ[VARIABLE] = str(folder)
    if "numba" in sys.modules:
        # numba read the environment at its import.
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    _log.warning(
        "compiled kernels go to %s, as neither %s nor the user's cache folder can be written to; "
        "set %s to a folder that lasts",
        folder,
        given or package,
        VARIABLE,
    )


def kernel_folders(package: Path) -> tuple[Path, ...]:
    """Return the folders that numba would keep a package's kernels in, the first that can be written to."""
    given = os.environ.get(VARIABLE)
    named = (given and Path(given), package / "__pycache__", _user_cache())
    return tuple(folder for folder in named if folder)


def _forget_stale_kernels(package: Path) -> None:
    """Remove numba's files beside the modules of a package if they are of other modules than there are now."""
    stamp = package / "__pycache__" / _STAMP
    try:
        found = _stamp_of(package)
        if stamp.exists() and stamp.read_bytes() == found:
            return
        for folder in {path.parent for path in _modules(package)}:
            for pattern in ("*.nbi", "*.nbc"):  # the index first: what it names must be there
                for path in folder.glob(f"__pycache__/{pattern}"):
                    path.unlink(missing_ok=True)  # another process may do the same
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_bytes(found)
    except OSError:
        # Nothing can be written here, so that no kernels were, or they came with the sources.
        return


def _modules(package: Path) -> Iterator[Path]:
    yield from package.glob("*.py")
    for inner in package.iterdir():
        if (inner / "__init__.py").is_file():
            yield from _modules(inner)


def _stamp_of(package: Path) -> bytes:
    """Return a digest of the modules with kernels and of those that they import from: kernels hold their constants."""
    texts = {path: path.read_bytes() for folder in {_TABLES, package} for path in _modules(folder)}
    used = {path for path, text in texts.items() if b"numba" in text}
    for names in [_IMPORTED.findall(texts[path]) for path in used]:
        for name in names:
            root, *inner = name.decode().split(".")
            folder = _TABLES if root == _TABLES.name else package
            used.add(folder.joinpath(*inner).with_suffix(".py"))
    digest = hashlib.sha256()
    for path in sorted(used & texts.keys()):
        digest.update(path.name.encode() + hashlib.sha256(texts[path]).digest())
    return digest.hexdigest().encode()


def _is_writable(folder: Path) -> bool:
    """Whether numba could cache kernels in a folder: like numba, this creates the folder and a file in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _user_cache() -> Path | None:
    """Return numba's user cache folder; None without a home, where numba would use a folder called ``~``."""
    if sys.platform == "darwin":
        folder = Path(os.path.expanduser("~/Library/Caches"))
    else:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return folder / "numba" if folder.is_absolute() else None


def _temporary_folder() -> Path:
    """Create a folder that only this user can read and write, because its content is executed."""
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
    # tempfile.gettempdir() would fall back to the current folder.
    named = [os.environ[name] for name in ("TMPDIR", "TEMP", "TMP") if os.environ.get(name)]
    yield from map(Path, dict.fromkeys((*named, "/tmp", "/var/tmp", "/dev/shm")))


def _private_folder(parent: Path) -> Path:
    """Folder of this user, the same at each call unless another user has taken its name."""
    folder = parent / f"rayfix-kernels-{os.geteuid()}"
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        found = folder.lstat()
        # Another user who could write there could make this process run any code.
        mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077
        if not mine:
            folder = Path(tempfile.mkdtemp(prefix="rayfix-kernels-", dir=parent))
    tempfile.TemporaryFile(dir=folder).close()
    return folder
