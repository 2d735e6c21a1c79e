"""Finished blocks of a build on disk, from which a killed build continues.

A shard holds the fitted cells of one block. It is written under a temporary name, synced and renamed. It begins with
the SHA-256 of the rest; an incomplete or damaged shard is detected and built again. The name of a shard is a hash of
everything that determines its content, so shards of another site, scene, seed or version are never used.

Several builds may use one folder at a time, also from containers that share a volume: each holds a lock on it, and only
the last one removes it.
"""

import contextlib
import hashlib
import io
import json
import os
import shutil
import time
import uuid
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.disk.ownership import is_at, try_lock
from rayfix_tables.errors import BuildError

_DIGEST_BYTES = 32
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
_REMOVAL_SECONDS = 0.01  # between two tests for a folder that another build removes


def content_key(*parts: Any) -> str:
    """SHA-256 of JSON-compatible data."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class ShardStore:
    """A folder of shards; close it when the build has ended.

    Attributes
    ----------
    folder : Path
        Made when the first shard is saved.
    """

    folder: Path
    _held: list[int] = field(default_factory=list, init=False, repr=False, compare=False)

    @classmethod
    def beside(cls, table_path: Path) -> "ShardStore":
        """Return the store for a new table."""
        return cls(folder=table_path.with_name(f".{table_path.name}.shards"))

    def save(self, name: str, arrays: dict[str, NDArray[Any]]) -> None:
        """Save a shard; it is on disk when this returns.

        Raises
        ------
        BuildError
            When the disk is full or the folder cannot be written; earlier shards are kept.
        """
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        content = buffer.getvalue()
        path = self.folder / name
        partial = path.with_name(f"{name}.partial-{uuid.uuid4().hex}")
        try:
            self._take_folder()
            with partial.open("wb") as file:
                file.write(hashlib.sha256(content).digest())
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                partial.unlink()
            raise BuildError(
                f"cannot save {path}: {error.strerror}; finished blocks are kept: free some space and run the same "
                "build again to continue"
            ) from error

    def load(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Load a shard; None when it is missing or damaged. A damaged shard is removed."""
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
        """Remove the folder with all shards, complete or not, unless another build uses it."""
        try:
            descriptor = self._held.pop() if self._held else os.open(self.folder, _FOLDER)
        except OSError:  # there is none
            return
        try:
            if try_lock(descriptor) is not False and is_at(descriptor, self.folder):
                shutil.rmtree(self.folder, ignore_errors=True)
        finally:
            os.close(descriptor)

    def close(self) -> None:
        """Release the folder, which is not removed."""
        while self._held:
            os.close(self._held.pop())

    def _take_folder(self) -> None:
        """Create the folder and lock it against removal by other builds until it is closed or this process ends."""
        while not self._held:
            self.folder.mkdir(exist_ok=True)
            try:
                descriptor = os.open(self.folder, _FOLDER)
            except FileNotFoundError:  # another build has just finished and removed it
                continue
            if try_lock(descriptor, shared=True) is not False and is_at(descriptor, self.folder):
                self._held.append(descriptor)
            else:
                os.close(descriptor)
                time.sleep(_REMOVAL_SECONDS)
