"""Damage to tables that leaves them readable."""

from pathlib import Path

import h5py


def flip_a_bit(table: Path, dataset: str) -> None:
    """Change the lowest bit of the first byte of a dataset, behind the back of its checksum."""
    with h5py.File(table, "r") as file:
        offset = file[dataset].id.get_offset()
    content = bytearray(table.read_bytes())
    content[offset] ^= 1
    table.write_bytes(content)
