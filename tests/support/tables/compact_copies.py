"""Compact copies of tables, and tables of whole components from compact ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rayfix_tables.compact.tubes import compacted
from rayfix_tables.level import Level
from rayfix_tables.part import StationPart
from rayfix_tables.table import Table
from rayfix_tables.write import write_table


def compact_level(level: Level) -> Level:
    """Round a level to what a table of version 5 holds."""
    mixture = compacted(level.mixture[:], level.window)
    return replace(level, mixture=mixture, log_balance=level.log_balance.astype(np.float16))


def compact_copy(table: Table, path: Path) -> Table:
    """Write a compact copy of a table to a path and open it."""
    parts = [
        replace(
            part,
            levels=tuple(compact_level(level) for level in part.levels),
            paths=part.paths.compacted if part.paths else None,
        )
        for part in table.parts.values()
    ]
    return _written(table, parts, path)


def former_copy(table: Table, path: Path) -> Table:
    """Write a copy of a compact table in version 4 of the format to a path and open it."""
    parts = []
    for part in table.parts.values():
        paths = part.paths
        if paths is not None:
            paths = replace(paths, weight=paths.weight_of_1, weight_unit=1.0, sequence=paths.sequence.astype(np.int32))
        parts.append(replace(part, levels=tuple(level.expanded for level in part.levels), paths=paths))
    return _written(table, parts, path)


def _written(table: Table, parts: list[StationPart], path: Path) -> Table:
    write_table(path, site=table.site, scene=table.scene, parts=parts, software_version=table.software_version)
    return Table.open(path)
