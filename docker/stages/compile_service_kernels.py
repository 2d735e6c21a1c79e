"""Compile the kernels of the service into ``NUMBA_CACHE_DIR``, when its image is built.

A service compiles its kernels when it loads a table, by answering reports of each kind from it. Here it does so with a
table of an empty room, written without ray tracing: the service's image is built without the offline packages.
"""

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix_service.http.answering.served_tables import load_table
from rayfix_tables.compact.tubes import compacted
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.geometry.angles import direction
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import COMPACT_UNBALANCED, UNBALANCED, Level
from rayfix_tables.mixture import TubeMixture, pack
from rayfix_tables.part import StationPart
from rayfix_tables.scene import Scene
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.version import software_version
from rayfix_tables.write import write_table

ROOM = np.array([6.0, 8.0, 3.0])
WINDOWS = np.deg2rad([2.5, 10.0])
LENGTHS = np.array([1.0, 2.0, 3.5, 5.5])


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        # Kernels for tables of the present format, and of those without compact components.
        for name, compact in (("room", True), ("former", False)):
            path = Path(folder) / f"{name}.h5"
            write_room(path, compact=compact)
            load_table(name, path)


def write_room(path: Path, *, compact: bool = True) -> None:
    """Write the table of a room whose stations hear the direct path alone."""
    stations = (
        Station(id="a", position=(0.1, 0.1, 2.4)),
        Station(id="b", position=(5.9, 7.9, 2.4)),
    )
    low = np.zeros(3)
    write_table(
        path,
        site=SiteInfo(name="room", north=0.0, max_path_length=20.0, stations=stations, document={}),
        scene=Scene(
            vertices=np.array([low, ROOM, [ROOM[0], 0.0, 0.0]]),
            faces=np.array([[0, 1, 2]], np.int32),
            face_materials=np.array([-1], np.int16),
            materials=(),
            free_space=FreeSpace(origin=low, voxel_size=0.1, free=np.ones((ROOM / 0.1).round().astype(int), bool)),
            sha256="0" * 64,
        ),
        parts=[
            StationPart(
                station=station,
                levels=levels(np.array(station.position), compact=compact),
                lost_ray_share=0.0,
                coverage=(1.0,),
            )
            for station in stations
        ],
        software_version=software_version(),
    )


def levels(position: NDArray[np.float64], *, compact: bool) -> tuple[Level, ...]:
    """Levels of a station: in each cell, pieces of the straight path of several lengths."""
    made = []
    for window in WINDOWS:
        grid = AngularGrid.from_spacing(window / 0.8)
        num_cells, num_pieces = grid.num_cells, len(LENGTHS)
        mixture = pieces(position, grid.centres, float(window))
        made.append(
            Level(
                window=float(window),
                grid=grid,
                cell_offsets=np.arange(num_cells + 1) * num_pieces,
                cell_log_mass=np.zeros(num_cells),
                mixture=compacted(mixture, float(window)) if compact else mixture,
                log_balance=COMPACT_UNBALANCED if compact else UNBALANCED,
            )
        )
    return tuple(made)


def pieces(position: NDArray[np.float64], centres: NDArray[np.float64], window: float) -> TubeMixture:
    """Ray tubes around the cells' directions: one for each of ``LENGTHS``."""
    azimuth, zenith = (np.repeat(angle, len(LENGTHS)) for angle in centres.T)
    length = np.tile(LENGTHS, len(centres))
    along = direction(azimuth, zenith)
    across = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
    down = np.cross(across, along)
    count = len(length)
    return TubeMixture(
        log_weight=np.full(count, -np.log(len(LENGTHS)), np.float32),
        u_mean=np.stack([length, 0 * length, 0 * length], axis=-1).astype(np.float32),
        u_cov=pack(np.tile(np.diag([0.3, window**2, window**2]), (count, 1, 1))).astype(np.float32),
        x_mean=(position + length[:, None] * along).astype(np.float32),
        jacobian=np.stack([along, length[:, None] * across, length[:, None] * down], axis=-1).astype(np.float32),
        x_cov=pack(np.tile(1e-4 * np.eye(3), (count, 1, 1))).astype(np.float32),
        num_reflections=np.zeros(count, np.int8),
        num_walls=np.zeros(count, np.int8),
    )


if __name__ == "__main__":
    main()
