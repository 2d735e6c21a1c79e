"""Fetch a site's files: ``fetch_files.py FOLDER NAME URL SHA256 ...``; from an object store's signed URLs, say.

A file gets its name once it is whole and has the hash that was asked for. One that is there already is not fetched.
"""

import hashlib
import shutil
import sys
import urllib.request
from pathlib import Path


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fetch(path: Path, url: str, sha256: str) -> None:
    """Fetch a file, or end the program with one line."""
    if path.exists() and digest(path) == sha256:
        return
    part, shown = path.with_name(f".{path.name}.part"), url.partition("?")[0]
    try:
        with urllib.request.urlopen(url, timeout=60) as answer, part.open("wb") as sink:
            shutil.copyfileobj(answer, sink, 1 << 20)
        if (found := digest(part)) != sha256:
            sys.exit(f"what {shown} holds has the SHA-256 {found}, not {sha256}; check address and hash")
        part.replace(path)
    except OSError as error:
        sys.exit(f"cannot fetch {shown} to {path}: {error}")
    finally:
        part.unlink(missing_ok=True)
    print(f"fetched {path}", flush=True)


folder, rest = Path(sys.argv[1]), sys.argv[2:]
for name, url, sha256 in zip(rest[::3], rest[1::3], rest[2::3], strict=True):
    fetch(folder / name, url, sha256)
