"""Tables by hand, of which fixes have a closed form.

Each station's cells are empty but for those given; a cell holds one tube, that of the line of sight::

    y       o b (6, 14)
    |
    |           x UE (9, 8)              seen from above, in the middle of a free cube of 64 m;
    |                                    the stations 1.2 m above the UE
    |      o a (5, 3)
    |___________________o c (16, 2)__ x
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.freespace import FreeSpace
from rayfix_tables.geometry.angles import angles_of, direction
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import Level
from rayfix_tables.mixture import TubeMixture, pack
from rayfix_tables.part import StationPart
from rayfix_tables.scene import Scene
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.table import Table
from rayfix_tables.write import write_table

Array = NDArray[np.float64]

WINDOW = float(np.deg2rad(5.0))
GRID = AngularGrid.from_spacing(WINDOW / 0.8)
MAX_PATH_LENGTH = 40.0
SIDE = 64
ORIGIN = np.array([-23.0, -24.0, -30.8])
POSITIONS = {"a": (5.0, 3.0, 2.4), "b": (6.0, 14.0, 2.4), "c": (16.0, 2.0, 2.4)}
UE = np.array([9.0, 8.0, 1.2])

MakeTable = Callable[..., Table]
"""The fixture ``make_table``: :func:`table_of` with a path of its own."""


@dataclass(frozen=True, kw_only=True)
class Tube:
    """The line of sight from a station to a place, or a path said to be reflected, in the numbers of the table."""

    station_id: str
    cell: int
    log_mass: float
    u_mean: Array
    u_cov: Array
    x_mean: Array
    jacobian: Array
    x_cov: Array
    num_reflections: int = 0
    num_walls: int = 0


def line_of_sight(
    station_id: str, place: Array = UE, *, length_stdev: float = 2.0, log_mass: float = 1.0, width: float = 0.05
) -> Tube:
    """Tube from a station through a place, as long as the deviation says and as wide as its cell's window."""
    apart = place - np.array(POSITIONS[station_id])
    azimuth, zenith = angles_of(apart)
    cell = int(GRID.nearest(azimuth, zenith))
    centre_azimuth, centre_zenith = GRID.centres[cell]
    offset = np.array([np.sin(centre_zenith) * (azimuth - centre_azimuth), zenith - centre_zenith])
    length = np.linalg.norm(apart)
    along = direction(azimuth, zenith)
    sideways = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]) * np.sin(zenith) / np.sin(centre_zenith)
    down = direction(azimuth, zenith + 0.5 * np.pi)
    deviations = np.array([length_stdev, 0.7 * WINDOW, 0.8 * WINDOW])
    correlation = np.array([[1.0, 0.1, -0.2], [0.1, 1.0, 0.05], [-0.2, 0.05, 1.0]])

    def stored(values: Array) -> Array:
        return np.asarray(np.asarray(values, np.float32), np.float64)

    return Tube(
        station_id=station_id,
        cell=cell,
        log_mass=log_mass,
        u_mean=stored(np.array([length, *offset])),
        u_cov=stored(correlation * np.multiply.outer(deviations, deviations)),
        x_mean=stored(place),
        jacobian=stored(np.stack([along, length * sideways, length * down], axis=-1)),
        x_cov=stored(width**2 * np.array([[1.0, 0.2, 0.0], [0.2, 1.5, 0.1], [0.0, 0.1, 0.8]])),
    )


def station_part(station: Station, tubes: list[Tube]) -> StationPart:
    offsets, masses = np.zeros(GRID.num_cells + 1, np.int64), np.full(GRID.num_cells, -np.inf)
    tubes = sorted(tubes, key=lambda tube: tube.cell)
    for tube in tubes:
        offsets[tube.cell + 1 :] += 1
        masses[tube.cell] = np.logaddexp(masses[tube.cell], tube.log_mass)
    mixture = TubeMixture.empty()
    if tubes:
        mixture = TubeMixture(
            log_weight=np.array([tube.log_mass - masses[tube.cell] for tube in tubes]),
            u_mean=np.array([tube.u_mean for tube in tubes]),
            u_cov=pack(np.array([tube.u_cov for tube in tubes])),
            x_mean=np.array([tube.x_mean for tube in tubes]),
            jacobian=np.array([tube.jacobian for tube in tubes]),
            x_cov=pack(np.array([tube.x_cov for tube in tubes])),
            num_reflections=np.array([tube.num_reflections for tube in tubes], np.int8),
            num_walls=np.array([tube.num_walls for tube in tubes], np.int8),
        )
    level = Level(window=WINDOW, grid=GRID, cell_offsets=offsets, cell_log_mass=masses, mixture=mixture)
    return StationPart(station=station, levels=(level,), lost_ray_share=0.0, coverage=(1.0,))


def table_of(
    path: Path,
    *tubes: Tube,
    stations: dict[str, Station] | None = None,
    free: NDArray[np.bool_] | None = None,
) -> Table:
    """Write a table of the stations a, b and c, or of others, to a path and open it."""
    known = stations or {name: Station(id=name, position=position) for name, position in POSITIONS.items()}
    free_space = FreeSpace(origin=ORIGIN, voxel_size=1.0, free=np.ones((SIDE,) * 3, np.bool_) if free is None else free)
    scene = Scene(
        vertices=np.zeros((3, 3)),
        faces=np.array([[0, 1, 2]], np.int32),
        face_materials=np.array([-1], np.int16),
        materials=(),
        free_space=free_space,
        sha256="0" * 64,
    )
    write_table(
        path,
        site=SiteInfo(name="box", north=0.0, max_path_length=MAX_PATH_LENGTH, stations=tuple(known.values())),
        scene=scene,
        parts=[station_part(each, [t for t in tubes if t.station_id == name]) for name, each in known.items()],
        software_version="0",
    )
    return Table.open(path)
