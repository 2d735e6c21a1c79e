"""The built files of the viewer and of the HTTP interface's page, ready to be sent.

``make viewer`` builds them into ``static/``, and wheels contain them. They are few and small: they are read once and
kept in memory, also compressed.
"""

import gzip
import hashlib
import mimetypes
from dataclasses import dataclass
from pathlib import Path

STATIC = Path(__file__).with_name("static")
"""Folder of the built files."""

INDEX = "index.html"
"""The viewer's page."""

INTERFACE = "interface.html"
"""The page that shows the OpenAPI document."""

CONTENT_SECURITY_POLICY = "; ".join(
    [
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data:",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    ]
)
"""Content-Security-Policy: a page runs only its own files and connects only to its own service."""

SECURITY_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

_FOREVER = "public, max-age=31536000, immutable"
_COMPRESSIBLE = {".html", ".js", ".css", ".svg", ".json"}


@dataclass(frozen=True, kw_only=True)
class Asset:
    """A file.

    Attributes
    ----------
    body, compressed : bytes
        The content, plain and compressed by gzip; None if compression does not pay.
    media_type : str
    cache_control : str
        Files in subfolders have a hash of the content in their names and are cached without a time limit.
    tag : str
        Entity tag.
    """

    body: bytes
    compressed: bytes | None
    media_type: str
    cache_control: str
    tag: str


def viewer_is_built(folder: Path = STATIC) -> bool:
    """Whether the viewer has been built."""
    return (folder / INDEX).is_file()


def load_assets(folder: Path = STATIC) -> dict[str, Asset]:
    """Read the built files, by path within the folder; empty if the viewer has not been built."""
    if not viewer_is_built(folder):
        return {}
    return {path.relative_to(folder).as_posix(): _load(path, folder) for path in folder.rglob("*") if path.is_file()}


def _load(path: Path, folder: Path) -> Asset:
    body = path.read_bytes()
    media_type = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    if path.suffix == ".js":
        media_type = "text/javascript"  # regardless of the machine's list of types
    return Asset(
        body=body,
        compressed=gzip.compress(body, 9, mtime=0) if path.suffix in _COMPRESSIBLE else None,
        media_type=media_type,
        cache_control="no-cache" if path.parent == folder else _FOREVER,
        tag=f'"{hashlib.sha256(body).hexdigest()[:32]}"',
    )
