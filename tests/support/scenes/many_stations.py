"""A table of very many stations, made of copies of another table's."""

from dataclasses import replace
from pathlib import Path

from rayfix_tables.part import StationPart
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table
from rayfix_tables.write import write_table


def many_stations(source: Path, path: Path, count: int) -> Path:
    """Write a table of ``count`` stations, in turn those of another table with their widest windows alone."""
    table = Table.open(source)
    parts = list(table.parts.values())
    copies = [parts[n % len(parts)] for n in range(count)]
    stations = [replace(part.station, id=f"s{n:02}") for n, part in enumerate(copies)]
    write_table(
        path,
        site=SiteInfo(
            name="many",
            north=table.site.north,
            max_path_length=table.site.max_path_length,
            stations=tuple(stations),
        ),
        scene=table.scene,
        parts=[
            StationPart(station=station, levels=part.levels[-1:], lost_ray_share=0.0, coverage=part.coverage)
            for station, part in zip(stations, copies, strict=True)
        ],
        software_version="0",
    )
    return path
