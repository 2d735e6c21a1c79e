"""Results on disk: finished results are stored, and later runs reuse them."""

import ast
import errno
import hashlib
import json
import re
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import rayfix_evaluation
import rayfix_offline
import rayfix_service
import rayfix_tables
from rayfix_evaluation.studies.cases import document_key
from rayfix_tables.errors import RayfixError

__all__ = ["Store", "code_digest", "not_written", "write_bytes", "write_json", "write_text"]

_NOT_NUMERIC = ("report", "pictures", "http", "server", "web", "adapters", "__pycache__")
"""Folders with code that does not affect results."""


@dataclass(frozen=True, kw_only=True)
class Store:
    """A folder of finished results, each named by a hash of its settings."""

    folder: Path

    def get(self, settings: Mapping[str, Any]) -> Any | None:
        """Return the stored result of settings, or None. An incomplete file counts as missing."""
        try:
            entry = json.loads(self._path(settings).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return entry["content"] if isinstance(entry, dict) and entry.get("settings") == _plain(settings) else None

    def put(self, settings: Mapping[str, Any], content: Any) -> None:
        """Store the result of settings.

        Raises
        ------
        RayfixError
            When the folder cannot be written.
        """
        write_json(self._path(settings), {"settings": settings, "content": content}, indent=None)

    def _path(self, settings: Mapping[str, Any]) -> Path:
        return self.folder / f"{document_key(settings)}.json"


def write_json(path: Path, document: Any, *, indent: int | None = 1) -> None:
    """Write a document to a temporary file and rename it.

    Raises
    ------
    RayfixError
        When it cannot be written.
    """
    text = json.dumps(document, indent=indent, allow_nan=False)
    # Rows of numbers are written on one line each; otherwise the file would have a hundred thousand lines.
    text = re.sub(r"\[\s+([^\[\]{}\"]+?)\s+\]", lambda row: "[" + re.sub(r"\s+", " ", row[1]) + "]", text)
    write_text(path, text + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text as :func:`write_bytes` does, in UTF-8."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file beside its place and rename it, so that under its name it is whole or as it was.

    Raises
    ------
    RayfixError
        When it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Not by the process's number, which two containers on one volume may have in common.
        part = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
        try:
            part.write_bytes(content)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise not_written(path, error) from error


def not_written(path: Path, error: OSError) -> RayfixError:
    """Return the error of a file of the report's folder that cannot be written, with the remedy."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        remedy = "nothing finished is lost: free some space and start again"
    else:
        remedy = "choose another folder with -o"
    return RayfixError(f"cannot write {path}: {error.strerror}; {remedy}")


@cache
def code_digest() -> str:
    """Return a checksum of the code that affects results; results of other code are not reused.

    Comments, docstrings and layout are ignored.
    """
    digest = hashlib.sha256()
    for package in (rayfix_tables, rayfix_offline, rayfix_service, rayfix_evaluation):
        root = Path(str(package.__file__)).parent
        for path in sorted(root.rglob("*.py")):
            parts = path.relative_to(root).parts
            if not any(part in _NOT_NUMERIC for part in parts):
                digest.update("/".join(parts).encode() + b"\0" + meaning(path.read_text(encoding="utf-8")) + b"\0")
    return digest.hexdigest()[:16]


def meaning(source: str) -> bytes:
    """Return a module's syntax tree as text, without comments, docstrings and layout."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [
                statement
                for statement in node.body
                if not (isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant))
            ]
    return ast.dump(tree).encode()


def _plain(document: Any) -> Any:
    return json.loads(json.dumps(document))
