"""A table of an empty room without reflections, by hand: one path from each station to each place.

::

    y   c (0.1, 5.9)          d (5.9, 5.9)        seen from above; 6 x 6 x 3 m, the stations at 2.8 m
    |
    |   a (0.1, 0.1)          b (5.9, 0.1)
    |_________________________________________ x
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.freespace import FreeSpace
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import Level
from rayfix_tables.mixture import TubeMixture
from rayfix_tables.part import StationPart
from rayfix_tables.paths import PathMap
from rayfix_tables.scene import Scene
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.table import Table
from rayfix_tables.write import write_table

SIDE, HEIGHT, VOXEL = 6.0, 3.0, 0.1
POSITIONS = {"a": (0.1, 0.1, 2.8), "b": (5.9, 0.1, 2.8), "c": (0.1, 5.9, 2.8), "d": (5.9, 5.9, 2.8)}
WINDOW = float(np.deg2rad(1.25))


def room_space(free: NDArray[np.bool_] | None = None) -> FreeSpace:
    """Return the free space of the room, all of it by default."""
    shape = (round(SIDE / VOXEL), round(SIDE / VOXEL), round(HEIGHT / VOXEL))
    return FreeSpace(origin=np.zeros(3), voxel_size=VOXEL, free=np.ones(shape, bool) if free is None else free)


def direct_paths(position: tuple[float, float, float], space: FreeSpace) -> PathMap:
    """Return the map of a station that is seen from everywhere."""
    shape = tuple((np.array(space.free.shape) // 2).tolist())
    count = int(np.prod(shape))
    return PathMap(
        origin=space.origin,
        voxel_size=2.0 * space.voxel_size,
        shape=shape,
        offsets=np.arange(count + 1),
        sequence=np.zeros(count, np.int32),
        weight=np.ones(count, np.float32),
        excess=np.zeros(0, np.float32),
        num_walls=np.zeros(0, np.int8),
        images=np.array([position]),
        mirrors=np.eye(3)[None],
        num_reflections=np.zeros(1, np.int8),
        log_gain=np.zeros(count, np.float16),
        lit=np.ones(count, np.float16),
    )


def open_room_table(path: Path, space: FreeSpace | None = None, *, stations: tuple[Station, ...] = ()) -> Table:
    """Write and open the table; its cells are empty, so that only the path map answers."""
    space = space or room_space()
    stations = stations or tuple(Station(id=name, position=at) for name, at in POSITIONS.items())
    grid = AngularGrid.from_spacing(0.5)
    level = Level(
        window=WINDOW,
        grid=grid,
        cell_offsets=np.zeros(grid.num_cells + 1, np.int64),
        cell_log_mass=np.full(grid.num_cells, -np.inf),
        mixture=TubeMixture.empty(),
    )
    parts = [StationPart(station=each, levels=(level,), lost_ray_share=0.0, coverage=(1.0,)) for each in stations]
    parts = [replace(part, paths=direct_paths(part.station.position, space)) for part in parts]
    scene = Scene(
        vertices=np.eye(3),
        faces=np.array([[0, 1, 2]], np.int32),
        face_materials=np.array([-1], np.int16),
        materials=(),
        free_space=space,
        sha256="0" * 64,
    )
    site = SiteInfo(name="room", north=0.0, max_path_length=30.0, stations=stations, document={})
    write_table(path, site=site, scene=scene, parts=parts, software_version="1")
    return Table.open(path)


def mirrored_room_table(folder: Path) -> Table:
    """Return the open room with a second path to each place, by the wall at x = 6 m, without a loss."""
    table = open_room_table(folder / "t.h5")
    parts = {}
    for name, part in table.parts.items():
        assert part.paths is not None
        count = len(part.paths)
        x, y, z = POSITIONS[name]
        paths = replace(
            part.paths,
            offsets=2 * part.paths.offsets,
            sequence=np.tile(np.array([0, 1], np.int32), count),
            weight=np.tile(np.array([0.9, 0.1], np.float32), count),
            images=np.array([[x, y, z], [12.0 - x, y, z]]),
            mirrors=np.array([np.eye(3), np.diag([-1.0, 1.0, 1.0])]),
            num_reflections=np.array([0, 1], np.int8),
            log_gain=np.zeros(2 * count, np.float16),
            lit=np.ones(2 * count, np.float16),
        )
        parts[name] = replace(part, paths=paths)
    return replace(table, parts=parts)
