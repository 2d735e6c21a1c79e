"""A table of very many stations, made of copies of another table's."""

from dataclasses import replace
from pathlib import Path

from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table
from rayfix_tables.write import SceneContent, StationContent, write_table


def many_stations(source: Path, path: Path, count: int) -> Path:
    """Write a table of ``count`` stations, in turn those of another table with their widest windows alone."""
    table = Table.open(source)
    parts = list(table.parts.values())
    copies = [parts[n % len(parts)] for n in range(count)]
    stations = [replace(part.station, id=f"s{n:02}") for n, part in enumerate(copies)]
    scene = table.scene
    write_table(
        path,
        site=SiteInfo(
            name="many",
            north=table.site.north,
            max_path_length=table.site.max_path_length,
            stations=tuple(stations),
        ),
        scene=SceneContent(
            vertices=scene.vertices,
            faces=scene.faces,
            face_materials=scene.face_materials,
            materials=scene.materials,
            free_space=scene.free_space,
            sha256=scene.sha256,
        ),
        stations=[
            StationContent(levels=part.levels[-1:], lost_ray_share=0.0, coverage=part.coverage) for part in copies
        ],
        software_version="0",
    )
    return path
