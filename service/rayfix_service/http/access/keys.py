"""API keys: made, kept as hashes, and recognised.

A key file has a line ``NAME:HASH`` for each key, the hash being the SHA-256 of the key in hexadecimal digits; blank
lines and those that begin with ``#`` are left out. Keys are 256 random bits, so that a plain hash cannot be reversed:
what makes password hashes slow is for secrets that people choose.
"""

import asyncio
import hashlib
import hmac
import logging
import os
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rayfix_service.http.errors import ServiceError
from rayfix_tables.disk.files import why_not_regular

_log = logging.getLogger(__name__)

_MOST_BYTES = 1 << 20  # of a key file
_LINE = re.compile(r"([A-Za-z0-9._-]{1,64}):([0-9a-f]{64})")


class ApiKeys:
    """The keys that a service takes. Of one event loop.

    Parameters
    ----------
    path : pathlib.Path
        The key file.

    Raises
    ------
    ServiceError
        When it cannot be read, or a line is wrong.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._hashes = _read_hashes(path)
        self._found_none = False
        self._using: dict[object, tuple[str, Callable[[], None]]] = {}

    def name_of(self, key: str) -> str | None:
        """Return the name of a key, None for one that is unknown.

        All hashes are compared, each in constant time, so that the time reveals nothing about them.
        """
        digest = _digest(key)
        found = None
        for name, known in self._hashes.items():
            if hmac.compare_digest(digest, known):
                found = name
        return found

    @contextmanager
    def in_use(self, key: str, end: Callable[[], None]) -> Iterator[None]:
        """Call ``end`` when a key, which something that stays open was admitted with, is no longer taken."""
        digest, use = _digest(key), object()
        self._using[use] = (digest, end)
        try:
            if digest not in self._hashes.values():  # taken out between the two
                end()
            yield
        finally:
            self._using.pop(use, None)

    async def reread(self) -> bool:
        """Read the file again; a mounted secret may have changed. Tell whether the keys are those of the file.

        Without a key in it, or without the file, there are none: that counts once two looks in a row found it so, as
        someone may be about to write it anew.

        Raises
        ------
        ServiceError
            When it cannot be used; the keys stay as they are.
        """
        hashes = await asyncio.to_thread(self._read)
        if not hashes and self._hashes and not self._found_none:
            self._found_none = True
            return False
        self._found_none = False
        if hashes == self._hashes:
            return True
        if not hashes:
            _log.warning("there is no key in %s any more: nobody is let in", self._path)
        self._hashes = hashes
        for digest, end in list(self._using.values()):
            if digest not in hashes.values():
                end()
        return True

    def _read(self) -> dict[str, str]:
        try:
            self._path.stat()
        except FileNotFoundError:
            return {}
        except OSError:
            pass  # whoever reads it reports the error
        return _read_hashes(self._path)


def read_key_file(path: Path) -> dict[str, str]:
    """Read the hashes of a key file by the names of the keys.

    Raises
    ------
    ServiceError
        When it cannot be read, a line is wrong, or there is no key.
    """
    hashes = _read_hashes(path)
    if not hashes:
        raise ServiceError(f"{path} has no key; add one with 'rayfix api-key NAME -o {path}'")
    return hashes


def _read_hashes(path: Path) -> dict[str, str]:
    try:
        lines = _read_regular(path).decode("utf-8").splitlines()
    except OSError as error:
        raise ServiceError(
            f"the key file {path} cannot be read ({error.strerror}); make one with 'rayfix api-key NAME -o {path}'"
        ) from None
    except UnicodeDecodeError:
        raise ServiceError(f"the key file {path} is no text; make one with 'rayfix api-key NAME -o FILE'") from None
    hashes: dict[str, str] = {}
    for number, line in enumerate(map(str.strip, lines), start=1):
        if not line or line.startswith("#"):
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise ServiceError(f"{path} line {number} is no NAME:HASH; make lines with 'rayfix api-key NAME -o {path}'")
        name, digest = match.groups()
        if name in hashes:
            raise ServiceError(f"{path} line {number} has the name {name} again; give each key a name of its own")
        hashes[name] = digest
    return hashes


def _read_regular(path: Path) -> bytes:
    """Read a file; a pipe may have no end, nor anyone who writes to it, and holds up whoever opens it."""
    if (what := why_not_regular(path)) is not None and path.exists():
        raise ServiceError(f"the key file {path} {what}; give a file that 'rayfix api-key NAME -o FILE' has made")
    # Another may have taken its place since: it is not waited for.
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise ServiceError(f"the key file {path} has more than {_MOST_BYTES} bytes; take out keys that are not used")
    return content


def add_key(path: Path, name: str) -> str:
    """Make a key, add its hash to a file, made if need be, and return the key.

    Raises
    ------
    ServiceError
        When the name is no name or taken, or the file cannot be written.
    """
    key = f"rfx_{secrets.token_urlsafe(32)}"
    line = f"{name}:{_digest(key)}"
    if _LINE.fullmatch(line) is None:
        raise ServiceError(f"the name {name!r} is none; give 1 to 64 of the characters A-Z a-z 0-9 . _ -")
    if path.exists() and name in _read_hashes(path):
        raise ServiceError(f"{path} has a key named {name}; give another name, or take its line out first")
    try:
        with open(os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o600), "r+", encoding="utf-8") as file:
            text = file.read()
            file.write(f"{line}\n" if not text or text.endswith("\n") else f"\n{line}\n")
    except OSError as error:
        raise ServiceError(f"the key file {path} cannot be written ({error.strerror}); give another") from None
    return key


def _digest(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()
