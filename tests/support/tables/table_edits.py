"""Changes to a table's texts behind the back of its checksums, and how to make these right again."""

import json
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np

from rayfix_tables.disk.schema import (
    array_digest,
    content_attributes,
    content_id,
    dataset_paths,
    read_text,
    write_text,
)


def text_of(file: h5py.File, name: str) -> str:
    """Text of a dataset."""
    return bytes(file[name][()].tobytes()).decode()


def put_text(file: h5py.File, name: str, text: str) -> None:
    """Put another text with the same checksum in the place of a dataset's."""
    digest = read_text(file[name], "sha256")
    del file[name]
    file[name] = np.frombuffer(text.encode(), np.uint8)
    write_text(file[name], "sha256", digest)


def change_site(file: h5py.File, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Change the site's document."""
    put_text(file, "site", json.dumps(change(json.loads(text_of(file, "site")))))


def sign(file: h5py.File) -> str:
    """Make checksums and ``table_id`` right; returns the latter."""
    for name in dataset_paths(file):
        write_text(file[name], "sha256", array_digest(file[name][()]))
    digests = {name: read_text(file[name], "sha256") for name in dataset_paths(file)}
    table_id = content_id(content_attributes(file), digests)
    write_text(file, "table_id", table_id)
    return table_id
