"""Finished parts of a build on disk, so that a build that was killed goes on where it was.

A shard holds the fitted cells of one block. It is written beside its name, synced and renamed, and begins with the
SHA-256 of the rest: half a shard or a damaged one is noticed and built again. Shards are named by all that decides
their content, so that no shard of another site, scene, seed or version is ever taken for the right one.
"""

import hashlib
import io
import json
import os
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.errors import BuildError

_DIGEST_BYTES = 32


def content_key(*parts: Any) -> str:
    """SHA-256 of JSON-compatible data."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class ShardStore:
    """A folder of shards.

    Attributes
    ----------
    folder : Path
        Made when the first shard is saved.
    """

    folder: Path

    @classmethod
    def beside(cls, table_path: Path) -> "ShardStore":
        """Return the store that belongs to a table to be."""
        return cls(folder=table_path.with_name(f".{table_path.name}.shards"))

    def save(self, name: str, arrays: dict[str, NDArray[Any]]) -> None:
        """Save a shard; it is on disk when this returns.

        Raises
        ------
        BuildError
            When the disk is full or the folder cannot be written; all earlier shards stay.
        """
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        content = buffer.getvalue()
        path = self.folder / name
        partial = path.with_name(f"{name}.partial-{os.getpid()}")
        try:
            self.folder.mkdir(exist_ok=True)
            with partial.open("wb") as file:
                file.write(hashlib.sha256(content).digest())
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise BuildError(
                f"cannot save {path}: {error.strerror}; nothing finished is lost: free some space and run the same "
                "build again, it goes on from here"
            ) from error

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Load a shard; None when it is not there, or damaged (it is then removed)."""
        path = self.folder / name
        try:
            stored = path.read_bytes()
        except OSError:
            return None
        digest, content = stored[:_DIGEST_BYTES], stored[_DIGEST_BYTES:]
        if hashlib.sha256(content).digest() == digest:
            try:
                with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                    return {key: arrays[key] for key in arrays.files}
            except (OSError, ValueError, zipfile.BadZipFile):
                pass
        path.unlink(missing_ok=True)
        return None

    def remove(self) -> None:
        """Remove the folder with all shards, and what a killed build left half written."""
        shutil.rmtree(self.folder, ignore_errors=True)
